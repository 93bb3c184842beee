"""Fit the analytic step with velocities withheld, at a third of the rate, and with noise.

    python experiments/measured_cube/partial_observation.py --data cube_tosses.npz

Errors are of the test tosses' windows that begin where the encoder's window ends, beside
the shipped model from recorded states on the same windows.
"""

import argparse
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import cast

import torch
from pose_encoder import PoseEncoder, with_noise
from tensordict import TensorDict
from torch import Tensor

from torchrl_nerd import from_pretrained, load_scene
from torchrl_nerd.analytic import FreeBodyPenaltyStep
from torchrl_nerd.analytic.free_body import PARAMETERS
from torchrl_nerd.data.log_files import load_recording
from torchrl_nerd.data.recorded import Recording
from torchrl_nerd.dynamics import AnalyticDynamics, dynamics_of
from torchrl_nerd.evaluation.position_error import Errors, position_errors
from torchrl_nerd.evaluation.recorded_error import (
    STATES,
    summarize_windows,
    window_errors,
)
from torchrl_nerd.evaluation.results import write_results
from torchrl_nerd.evaluation.rollout_error import open_loop
from torchrl_nerd.scenes import Scene
from torchrl_nerd.training.finetune import start_model, weighted_error
from torchrl_nerd.training.physics_fit import fit_flight, fit_parameters

VALIDATION_STRIDE = 5  # of the validation windows, which overlap


@dataclass(frozen=True)
class Case:
    """What of the tosses is seen: every how many frames, noise (m), poses in a window."""

    every: int = 1
    noise: float = 0.0
    poses: int = 3


CASES = {
    "poses": Case(),
    "third": Case(every=3, poses=2),
    "noisy": Case(noise=1e-3, poses=8),
}


class Fit:
    """Physical parameters from poses alone; the encoder is least squares throughout.

    Args:
        scene: the cube.
        recording: its tosses; their velocities are not used.
        case: what of them is seen.
    """

    def __init__(self, scene: Scene, recording: Recording, case: Case) -> None:
        self.scene, self.case = scene, case
        self.seen = with_noise(recording, case.noise)
        self.encoder = PoseEncoder(scene, case.poses, case.every)
        self.step = cast(FreeBodyPenaltyStep, start_model(scene))

    @torch.no_grad()
    def errors(self, rows: Tensor, measured: Recording) -> Errors:
        """Errors of windows that start where the encoder's window at ``rows`` ends."""
        span, every = self.encoder.span, self.case.every
        before = self.seen.windows(rows, span + 1)["qpos"][:, ::every]
        qpos, qvel = self.encoder(before)
        start = TensorDict({"qpos": qpos, "qvel": qvel}, [len(rows)])
        path = open_loop(AnalyticDynamics(self.step), start, STATES - 1)
        expected = measured.windows(rows + span, STATES)["qpos"][:, 1:]
        return position_errors(self.scene, expected, path)

    def run(self, train: Tensor, validation: Tensor, evaluations: int) -> None:
        """Fit to what is seen of the training tosses; the better stage is kept."""
        every, states = self.case.every, self.encoder.span + STATES

        def error_of(values: dict[str, float], rows: Tensor) -> float:
            self.step.set_values(values)
            error = weighted_error(self.scene, self.errors(rows, self.seen))
            return float(error[:, every - 1 :: every].mean())

        flight = fit_flight(self.scene, thinned(self.seen.select(train), every))
        first, starts = self.step.values() | flight, self.seen.starts(states, train)
        checks = self.seen.starts(states, validation)[::VALIDATION_STRIDE]
        stages = fit_parameters(error_of, first, PARAMETERS, starts, evaluations)
        found = [self.step.values(), *stages]
        self.step.set_values(min(found, key=lambda x: error_of(x, checks)))


def thinned(recording: Recording, every: int) -> Recording:
    """Every how many frames of each trajectory."""
    rows, ends = [], [0]
    for first, end in zip(recording.offsets[:-1], recording.offsets[1:], strict=True):
        rows.append(torch.arange(int(first), int(end), every))
        ends.append(ends[-1] + len(rows[-1]))
    kept = torch.cat(rows)
    return replace(
        recording,
        qpos=recording.qpos[kept],
        qvel=recording.qvel[kept],
        joint_torque=recording.joint_torque[kept],
        offsets=torch.tensor(ends),
        frame=every * recording.frame,
    )


def main() -> None:
    """Fit, measure and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True, help="recorded tosses")
    parser.add_argument("--case", choices=CASES, default="poses")
    parser.add_argument("--evaluations", type=int, default=90, help="of each stage")
    parser.add_argument("--part", default="test", choices=("validation", "test"))
    parser.add_argument("--json", type=Path, help="write the results to this file")
    args = parser.parse_args()
    scene, case = load_scene("cube_real"), CASES[args.case]
    recording, split = load_recording(args.data, scene)
    fit = Fit(scene, recording, case)
    fit.run(split["train"], split["validation"], args.evaluations)
    rows = recording.starts(fit.encoder.span + STATES, split[args.part])
    starts = rows + fit.encoder.span
    shipped = dynamics_of(from_pretrained("cube_tosses"))
    found = {
        args.case: fit.errors(rows, recording),
        "whole states": window_errors(shipped, recording, starts),
    }
    results = {}
    for name, errors in found.items():
        results[name] = summarize_windows(scene, errors, recording, starts)
        means = {key: round(value["mean"], 4) for key, value in results[name].items()}
        print(name, means)
    if args.json:
        how = {"case": asdict(case), "parameters": fit.step.values()}
        write_results(args.json, {**how, "errors": results})


if __name__ == "__main__":
    main()
