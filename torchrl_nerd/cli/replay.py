"""``nerd replay``: the steps before a fault again, in the model and in MuJoCo."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from tensordict import TensorDict

from torchrl_nerd.checkpoint import from_pretrained
from torchrl_nerd.cli.command import DeviceCommand
from torchrl_nerd.cli.options import Positional
from torchrl_nerd.dynamics import Model, MujocoDynamics, dynamics_of
from torchrl_nerd.keys import ACTION, QPOS, QVEL, TERRAIN
from torchrl_nerd.robots import load_scene

NEEDED = {QPOS, QVEL, ACTION, "joint_torque"}


@dataclass(frozen=True)
class Replay(DeviceCommand):
    """The steps before a fault again, in the model and in MuJoCo.

    Envs with a dump_dir leave dumps: make_env(..., dump_dir=Path("faults")).

    Example: nerd replay faults/fault_diverged.safetensors
    """

    file: Positional[Path]
    """The dump."""
    model: str | None = None
    """Checkpoint folder; the shipped model of its scene by default."""

    def run(self) -> dict[str, Any]:
        """Print a line per step and return the results."""
        about, dump = read_dump(self.file)
        name = about["scene"]
        model = from_pretrained(self.model or name, load_scene(name)).to(self.device)
        steps = replay(dump, model)
        where = f"env {about.get('env', '?')} of {name}"
        print(f"{about['reason']} in {where}, stepped by {about.get('dynamics', '?')}")
        print("  ".join(f"{key:>14}" for key in steps[0]))
        for step in steps:
            print("  ".join(f"{value:>14.3g}" for value in step.values()))
        return {**about, "steps": steps}


def read_dump(path: Path) -> tuple[dict[str, str], TensorDict]:
    """Scene, dynamics, reason and env of a fault, and the steps ``[T]`` up to it.

    Raises:
        ValueError: a file that is not there, or is no dump.
    """
    try:
        with safe_open(path, framework="pt") as file:
            about = dict(file.metadata() or {})
            tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        raise ValueError(f"expected a fault's dump in {path}, got {error}") from None
    if not tensors.keys() >= NEEDED or not {"scene", "reason"} <= about.keys():
        raise ValueError(f"expected a fault's dump in {path}, got other tensors")
    length = len(tensors[QPOS])
    if any(not value.ndim or len(value) != length for value in tensors.values()):
        raise ValueError(f"expected steps of one length in {path}, got several")
    return about, TensorDict(tensors, [length])


def replay(dump: TensorDict, model: Model) -> list[dict[str, float]]:
    """Every step of a dump ``[T]`` from its recorded state, in the model and in MuJoCo.

    Returns:
        For each step the largest speed before it and after it in both, the largest
        difference of their velocities, and the input's out-of-distribution score.
    """
    tested, ground_truth = dynamics_of(model), MujocoDynamics(model.scene)
    found = []
    tested.reset(dump[:1])
    for now in dump.split(1):
        state = now.select(QPOS, QVEL)
        drive = now["joint_torque"], now.get(TERRAIN, None)
        mine, score = tested.scored_step(state, *drive)
        ground_truth.reset(state)
        exact = ground_truth.step(state, *drive)[QVEL]
        speeds = {
            "speed": state[QVEL],
            "speed, MuJoCo": exact,
            "speed, model": mine[QVEL],
            "difference": mine[QVEL] - exact,
        }
        largest = {
            key: float(x.abs().max()) if x.isfinite().all() else torch.inf
            for key, x in speeds.items()
        }
        largest["OOD score"] = float("nan") if score is None else float(score[0])
        found.append(largest)
    return found
