"""What of a scene a model sees, what is left out, and why."""

from dataclasses import dataclass

from torchrl_nerd.analytic import STEPS, default_step, make_step
from torchrl_nerd.configs import NO_PREDICTIONS, FeatureConfig
from torchrl_nerd.keys import (
    CONTACT_DEPTH,
    CONTACT_DISTANCE,
    CONTACT_FORCE,
    CONTACT_NORMAL,
    CONTACT_VELOCITY,
    ROBOT_STATE,
    ROBOT_TORQUE,
)
from torchrl_nerd.modules.features import SceneFeatures
from torchrl_nerd.scenes import Scene
from torchrl_nerd.scenes.contact_points import own_contacts
from torchrl_nerd.scenes.explain import SolverReport
from torchrl_nerd.scenes.terrain import PLANE

MEANINGS = {
    ROBOT_TORQUE: "joint torque, N and N m",
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
class SceneReport:
    """What ``nerd explain`` prints; its text by ``print``.

    | field | meaning |
    |---|---|
    | ``scene`` | its name |
    | ``features`` | of the token, in order |
    | ``solver`` | effect of every coordinate; contact points found, merged, dropped |
    | ``contact_bodies`` | body of each contact point that is kept |
    | ``self_contacts`` | pairs of bodies of the robot that can touch each other |
    | ``terrain`` | the ground, in words |
    | ``controller`` | what turns an action into joint torque, in words |
    | ``analytic_step`` | name of the step that supports the scene; None where none does |
    | ``why_no_step`` | the reason in a sentence where none does |
    """

    scene: str
    features: tuple[Feature, ...]
    solver: SolverReport
    contact_bodies: tuple[str, ...]
    self_contacts: tuple[tuple[str, str], ...]
    terrain: str
    controller: str
    analytic_step: str | None
    why_no_step: str | None

    @property
    def token_width(self) -> int:
        """Numbers that a model sees of one step."""
        return sum(feature.width for feature in self.features)

    def __str__(self) -> str:
        lines = [f"{self.scene}: {self.token_width} features a step", ""]
        lines.append(f"{'feature':<18}{'width':>6}  meaning")
        for feature in self.features:
            lines.append(f"{feature.key:<18}{feature.width:>6}  {feature.meaning}")
        lines += ["", str(self.solver)]
        counts = {b: self.contact_bodies.count(b) for b in self.contact_bodies}
        if counts:
            on = ", ".join(f"{body} {count}" for body, count in counts.items())
            lines.append(f"contact points kept, by body: {on}")
        pairs = ["-".join(pair) for pair in self.self_contacts]
        found = f"{len(pairs)} pairs of bodies, without features: {', '.join(pairs)}"
        lines.append(f"self-contacts: {found if pairs else 'none'}")
        lines.append(f"terrain: {self.terrain}")
        lines.append(f"controller: {self.controller}")
        lines.append(
            f"analytic step: {self.analytic_step or f'none: {self.why_no_step}'}"
        )
        return "\n".join(lines)


def explain(scene: Scene, config: FeatureConfig = NO_PREDICTIONS) -> SceneReport:
    """Report what of a scene is kept, dropped and why.

    Args:
        scene: the robot.
        config: which predictions of the contact law are among the features.

    Examples:
        >>> explain(load_scene("cartpole")).token_width
        7
    """
    features = SceneFeatures(scene, config)
    sizes = {**features.robot.sizes, **features.contact.sizes}
    meanings = {ROBOT_STATE: _state_meaning(scene), **MEANINGS}
    model = scene.model

    def body_of(geom: int) -> str:
        return _body_name(scene, int(model.geom_bodyid[geom]))

    pairs = {tuple(sorted((body_of(a), body_of(b)))) for a, b in own_contacts(model)}
    step, reason = _analytic_step(scene)
    return SceneReport(
        scene=scene.name,
        features=tuple(
            Feature(str(key), width, meanings[str(key)]) for key, width in sizes.items()
        ),
        solver=scene.explain(),
        contact_bodies=tuple(_body_name(scene, body) for body in scene.contacts.bodies),
        self_contacts=tuple((low, high) for low, high in sorted(pairs)),
        terrain=_terrain(scene, CONTACT_NORMAL in sizes),
        controller=f"{type(scene.controller).__name__}, "
        f"{scene.controller.num_actions} actions",
        analytic_step=step,
        why_no_step=reason,
    )


def _body_name(scene: Scene, body: int) -> str:
    return scene.model.body(body).name or f"body {body}"


def _state_meaning(scene: Scene) -> str:
    """Parts of ``robot_state``, see `RobotCentric`."""
    parts = []
    if scene.base.is_floating:
        parts.append("base velocity and gravity in the base frame")
    parts.append("joint positions (sine and cosine of a hinge without limits)")
    parts.append("joint velocities")
    if scene.model.jnt_limited.any():
        parts.append("gaps to joint limits")
    return ", ".join(parts)


def _terrain(scene: Scene, has_normal: bool) -> str:
    terrain = scene.terrain
    if terrain is None:
        return "none that the robot can touch"
    surfaces = terrain.surfaces
    planes = sum(surface.kind == PLANE for surface in surfaces)
    where = "drawn for each trajectory" if terrain.is_per_row else "fixed"
    normal = "a feature" if has_normal else "no feature: it follows from the state"
    shapes = f"{planes} plane{'s' * (planes != 1)}"
    if planes < len(surfaces):
        shapes += f", {len(surfaces) - planes} other surfaces"
    return f"{shapes}, {where}; the normal is {normal}"


def _analytic_step(scene: Scene) -> tuple[str | None, str | None]:
    """The step that ``dynamics="analytic"`` stands for, or the reason why there is none."""
    config = default_step(scene)
    try:
        make_step(scene, config)
        return next(name for name, step in STEPS.items() if step == config), None
    except ValueError as error:
        return None, str(error)
