"""Fit MuJoCo to the training tosses: the baseline of docs/real_data.md.

python benchmarks/fit_mujoco.py --data cube_tosses.npz --json docs/figures/fit_mujoco.json

``--centre`` gives it the centre of mass that the cube was found to have.
"""

import argparse
import time
from pathlib import Path

from torchrl_nerd import load_scene
from torchrl_nerd.data.recorded import load_tosses
from torchrl_nerd.evaluation.parameter_fit import WINDOWS
from torchrl_nerd.evaluation.system_identification import fit_mujoco
from torchrl_nerd.files import write_json


def main() -> None:
    """Fit and write the parameters."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True, help="recorded tosses, npz")
    parser.add_argument("--json", type=Path, help="write the parameters to this file")
    parser.add_argument("--evaluations", type=int, default=90, help="of each stage")
    parser.add_argument("--centre", action="store_true", help="fit the centre of mass")
    args = parser.parse_args()
    scene = load_scene("cube_real")
    tosses, split = load_tosses(args.data, scene)
    began = time.monotonic()
    found = fit_mujoco(scene, tosses, split["train"], args.evaluations, args.centre)
    seconds = time.monotonic() - began
    figures = {
        "parameters": found,
        "windows": WINDOWS,
        "evaluations": args.evaluations,
        "seconds": seconds,
    }
    print(figures)
    if args.json:
        write_json(args.json, figures)


if __name__ == "__main__":
    main()
