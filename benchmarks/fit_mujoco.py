"""Fit MuJoCo to the training tosses: the baseline of docs/real_data.md.

python benchmarks/fit_mujoco.py --data cube_tosses.npz --json docs/figures/fit_mujoco.json
"""

import argparse
import time
from pathlib import Path

import torch

from torchrl_nerd import load_scene
from torchrl_nerd.data.recorded import load_tosses
from torchrl_nerd.evaluation.system_identification import FITTED, PUBLISHED, fit_mujoco
from torchrl_nerd.evaluation.toss_error import STATES
from torchrl_nerd.files import write_json


def main() -> None:
    """Fit and write the parameters."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True, help="recorded tosses, npz")
    parser.add_argument("--json", type=Path, help="write the parameters to this file")
    parser.add_argument("--windows", type=int, default=380, help="sub-trajectories")
    parser.add_argument("--evaluations", type=int, default=100, help="of all of them")
    parser.add_argument("--refine", action="store_true", help="start from FITTED")
    args = parser.parse_args()
    scene = load_scene("cube_real")
    tosses, split = load_tosses(args.data, scene)
    starts = tosses.starts(STATES, split["train"])
    generator = torch.Generator().manual_seed(0)
    pick = torch.randperm(len(starts), generator=generator)[: args.windows]
    began, start = time.monotonic(), FITTED if args.refine else PUBLISHED
    found = fit_mujoco(scene, tosses, starts[pick], start, args.evaluations)
    figures = {
        "parameters": found,
        "windows": len(pick),
        "evaluations": args.evaluations,
        "seconds": time.monotonic() - began,
    }
    print(figures)
    if args.json:
        write_json(args.json, figures)


if __name__ == "__main__":
    main()
