"""A few steps stored with the weights, and whether this machine repeats them.

A checkpoint says which physics it learned; another MuJoCo, processor or library may step
differently. Some states, what MuJoCo made of them where the model was trained, and what the
model itself made of them are stored with it and tried again when it is loaded.
"""

import warnings
from dataclasses import dataclass
from pathlib import Path

from tensordict import TensorDict
from torch import Generator, Tensor

from torchrl_nerd.dynamics import Model, MujocoDynamics, dynamics_of
from torchrl_nerd.keys import PARAMETERS, QPOS, QVEL, TERRAIN
from torchrl_nerd.modules.nerd import NeRD
from torchrl_nerd.scenes import Scene
from torchrl_nerd.scenes.commands import command_key, drive

PREFIX = "check."  # of the names of what is stored
ROWS = 8
MUJOCO_TOLERANCE, MODEL_TOLERANCE = 1e-6, 1e-3  # relative to 1 + the largest number


@dataclass(frozen=True)
class SelfCheck:
    """How far next states of this machine are from the stored ones, relative."""

    mujoco: float  # of MuJoCo
    model: float  # of the model

    @property
    def agrees(self) -> bool:
        """Whether both are within their tolerance."""
        return self.mujoco <= MUJOCO_TOLERANCE and self.model <= MODEL_TOLERANCE


def stored_steps(model: Model, scene: Scene) -> dict[str, Tensor]:
    """A few steps of this machine, to be kept among the model's weights.

    ``scene`` is the model's own, as the data were stepped, see `Scene.reference`.
    """
    start, scale = scene.sample_initial(ROWS, Generator().manual_seed(0))
    if isinstance(model, NeRD) and (told := model.scene_features.variation) is not None:
        start[PARAMETERS] = told.draw(ROWS, Generator().manual_seed(0))
    middle, half = scene.sampling.commands
    given = {**start, command_key(scene)[1]: middle + scale * half}
    return {PREFIX + k: v for k, v in (given | _steps(model, scene, given)).items()}


def self_check(
    model: Model, scene: Scene, tensors: dict[str, Tensor], where: str
) -> SelfCheck | None:
    """Step the states among a checkpoint's tensors again; None where there are none.

    ``scene`` is that of `stored_steps`; ``where`` names the file, for the sentence.

    Raises:
        ValueError: states of another robot.
    """
    found = (item for item in tensors.items() if item[0].startswith(PREFIX))
    stored = {key.removeprefix(PREFIX): value for key, value in found}
    if not stored:
        return None
    try:
        made = _steps(model, scene, stored)
        worst = {key: _difference(value, stored[key]) for key, value in made.items()}
    except (KeyError, RuntimeError, TypeError, ValueError, IndexError) as error:
        raise ValueError(
            f"expected a few steps of '{model.scene.name}' in {where}, got "
            f"something else: {str(error).splitlines()[0]}"
        ) from None
    kinds = ("mujoco", "model")
    return SelfCheck(*(max(worst[f"{k}_{key}"] for key in (QPOS, QVEL)) for k in kinds))


def warn_of_differences(check: SelfCheck, folder: Path) -> None:
    """Say in one sentence what this machine does differently, if it does."""
    if not check.agrees:
        warnings.warn(
            f"this machine does not repeat the steps stored in {folder}: MuJoCo differs "
            f"by {check.mujoco:.1e} (up to {MUJOCO_TOLERANCE:.0e} expected), the model by "
            f"{check.model:.1e} (up to {MODEL_TOLERANCE:.0e}), relative",
            stacklevel=3,
        )


def _steps(model: Model, scene: Scene, given: dict[str, Tensor]) -> dict[str, Tensor]:
    """One step of MuJoCo and of the model."""
    kept = {key: given[key] for key in (QPOS, QVEL, PARAMETERS) if key in given}
    state = TensorDict(kept, [len(given[QPOS])])
    driven = drive(scene, given[command_key(scene)[1]], state[QPOS], state[QVEL])
    (torque, ctrl), terrain = driven, given.get(TERRAIN)
    made, mujoco = {}, MujocoDynamics(scene, num_threads=1)
    for kind, dynamics in (("mujoco", mujoco), ("model", dynamics_of(model))):
        dynamics.reset(state)
        after = dynamics.step(state, torque, terrain, ctrl)
        made |= {f"{kind}_{key}": after[key] for key in (QPOS, QVEL)}
    return made


def _difference(a: Tensor, b: Tensor) -> float:
    """Largest difference relative to 1 + the largest number; NaN equals NaN."""
    a, b = a.nan_to_num(0.0), b.nan_to_num(0.0)
    if a.shape != b.shape:
        raise ValueError(f"shapes {tuple(a.shape)} and {tuple(b.shape)}")
    return float((a - b).abs().max() / (1.0 + b.abs().max())) if a.numel() else 0.0
