"""Ways to step a scene: no motion, MuJoCo at many settings, analytic, hybrid, learned."""

import copy
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import torch
from tensordict import TensorDictBase

from torchrl_nerd.analytic import STEPS, default_step, make_step
from torchrl_nerd.checkpoint import from_pretrained, shipped_models
from torchrl_nerd.dynamics import Dynamics, Model, MujocoDynamics, dynamics_of
from torchrl_nerd.keys import QPOS, QVEL
from torchrl_nerd.modules.nerd import NeRD
from torchrl_nerd.modules.transformer import TransformerConfig
from torchrl_nerd.scenes import Scene
from torchrl_nerd.settings import look_up

KINDS = ("baseline", "simulator", "analytic", "hybrid", "learned")
"""In the order of the table."""
VARIANTS = ("compiled", "window", "bf16")
"""Other ways to run one model than eager streaming in float32."""
RIVALS = {
    "implicitfast": mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
    "discrete": mujoco.mjtIntegrator.mjINT_DISCRETE,  # made for large steps
    "RK4": mujoco.mjtIntegrator.mjINT_RK4,
}
COARSE = (1, 4)  # substeps of the rivals


@dataclass(frozen=True)
class Candidate:
    """One way to step a scene."""

    name: str  # of its row in the table
    kind: str  # one of `KINDS`
    # its dynamics, for the scene or the same robot on another terrain
    make: Callable[[Scene], Dynamics]


class NoMotion(Dynamics):
    """Dynamics in which every state stays as it is: the error of predicting nothing."""

    kind = "baseline"

    def step(self, state: TensorDictBase, *given: Any, **more: Any) -> TensorDictBase:
        """The same state."""
        return state.select(QPOS, QVEL)


def mujoco_name(scene: Scene) -> str:
    """Integrator and substeps of a scene's MuJoCo, as its row is called."""
    count = f"{scene.substeps} substep{'s' * (scene.substeps != 1)}"
    return f"MuJoCo {scene.integrator}, {count}"


def simulators(scene: Scene, threads: int | None = None) -> list[Candidate]:
    """No motion; MuJoCo at 1, 2, 4, ... of the scene's substeps, and other integrators.

    ``threads``: of MuJoCo's pool, see `MujocoDynamics`.
    """

    def candidate(substeps: int, integrator: int | None) -> Candidate:
        def make(here: Scene) -> Dynamics:
            return MujocoDynamics(here.with_substeps(substeps, integrator), threads)

        name = mujoco_name(scene.with_substeps(substeps, integrator))
        return Candidate(name, "simulator", make)

    doubling = [2**k for k in range((scene.substeps - 1).bit_length())]
    found = [Candidate("no motion", "baseline", NoMotion)]
    found += [candidate(n, None) for n in (*doubling, scene.substeps)]
    found += [candidate(n, int(rival)) for rival in RIVALS.values() for n in COARSE]
    return list({c.name: c for c in found}.values())


def models(
    scene: Scene,
    names: Sequence[str] = (),
    device: torch.device | str = "cpu",
    variants: Sequence[str] = (),
) -> list[Candidate]:
    """Models of a scene: the analytic step first, then hybrid ones, then learned ones.

    All that are shipped, or those of these ``names`` (checkpoint folders too), each with
    those of the `VARIANTS` that fit it.

    Raises:
        ValueError: an unknown variant; see `from_pretrained`.
    """
    for variant in variants:
        look_up("variant", variant, dict.fromkeys(VARIANTS))
    own = ["analytic"] if analytic_step(scene)[0] else []
    found = []
    for name in dict.fromkeys((*own, *(names or shipped_models(scene)))):
        found += _ways(name, from_pretrained(name, scene).to(device), variants)
    return sorted(found, key=lambda c: KINDS.index(c.kind))


def analytic_step(scene: Scene) -> tuple[str | None, str | None]:
    """The step that ``dynamics="analytic"`` stands for, or the reason why there is none."""
    config = default_step(scene)
    try:
        make_step(scene, config)
    except ValueError as error:
        return None, str(error)
    return next(name for name, step in STEPS.items() if step == config), None


def _ways(name: str, model: Model, variants: Sequence[str]) -> Iterator[Candidate]:
    """A model and its variants; an analytic step has no network and no history."""
    yield _candidate(name, model)
    for variant in variants:
        label = f"{name}, {variant}"
        if variant == "compiled":
            yield _candidate(label, model, compile=True)
        elif isinstance(model, NeRD) and variant == "bf16":
            rounded = copy.deepcopy(model).to(torch.bfloat16)
            yield _candidate(label, rounded)
            if "compiled" in variants:
                yield _candidate(f"{name}, compiled bf16", rounded, compile=True)
        elif isinstance(model, NeRD) and isinstance(model.config, TransformerConfig):
            yield _candidate(label, model, inference="window")


def _candidate(name: str, model: Model, **how: Any) -> Candidate:
    def make(scene: Scene) -> Dynamics:
        here = model if scene is model.scene else model.with_terrain(scene)
        return dynamics_of(here, **how)

    return Candidate(name, model.kind, make)
