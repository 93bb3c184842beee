"""Who takes part: MuJoCo, coarse and fine, and learned models in several ways to run."""

import copy
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import cast

import mujoco
import torch

from torchrl_nerd.checkpoint import from_pretrained, shipped_models
from torchrl_nerd.dynamics import GuardedDynamics, MujocoDynamics, NeRDDynamics
from torchrl_nerd.dynamics.base import Dynamics
from torchrl_nerd.modules.mlp import MLPConfig
from torchrl_nerd.modules.nerd import NeRD
from torchrl_nerd.scenes import Scene

SUBSTEPS = (1, 2, 4, 8, 16, 32)
INTEGRATORS = {
    "implicitfast": mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
    "RK4": mujoco.mjtIntegrator.mjINT_RK4,
}
FINEST = 64  # substeps of a truth in contact, or four times the scene's own


@dataclass(frozen=True)
class Contender:
    """One way to step a scene.

    | field | meaning |
    |---|---|
    | ``name`` | of its row |
    | ``is_learned`` | True for a NeRD |
    | ``make`` | its dynamics over a scene's ground |
    """

    name: str
    is_learned: bool
    make: Callable[[Scene], Dynamics]


def contenders(
    scene: Scene,
    threads: int,
    is_compiling: bool = True,
    device: torch.device | str = "cpu",
    models: Sequence[str] = (),
) -> list[Contender]:
    """Everyone who takes part in a scene's race.

    Args:
        scene: the robot.
        threads: of MuJoCo's pool.
        is_compiling: let learned models also run compiled.
        device: of learned models.
        models: see `learned_contenders`.
    """
    return [
        *mujoco_contenders(scene, threads),
        *learned_contenders(scene, is_compiling, device, models),
    ]


def mujoco_contenders(scene: Scene, threads: int) -> Iterator[Contender]:
    """MuJoCo with few substeps to many, its own among them, and other integrators."""

    def row(name: str, substeps: int, integrator: int | None = None) -> Contender:
        return Contender(
            name,
            False,
            lambda scene: MujocoDynamics(
                scene.with_substeps(substeps, integrator), num_threads=threads
            ),
        )

    for substeps in sorted({*SUBSTEPS, scene.substeps}):
        yield row(f"MuJoCo x{substeps}", substeps)
    for name, integrator in INTEGRATORS.items():
        for substeps in (1, 4):
            yield row(f"MuJoCo {name} x{substeps}", substeps, int(integrator))


def learned_contenders(
    scene: Scene,
    is_compiling: bool,
    device: torch.device | str = "cpu",
    models: Sequence[str] = (),
) -> Iterator[Contender]:
    """Models of a scene, streaming and otherwise.

    Args:
        scene: the robot.
        is_compiling: let them also run compiled.
        device: theirs.
        models: names of shipped ones, or checkpoint folders; all that are shipped for the
            robot where none are given.

    Raises:
        ValueError: see `from_pretrained`.
    """
    shipped = [
        name
        for name in shipped_models()
        if name == scene.name or name.startswith(f"{scene.name}-")
    ]
    for name in models or shipped:
        model = from_pretrained(name, scene).to(device)
        if not isinstance(model, NeRD):
            continue
        yield _learned(name, model)
        yield Contender(f"{name}, guarded", True, _guarded(model))
        if is_compiling:
            yield _learned(f"{name}, compiled", model, compile=True)
        if not isinstance(model.config, MLPConfig):  # no history
            yield _learned(f"{name}, window", model, inference="window")
        half = copy.deepcopy(model).to(torch.bfloat16)
        yield _learned(f"{name}, bf16", half)
        if is_compiling:
            yield _learned(f"{name}, bf16 compiled", half, compile=True)


def _learned(name: str, model: NeRD, **how: object) -> Contender:
    def make(scene: Scene) -> NeRDDynamics:
        here = model if scene is model.scene else model.with_terrain(scene)
        return NeRDDynamics(here, **how)  # pyright: ignore

    return Contender(name, True, make)


def _guarded(model: NeRD) -> Callable[[Scene], Dynamics]:
    plain = _learned("", model).make
    return lambda scene: GuardedDynamics(cast(NeRDDynamics, plain(scene)))


def truth(scene: Scene, threads: int) -> MujocoDynamics:
    """MuJoCo so fine that the rest of the error no longer counts.

    RK4 where nothing touches; impacts leave it no order to gain, and take more substeps.
    """
    finest = scene.reference
    if scene.terrain is not None:
        finest = scene.with_substeps(max(FINEST, 4 * scene.substeps))
    return MujocoDynamics(finest, num_threads=threads)
