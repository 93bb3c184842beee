"""The scene compiler's report: what a network sees of a robot, and why that is enough."""

from dataclasses import dataclass
from typing import cast

import mujoco
import torch
from tensordict import TensorDict
from torch import Generator

from torchrl_nerd.evaluation.explain.dependence import Dependence, dependences
from torchrl_nerd.evaluation.explain.features import NORMAL, Kind, feature_kinds
from torchrl_nerd.evaluation.explain.paper_input import (
    BASE_POSE,
    CLOSEST,
    DISTANCES,
    GRAVITY_B,
    NORMALS,
    PUBLISHED,
    TORQUES,
    PaperInput,
)
from torchrl_nerd.evaluation.explain.rebuild import Piece, rebuild_errors
from torchrl_nerd.evaluation.explain.states import draw_states
from torchrl_nerd.evaluation.explain.timing import StepTime, time_inputs
from torchrl_nerd.keys import QPOS, TERRAIN
from torchrl_nerd.modules.networks import network_config
from torchrl_nerd.scenes import Scene
from torchrl_nerd.scenes.explain import SolverReport
from torchrl_nerd.settings import expect_at_least

RANKED = 48  # states at which ranks are taken


@dataclass(frozen=True)
class Dropped:
    """Something that the paper's input has and the compact one has not.

    | field | meaning |
    |---|---|
    | ``what`` | coordinate or piece |
    | ``width`` | numbers of the paper's input |
    | ``why`` | it is not needed |
    | ``proof`` | what was measured |
    """

    what: str
    width: int
    why: str
    proof: str


@dataclass(frozen=True)
class SceneReport:
    """All that ``nerd explain`` prints.

    | field | meaning |
    |---|---|
    | ``scene``, ``states``, ``seed`` | whose, and the random states asked |
    | ``size``, ``paper_size`` | numbers in the compact token and in the paper's input |
    | ``published`` | what the released networks take, where there is one |
    | ``kinds``, ``dependences`` | of the compact token, in the same order |
    | ``dropped`` | what the paper has besides |
    | ``pieces`` | of the paper's input, rebuilt |
    | ``solver`` | effect of every coordinate; contact points |
    | ``timing`` | None where it was not asked for |
    """

    scene: str
    states: int
    seed: int
    size: int
    paper_size: int
    published: int | None
    kinds: tuple[Kind, ...]
    dependences: tuple[Dependence, ...]
    dropped: tuple[Dropped, ...]
    pieces: tuple[Piece, ...]
    solver: SolverReport
    timing: StepTime | None

    @property
    def unused(self) -> list[str]:
        """Kinds that the true solver's step does not depend on: none in a good scene."""
        return [d.kind for d in self.dependences if not d.is_used]

    @property
    def derived(self) -> list[str]:
        """Kinds that are functions of the others, kept since they are slow to learn."""
        return [kind.name for kind in self.kinds if kind.is_derived]


def explain(
    scene: Scene,
    rows: int = 1024,
    seed: int = 0,
    network: str | None = "transformer-2x64",
) -> SceneReport:
    """Question a scene.

    Args:
        scene: the robot.
        rows: random states; those that MuJoCo gave up on are left out.
        seed: of the states and alterations.
        network: what to time both inputs with; None for no timing.

    Raises:
        SettingError: too few rows.
        ValueError: no such network.

    Examples:
        >>> report = explain(load_scene("cartpole"), network=None)
        >>> report.size, report.unused
        (7, [])
    """
    expect_at_least(16, rows=rows)
    if network is not None:
        network_config(network)
    generator = Generator().manual_seed(seed)
    states = draw_states(scene, rows, generator)
    kinds = feature_kinds(scene, _telling(scene, states))
    pieces, solver = rebuild_errors(scene, states), scene.explain()
    return SceneReport(
        scene=scene.name,
        states=len(states),
        seed=seed,
        size=sum(kind.width for kind in kinds),
        paper_size=PaperInput(scene).size,
        published=PUBLISHED.get(scene.name),
        kinds=kinds,
        dependences=dependences(scene, states, generator),
        dropped=tuple(_dropped(scene, kinds, pieces, solver)),
        pieces=pieces,
        solver=solver,
        timing=None if network is None else time_inputs(scene, states, network),
    )


def _telling(scene: Scene, states: TensorDict) -> TensorDict:
    """A few of the states, half of them with all points as near the ground as can be."""
    if scene.terrain is None:
        return states[:RANKED]
    gap = scene.clearances(states[QPOS], states.get(TERRAIN, None)).amax(-1)
    nearest = gap.argsort()[: RANKED // 2]
    return cast(TensorDict, torch.cat((states[nearest], states[: RANKED // 2])))


def _dropped(
    scene: Scene,
    kinds: tuple[Kind, ...],
    pieces: tuple[Piece, ...],
    solver: SolverReport,
) -> list[Dropped]:
    """What is left out, each with what was measured about it."""
    paper = {piece.name: piece for piece in pieces}
    found: list[Dropped] = []
    for effect in solver.effects:
        if effect.is_ignored:
            what, is_base = (
                f"{effect.name} {effect.key}",
                effect.name.startswith("base "),
            )
            why = "the true step does not depend on it"
            if is_base:
                why += "; the ground is seen by contact"
            proof = f"moved: step changes by {effect.change:.0e}"
            found.append(Dropped(what, 0 if is_base else 1, why, proof))

    def rebuilt(name: str, width: int, why: str) -> None:
        if name in paper and width:
            error = paper[name].error
            proof = f"rebuilt within {error:.0e}" if error else "rebuilt exactly"
            found.append(Dropped(name, width, why, proof))

    is_floating = scene.base.is_floating
    rebuilt(BASE_POSE, 7, "constant: the base seen from itself")
    if not is_floating:
        rebuilt(GRAVITY_B, 3, "fixed base: follows from its joint's angle")
    passive = sorted(set(range(6 * is_floating, scene.model.nv)) - set(scene.actuated))
    joints = ", ".join(dict.fromkeys(_joint_of(scene.model, dof) for dof in passive))
    rebuilt(TORQUES, len(passive), f"passive joints have none: {joints}")
    merged, still = 7 * solver.points_merged, 7 * solver.points_still
    kept = solver.points_kept
    if merged:
        proof = f"{solver.points_merged} of {solver.points_found} points"
        why = "contact points that always coincide with another"
        found.append(Dropped("merged points", merged, why, proof))
    if still:
        proof = f"{solver.points_still} of {solver.points_found} points"
        why = "no joint moves them: only friction at a turning rim is lost"
        found.append(Dropped("still points", still, why, proof))
    if paper.get(DISTANCES):
        why = "follow from kinematics, normal and distance"
        rebuilt(CLOSEST, 3 * kept, why)
    if NORMAL not in {kind.name for kind in kinds}:
        why = "level ground: follow from gravity"
        if not is_floating:
            why = "fixed base and ground: constant, or follow from joint positions"
        rebuilt(NORMALS, 3 * kept, why)
    return found


def _joint_of(model: mujoco.MjModel, dof: int) -> str:
    joint = int(model.dof_jntid[dof])
    return model.joint(joint).name or f"joint {joint}"
