"""Errors of MuJoCo (published, fitted) and of models on recorded tosses, and one toss.

    python experiments/measured_cube/compare.py --data cube_tosses.npz --out runs/cube

Writes the table as ``test.json`` and ``toss.png``: one toss as measured and as simulated.
"""

import argparse
from pathlib import Path

import torch
from mujoco_cube import mujoco_baselines
from toss_plot import plot_toss

from torchrl_nerd import from_pretrained, load_scene
from torchrl_nerd.data.log_files import load_recording
from torchrl_nerd.dynamics import Dynamics, dynamics_of
from torchrl_nerd.evaluation.recorded_error import STATES, compare, errors_as_text
from torchrl_nerd.evaluation.results import write_results
from torchrl_nerd.evaluation.rollout_error import open_loop
from torchrl_nerd.robots import recorded_protocol
from torchrl_nerd.training.finetune import start_model


def main() -> None:
    """Measure, print, write and draw."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True, help="recorded tosses")
    parser.add_argument("--model", action="append", default=[], help="folder or name")
    parser.add_argument("--part", default="test", choices=("validation", "test"))
    parser.add_argument("--toss", type=int, default=0, help="of that part, to draw")
    parser.add_argument("--out", type=Path, default=Path("runs/measured_cube"))
    args = parser.parse_args()
    scene, protocol = load_scene("cube_real"), recorded_protocol("cube")
    recording, split = load_recording(args.data, scene)
    models: dict[str, Dynamics] = dict(mujoco_baselines(scene))
    models["analytic, published"] = dynamics_of(start_model(scene))
    for name in (protocol.model, *args.model):
        models[name] = dynamics_of(from_pretrained(name, scene))
    starts = recording.starts(STATES, split[args.part])
    table = compare(models, scene, recording, starts)
    print(errors_as_text(table, protocol.published))
    write_results(args.out / f"{args.part}.json", table)
    first = recording.offsets[split[args.part][args.toss], None]
    window = recording.windows(first, STATES)
    shown = ("MuJoCo, fitted", "MuJoCo, fitted with centre", protocol.model)
    paths = {
        name: torch.cat(
            (
                window["qpos"][0, :1],
                open_loop(models[name], window[:, 0], STATES - 1)[0],
            )
        )
        for name in (*shown, *args.model[:1])
    }
    plot_toss(window["qpos"][0], paths, scene.control_step, args.out / "toss.png")


if __name__ == "__main__":
    main()
