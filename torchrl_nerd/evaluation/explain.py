"""What of a scene a model sees, what is left out, and why."""

from collections import Counter
from dataclasses import dataclass
from itertools import chain

import numpy as np
from torch import Generator

from torchrl_nerd.data.simulate import is_sound, simulate
from torchrl_nerd.evaluation.bench.candidates import analytic_step, mujoco_name
from torchrl_nerd.keys import (
    CONTACT_DEPTH,
    CONTACT_DISTANCE,
    CONTACT_FORCE,
    CONTACT_NORMAL,
    CONTACT_VELOCITY,
    QPOS,
    ROBOT_CTRL,
    ROBOT_STATE,
    ROBOT_TORQUE,
)
from torchrl_nerd.modules.nerd import SceneFeatures
from torchrl_nerd.scenes import Scene
from torchrl_nerd.scenes.contact_points import body_label, ground_geoms, own_contacts
from torchrl_nerd.scenes.penetration import touching_bodies
from torchrl_nerd.scenes.symmetries import Effect, periodic_hinges, why_all_kept
from torchrl_nerd.scenes.terrain import PLANE

SERVOS = "; servos: the control is held, MuJoCo evaluates their law in every substep"
DROPPED = "dropped: the step does not depend on it"
FALLS = '; it falls freely, unless Scene.from_mjcf(..., terrain="plane") adds one'
TRAJECTORIES = 64, 20  # and their steps: what self-contacts are counted in
MEANINGS = {
    ROBOT_TORQUE: "joint torque, N and N m",
    ROBOT_CTRL: "control of every servo, held over the step",
    CONTACT_DISTANCE: "clearance to the ground minus the margin, m; 0 beyond the margin",
    CONTACT_VELOCITY: "velocity along and across the ground's normal, m/s",
    CONTACT_DEPTH: "predicted penetration at several times of the step, m",
    CONTACT_FORCE: "predicted contact force on each degree of freedom, N and N m",
    CONTACT_NORMAL: "normal of the ground in the base frame",
}
"""Meaning of every feature but ``robot_state``, see `_state_meaning`."""


@dataclass(frozen=True)
class Feature:
    """One key of the token, its width and its meaning."""

    key: str
    width: int
    meaning: str


@dataclass(frozen=True)
class SelfContact:
    """Two bodies of a robot that can touch, and how often they do in training data."""

    bodies: tuple[str, str]
    share: float  # of states


@dataclass(frozen=True)
class SceneReport:
    """What ``nerd explain`` prints; its text by ``print``."""

    scene: str
    features: tuple[Feature, ...]  # of the token, in order
    control_step: float  # s
    solver: str  # integrator and substeps, see `mujoco_name`
    effects: tuple[Effect, ...]  # of hinges and slides
    why_all_kept: str | None  # the reason where hinges and slides are not moved
    points_found: int  # contact points of the robot's shapes
    points_merged: int  # of these, how many always coincide with another one
    points_fixed: int  # of these, how many no joint can move
    points_thinned: int  # left out beside them, so that few points stand for each body
    contact_error: float  # m: how far a shape reaches beyond its points at most
    contact_bodies: tuple[str, ...]  # body of each contact point that is kept
    self_contacts: tuple[SelfContact, ...]  # of bodies that can touch, most often first
    terrain: str  # the ground, in words
    controller: str  # what turns an action into joint torque, in words
    analytic_step: str | None  # name of the step that supports the scene, if any does
    why_no_step: str | None  # the reason in a sentence where none does

    @property
    def token_width(self) -> int:
        """Numbers that a model sees of one step."""
        return sum(feature.width for feature in self.features)

    def __str__(self) -> str:
        bodies = Counter(self.contact_bodies).items()
        lines = [
            f"{self.scene}: {self.token_width} features a step\n",
            f"{'feature':<18}{'width':>6}  meaning",
            *(f"{f.key:<18}{f.width:>6}  {f.meaning}" for f in self.features),
            f"\n{'coordinate moved':<30}{'change of step':>16}  feature",
        ]
        for effect in self.effects:
            what = f"{effect.name} {effect.key}[{effect.address}]"
            verdict = DROPPED if effect.is_ignored else "kept"
            lines.append(f"{what:<30}{effect.change:>16.1e}  {verdict}")
        if self.why_all_kept is not None:
            lines.append(f"every hinge and slide is kept: {self.why_all_kept}")
        lines.append(
            f"contact points: {self.points_found} found, {self.points_merged} merged "
            f"with one at the same place, {self.points_fixed} dropped since no joint "
            f"moves them, {len(self.contact_bodies)} kept"
        )
        if self.contact_error:
            lines.append(
                f"contact points thinned: {self.points_thinned} left out, so shapes "
                f"reach up to {1e3 * self.contact_error:.1f} mm beyond the rest; "
                "max_contact_points= of Scene.from_mjcf sets their number"
            )
        if bodies:
            on = ", ".join(f"{body} {count}" for body, count in bodies)
            lines.append(f"contact points kept, by body: {on}")
        lines += [
            f"self-contacts: {self._touching()}",
            f"terrain: {self.terrain}",
            f"control step: {self.control_step:.6g} s, {self.solver}",
            f"controller: {self.controller}",
            f"analytic step: {self.analytic_step or f'none: {self.why_no_step}'}",
        ]
        return "\n".join(lines)

    def _touching(self) -> str:
        """Which bodies touch each other, and in how many states of training data."""
        if not self.self_contacts:
            return "none"
        touch = [pair for pair in self.self_contacts if pair.share]
        shares = (f"{'-'.join(pair.bodies)} {pair.share:.1%}" for pair in touch)
        never = len(self.self_contacts) - len(touch)
        also = [f"{never} pairs in none"] if never else []
        return (
            f"{len(self.self_contacts)} pairs of bodies, features with --self-contact "
            "alone; share of random states in which they touch: "
            + ", ".join([*shares, *also])
        )


def explain(scene: Scene) -> SceneReport:
    """Report what of a scene is kept, dropped and why.

    Examples:
        >>> explain(load_scene("cartpole")).token_width
        7
    """
    features, model = SceneFeatures(scene), scene.model
    sizes = {**features.robot.sizes, **features.contact.sizes}
    meanings = {ROBOT_STATE: _state_meaning(scene), **MEANINGS}
    found, kept = scene.contacts.stands_for, len(scene.contacts)
    fixed, controller = found.count(-1), scene.controller
    servos = scene.servos is not None
    step, reason = analytic_step(scene)
    return SceneReport(
        scene=scene.name,
        features=tuple(Feature(str(k), n, meanings[str(k)]) for k, n in sizes.items()),
        control_step=scene.control_step,
        solver=mujoco_name(scene),
        why_all_kept=why_all_kept(model),
        effects=scene.symmetries.effects,
        points_found=len(found),
        points_merged=len(found) - fixed - kept,
        points_fixed=fixed,
        points_thinned=scene.contacts.thinned,
        contact_error=scene.contacts.error,
        contact_bodies=tuple(body_label(model, b) for b in scene.contacts.bodies),
        self_contacts=_self_contacts(scene),
        terrain=_terrain(scene, CONTACT_NORMAL in sizes),
        controller=f"{type(controller).__name__}, "
        + _count(controller.num_actions, "action")
        + SERVOS * servos,
        analytic_step=step,
        why_no_step=reason,
    )


def _self_contacts(scene: Scene) -> tuple[SelfContact, ...]:
    """Pairs of bodies that can touch, those that touch most often first."""
    model = scene.model
    bodies = np.sort(model.geom_bodyid[own_contacts(model)]).reshape(-1, 2)
    pairs = {(int(low), int(high)) for low, high in bodies}
    if not pairs:
        return ()
    data = simulate(scene, *TRAJECTORIES, Generator().manual_seed(0))
    states = data["next", QPOS][is_sound(data)].flatten(0, 1)
    counts = Counter(chain.from_iterable(touching_bodies(model, states)))
    return tuple(
        SelfContact(
            (body_label(model, low), body_label(model, high)),
            counts[low, high] / max(1, len(states)),
        )
        for low, high in sorted(pairs, key=lambda pair: (-counts[pair], pair))
    )


def _state_meaning(scene: Scene) -> str:
    """Parts of ``robot_state``, see `RobotCentric`."""
    parts = ["base velocity and gravity in the base frame"] * scene.base.is_floating
    periodic = periodic_hinges(scene.model, scene.servos is not None)
    turns = " (sine and cosine of a hinge without limits)"
    parts.append("joint positions" + turns * bool(periodic))
    parts.append("joint velocities")
    parts += ["gaps to joint limits"] * bool(scene.model.jnt_limited.any())
    return ", ".join(parts)


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'s' * (number != 1)}"


def _terrain(scene: Scene, has_normal: bool) -> str:
    terrain = scene.terrain
    if terrain is None and ground_geoms(scene.model):
        return "shapes that no feature shows"
    if terrain is None:
        return "none that the robot can touch" + FALLS * scene.base.is_floating
    planes = sum(surface.kind == PLANE for surface in terrain.surfaces)
    where = "drawn for each trajectory" if terrain.is_per_env else "fixed"
    normal = "a feature" if has_normal else "no feature: it follows from the state"
    kinds = {"plane": planes, "other surface": len(terrain.surfaces) - planes}
    shapes = ", ".join(_count(n, name) for name, n in kinds.items() if n)
    return f"{shapes}, {where}; the normal is {normal}"
