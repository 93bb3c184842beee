"""Fit MuJoCo's parameters to the training tosses: what a learned model has to beat.

    python experiments/measured_cube/fit_mujoco.py --data cube_tosses.npz --json fit.json

``--centre`` fits the centre of mass too; otherwise it is the cube's middle.
"""

import argparse
import time
from pathlib import Path

from mujoco_cube import PUBLISHED, cube_with
from torch import Tensor

from torchrl_nerd import load_scene
from torchrl_nerd.data.log_files import load_recording
from torchrl_nerd.data.recorded import Recording
from torchrl_nerd.dynamics import MujocoDynamics
from torchrl_nerd.evaluation.recorded_error import STATES, window_errors
from torchrl_nerd.evaluation.results import write_results
from torchrl_nerd.scenes import Scene
from torchrl_nerd.training.finetune import weighted_error
from torchrl_nerd.training.physics_fit import (
    CENTRE,
    WINDOWS,
    fit_flight,
    fit_parameters,
)


def fit_mujoco(
    scene: Scene,
    recording: Recording,
    train: Tensor,
    evaluations: int,
    has_centre: bool = False,
) -> dict[str, float]:
    """Parameters with the least error, from the published ones and the tosses' flights.

    Args:
        scene: the cube.
        recording: its tosses.
        train: numbers of the tosses to fit to, ``(count,)``.
        evaluations: of each stage.
        has_centre: fit the centre of mass too.
    """
    flight = fit_flight(scene, recording.select(train))
    names = [name for name in PUBLISHED if has_centre or name not in CENTRE]
    first = PUBLISHED | {k: v for k, v in flight.items() if k in names}

    def error_of(values: dict[str, float], rows: Tensor) -> float:
        dynamics = MujocoDynamics(cube_with(scene, values))
        errors = window_errors(dynamics, recording, rows)
        return float(weighted_error(scene, errors).mean())

    starts = recording.starts(STATES, train)
    *_, last = fit_parameters(error_of, first, names, starts, evaluations)
    return last


def main() -> None:
    """Fit and write the parameters."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True, help="recorded tosses")
    parser.add_argument("--json", type=Path, help="write the parameters to this file")
    parser.add_argument("--evaluations", type=int, default=90, help="of each stage")
    parser.add_argument("--centre", action="store_true", help="fit the centre of mass")
    args = parser.parse_args()
    scene = load_scene("cube_real")
    recording, split = load_recording(args.data, scene)
    began = time.monotonic()
    found = fit_mujoco(scene, recording, split["train"], args.evaluations, args.centre)
    results = {
        "parameters": found,
        "windows": WINDOWS,
        "evaluations": args.evaluations,
        "seconds": time.monotonic() - began,
    }
    print(results)
    if args.json:
        write_results(args.json, results)


if __name__ == "__main__":
    main()
