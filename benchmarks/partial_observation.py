"""Fine-tune with velocities withheld, at a third of the rate, and with noise.

    python benchmarks/partial_observation.py --data cube_tosses.npz --case poses

Errors are of the test tosses' sub-trajectories that begin where the encoder's window
ends, for the model named and, from the recorded states, for whatever ``--reference`` is.
"""

import argparse
from dataclasses import asdict, replace
from pathlib import Path

import torch

from torchrl_nerd import from_pretrained, load_scene
from torchrl_nerd.configs import FinetuneConfig
from torchrl_nerd.data.recorded import SHIPPED, load_tosses
from torchrl_nerd.dynamics import NeRDDynamics
from torchrl_nerd.evaluation.toss_error import STATES, summarize_both, toss_errors
from torchrl_nerd.files import write_json
from torchrl_nerd.training.finetune import FineTuner
from torchrl_nerd.training.finetune_run import PRETRAINED_NAME

CASES = {
    "poses": FinetuneConfig(observe="poses"),
    "third": FinetuneConfig(observe="poses", every=3, poses=2),
    "noisy": FinetuneConfig(observe="poses", pose_noise=1e-3, poses=8),
}


def main() -> None:
    """Fine-tune, measure and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True, help="recorded tosses, npz")
    parser.add_argument("--case", choices=CASES, default="poses")
    parser.add_argument("--model", default=PRETRAINED_NAME, help="to start from")
    parser.add_argument("--reference", default=SHIPPED, help="sees whole states")
    parser.add_argument("--part", default="test", choices=("validation", "test"))
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    args = parser.parse_args()
    scene = load_scene("cube_real")
    tosses, split = load_tosses(args.data, scene)
    # velocities are withheld: a NaN would reach the figures
    poses = replace(tosses, qvel=torch.full_like(tosses.qvel, float("nan")))
    config, parts = CASES[args.case], (split["train"], split["validation"])
    tuner = FineTuner(from_pretrained(args.model), poses, *parts, config)
    tuner.run()
    assert tuner.view.encoder is not None
    span = tuner.view.encoder.span
    rows = tosses.starts(span + STATES, split[args.part])
    starts = rows + span
    reference = NeRDDynamics(from_pretrained(args.reference))
    found = {
        args.case: tuner.errors(rows),
        "whole states": toss_errors(reference, tosses, starts),
    }
    figures = {
        name: {k: asdict(v) for k, v in summarize_both(both, tosses, starts).items()}
        for name, both in found.items()
    }
    for name, errors in figures.items():
        line = "  ".join(f"{k} {v['mean']:.4f}" for k, v in errors.items())
        print(f"{name:<14}{line}")
    if args.json:
        write_json(args.json, {"config": asdict(config), "errors": figures})


if __name__ == "__main__":
    main()
