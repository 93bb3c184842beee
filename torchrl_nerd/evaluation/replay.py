"""The steps before a fault again, in the model and in MuJoCo, from its dump."""

from dataclasses import dataclass
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from tensordict import TensorDict
from torch import Tensor

from torchrl_nerd.dynamics import Model, MujocoDynamics, dynamics_of
from torchrl_nerd.keys import QPOS, QVEL, TERRAIN
from torchrl_nerd.robots import load_scene
from torchrl_nerd.scenes import Scene


@dataclass(frozen=True)
class Dump:
    """What a fault left; see `envs.faults`.

    | field | meaning |
    |---|---|
    | ``about`` | scene, dynamics, reason, env |
    | ``steps`` | ``[T]``: states, actions and torques up to the fault |
    """

    about: dict[str, str]
    steps: TensorDict

    @property
    def scene(self) -> Scene:
        """The robot."""
        return load_scene(self.about["scene"])


def read_dump(path: Path) -> Dump:
    """A dump from disk.

    Raises:
        ValueError: a file that is not there, or is no dump.
    """
    keys = {QPOS, QVEL, "action", "joint_torque"}
    try:
        with safe_open(path, framework="pt") as file:
            about = dict(file.metadata() or {})
            tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        raise ValueError(f"expected a fault's dump in {path}, got {error}") from None
    if not keys <= tensors.keys() or not {"scene", "reason"} <= about.keys():
        raise ValueError(f"expected a fault's dump in {path}, got other tensors")
    length = len(tensors[QPOS])
    if any(not value.ndim or len(value) != length for value in tensors.values()):
        raise ValueError(f"expected steps of one length in {path}, got several")
    return Dump(about, TensorDict(tensors, [length]))


def replay(dump: Dump, model: Model) -> list[dict[str, float]]:
    """Every step of a dump from its recorded state, in the model and in MuJoCo.

    Returns:
        For each step the largest speed before it and after it in both, the largest
        difference of their velocities, and the input's out-of-distribution score.
    """
    tested, ground_truth = dynamics_of(model), MujocoDynamics(dump.scene)
    found = []
    tested.reset(dump.steps[:1])
    for step in range(len(dump.steps)):
        now = dump.steps[step : step + 1]
        terrain = now.get(TERRAIN, None)
        state, torque = now.select(QPOS, QVEL), now["joint_torque"]
        mine, score = tested.scored_step(state, torque, terrain)
        ground_truth.reset(state)
        exact = ground_truth.step(state, torque, terrain)
        found.append(
            {
                "speed": _largest(state[QVEL]),
                "speed, MuJoCo": _largest(exact[QVEL]),
                "speed, model": _largest(mine[QVEL]),
                "difference": _largest(mine[QVEL] - exact[QVEL]),
                "OOD score": float("nan") if score is None else float(score[0]),
            }
        )
    return found


def _largest(x: Tensor) -> float:
    return float(x.abs().max()) if x.isfinite().all() else torch.inf
