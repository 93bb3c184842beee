"""Small robots made for a test, random transitions of MuJoCo, moved robots."""

import copy
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import Generator, Tensor

from torchrl_nerd.data.recorded import Recording
from torchrl_nerd.dynamics import MujocoDynamics
from torchrl_nerd.geometry.rotations import quat_multiply, rotate
from torchrl_nerd.keys import QPOS, QVEL, TERRAIN
from torchrl_nerd.robots import SCENES, load_scene
from torchrl_nerd.scenes import Scene
from torchrl_nerd.scenes.commands import drive, held
from torchrl_nerd.scenes.contact_points import ContactPoints
from torchrl_nerd.scenes.controllers import TorqueController
from torchrl_nerd.scenes.sampling import Sampling, sample_commands
from torchrl_nerd.scenes.variation import Variation

EXCERPT = Path(__file__).parent / "data" / "tosses_excerpt.npz"
"""A dozen tosses of a real cube; source and licence are in the file beside it."""

FLOATER = """
<mujoco><option timestep="0.002" integrator="Euler" cone="elliptic"/><worldbody>
  <geom name="floor" type="plane" size="0 0 1" contype="1" conaffinity="0"/>
  <body pos="0 0 0.5"><freejoint/>
    <geom type="sphere" size="0.2" mass="3" contype="0" conaffinity="1"/>
    <body pos="0.2 0 0.1"><joint name="knee" type="hinge" axis="0 1 0" range="-1.2 1"/>
      <geom type="capsule" fromto="0 0 0 0.3 0 -0.2" size="0.05" mass="0.8"
        contype="0" conaffinity="1"/></body>
    <body pos="-0.2 0.1 0"><joint name="hip" type="ball" pos="0.02 0 0.03"/>
      <geom type="box" pos="-0.2 0 0" size="0.15 0.05 0.04" mass="0.7"
        contype="0" conaffinity="1"/>
      <body pos="-0.3 0 0"><joint name="rod" type="slide" axis="1 0 1" damping="1"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.03" mass="0.3"
          contype="0" conaffinity="1"/></body></body>
  </body></worldbody>
  <actuator><motor joint="knee"/><motor joint="rod"/></actuator></mujoco>"""
"""Floating base with a limited hinge, a ball and a slide, over a plane."""

ARM = """
<mujoco><option timestep="0.002" integrator="Euler" cone="elliptic"/><worldbody>
  <geom name="floor" type="plane" size="0 0 1" quat="0.97 0.2 0.1 0"
    contype="1" conaffinity="0"/>
  <body pos="0.3 -0.2 0.4" quat="0.8 0.3 -0.4 0.3">
    <joint name="shoulder" type="ball"/>
    <geom type="capsule" fromto="0 0 0 0.5 0 0" size="0.06" mass="2"
      contype="0" conaffinity="1"/>
    <body pos="0.5 0 0"><joint name="elbow" type="hinge" axis="0 1 0.2" range="-2 2"/>
      <geom type="capsule" fromto="0 0 0 0.4 0.1 0" size="0.05" mass="1"
        contype="0" conaffinity="1"/></body>
  </body></worldbody><actuator><motor joint="elbow"/></actuator></mujoco>"""
"""Ball and hinge on a mount, fixed and turned, over a fixed and tilted plane."""

PROPS = FLOATER.replace(
    '<body pos="0 0 0.5"><freejoint/>',
    """<body name="ball" pos="1 0 0.3"><freejoint/>
    <geom type="ellipsoid" size="0.1 0.15 0.2" mass="0.5"/></body>
  <body pos="0 1 0.2" quat="0.9 0.2 -0.1 0.3"><body pos="0 0.1 0">
    <joint name="door" type="hinge" axis="0 0.1 1" pos="0.1 0 0"/>
    <geom type="box" size="0.3 0.02 0.4" pos="0.2 0 0" mass="2"/></body></body>
  <body pos="0 0 0.5"><freejoint/>""",
)
"""The floater behind a loose ball, which it is no base of, and a door in the world."""

TABLE = ARM.replace(
    "</worldbody>",
    """<body name="cube" pos="0.6 -0.2 0.6"><freejoint/>
    <geom type="box" size="0.1 0.12 0.15" mass="0.3" contype="2" conaffinity="3"/></body>
  <body pos="0.4 -1 0.6"><joint type="ball"/>
    <geom type="capsule" size="0.05 0.2" mass="0.3" conaffinity="2"/></body>
  </worldbody>""",
)
"""The arm, a loose cube and a pendulum."""


def slow_but(quick: Iterable[Any], names: Iterable[Any]) -> list:
    """All names for `pytest.mark.parametrize`; those that are not quick, marked slow."""
    quick = set(quick)
    return [
        name if name in quick else pytest.param(*_several(name), marks=pytest.mark.slow)
        for name in names
    ]


def _several(values: Any) -> tuple:
    """The values of several parameters, or of one."""
    return values if isinstance(values, tuple) else (values,)


def make_scene(model: mujoco.MjModel | str, name: str = "handmade") -> Scene:
    """A scene of any model, driven by unit torques, two substeps a control step."""
    if isinstance(model, str):
        model = mujoco.MjModel.from_xml_string(model)
    qpos, qvel, torque = (3.0,) * model.nq, (3.0,) * model.nv, (1.0,) * model.nu
    negative = tuple(-x for x in qpos), tuple(-x for x in qvel)
    sampling = Sampling(negative[0], qpos, negative[1], qvel, torque)
    return Scene(name, model, 2, TorqueController(torque), sampling)


FILES = {"floater": FLOATER, "arm": ARM, "props": PROPS, "table": TABLE}
HANDMADE = {name: make_scene(xml, name) for name, xml in FILES.items()}

every_scene = pytest.mark.parametrize(
    "scene",
    [*(load_scene(name) for name in SCENES), *HANDMADE.values()],
    ids=[*SCENES, *HANDMADE],
)
"""All registered scenes, robots with a floating base and a ball joint, and with props."""


def random_states(
    model: mujoco.MjModel, rows: int, rng: np.random.Generator
) -> tuple[Tensor, Tensor]:
    """``qpos (rows, nq)`` about ``qpos0`` and ``qvel (rows, nv)``, of size one."""
    qpos = np.tile(model.qpos0, (rows, 1))
    for row in qpos:
        mujoco.mj_integratePos(model, row, rng.normal(size=model.nv), 1.0)
    return torch.from_numpy(qpos), torch.from_numpy(rng.normal(size=(rows, model.nv)))


def random_transitions(scene: Scene, rows: int, generator: Generator) -> TensorDict:
    """One true control step from random states under random torques, ``[rows]``.

    Holds ``qpos``, ``qvel`` (``terrain``) and ``next`` with ``qpos``, ``qvel`` and
    ``joint_torque``: what any collector would have stored.
    """
    if scene.name in SCENES:
        start, scale = scene.sample_initial(rows, generator)
    else:
        seed = int(torch.randint(2**31, (), generator=generator))
        states = random_states(scene.model, rows, np.random.default_rng(seed))
        start = dict(zip((QPOS, QVEL), states, strict=True))
        scale = torch.ones(rows, 1, dtype=torch.float64)
    torque = sample_commands(scene.sampling, scale, 1, generator)[:, 0]
    return mujoco_step(scene, TensorDict(start, batch_size=[rows]), torque)


def with_points_in_order(scene: Scene, order: Tensor) -> Scene:
    """The same robot, its contact points listed in another order ``(P,)``."""
    points, other = scene.contacts, replace(scene)
    index, place = order.numpy(), order.argsort().tolist()
    vars(other)["contacts"] = ContactPoints(
        bodies=[points.bodies[i] for i in index],
        positions=points.positions[index],
        radii=points.radii[index],
        margins=points.margins[index],
        stands_for=[place[i] if i >= 0 else -1 for i in points.stands_for],
    )
    return other


def in_ground(scene: Scene, rows: int, generator: Generator) -> TensorDict:
    """Random rows, the lowest point up to 5 cm deep where the robot can be moved."""
    drawn = random_transitions(scene, rows, generator)
    depth = 0.05 * torch.rand(rows, dtype=torch.float64, generator=generator)
    if scene.base.is_floating:
        state = {QPOS: drawn[QPOS], QVEL: drawn[QVEL]}
        scene.place_on_terrain(state, -depth)
        drawn[QPOS] = state[QPOS]
    elif scene.terrain.is_per_env:
        gap = scene.clearances(drawn[QPOS], drawn[TERRAIN]).amin(-1)
        drawn[TERRAIN][:, 3] += gap + depth
    return drawn


def mujoco_step(scene: Scene, state: TensorDict, torque: Tensor) -> TensorDict:
    """``state`` with MuJoCo's next state and the torque under ``next``."""
    dynamics = MujocoDynamics(scene, num_threads=1)
    after = dynamics.step(state.select(QPOS, QVEL), torque, state.get(TERRAIN, None))
    assert after[QPOS].isfinite().all()
    return state.clone().set("next", after.set("joint_torque", torque))


def random_quats(rows: int, generator: Generator) -> Tensor:
    """Rotations ``(rows, 4)``, uniform over all of them, both signs."""
    quat = torch.randn(rows, 4, dtype=torch.float64, generator=generator)
    return quat / torch.linalg.vector_norm(quat, dim=-1, keepdim=True)


def yaw_quat(yaw: float) -> Tensor:
    """The turn by ``yaw`` rad about the vertical."""
    return torch.tensor([np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)])


def free_joints(scene: Scene) -> dict[int, int]:
    """Addresses in qpos of all free joints, and in qvel."""
    model = scene.model
    free = model.jnt_type == mujoco.mjtJoint.mjJNT_FREE
    places = model.jnt_qposadr[free].tolist(), model.jnt_dofadr[free].tolist()
    return dict(zip(*places, strict=True))


def moved_scene(scene: Scene, yaw: float, shift: Tensor) -> Scene:
    """The scene with all that is fixed in its world turned about gravity and shifted."""
    model, turn = copy.copy(scene.model), yaw_quat(yaw)
    fixed = [
        (model.geom_pos, model.geom_quat, geom)
        for geom in range(model.ngeom)
        if model.geom_bodyid[geom] == 0
    ]
    fixed += [
        (model.body_pos, model.body_quat, body)
        for body in range(1, model.nbody)
        if model.body_parentid[body] == 0 and model.body_mocapid[body] < 0
    ]
    model.geom_sameframe[model.geom_bodyid == 0] = 0  # or MuJoCo skips the new pose
    for q in free_joints(scene):  # places at rest, or deep in the ground
        fixed.append(
            (model.qpos0[None, q : q + 3], model.qpos0[None, q + 3 : q + 7], 0)
        )
    for positions, quats, index in fixed:
        position = torch.from_numpy(positions[index].copy())
        positions[index] = (rotate(turn, position) + shift).numpy()
        quats[index] = quat_multiply(
            turn, torch.from_numpy(quats[index].copy())
        ).numpy()
    return replace(scene, model=model)


def moved_rows(scene: Scene, rows: TensorDict, yaw: float, shift: Tensor) -> TensorDict:
    """States (and their next ones) of the robot turned about gravity and shifted."""
    rows, turn = rows.clone(), yaw_quat(yaw)
    if TERRAIN in rows.keys():
        normal = rotate(turn, rows[TERRAIN][..., :3])
        offset = rows[TERRAIN][..., 3] + (normal * shift).sum(-1)
        rows[TERRAIN] = torch.cat((normal, offset[..., None]), -1)
    for state in (rows, rows.get("next", None)):
        if state is None:
            continue
        for q, v in free_joints(scene).items():
            qpos, qvel = state[QPOS], state[QVEL]
            qpos[..., q : q + 3] = rotate(turn, qpos[..., q : q + 3]) + shift
            quat = qpos[..., q + 3 : q + 7]
            qpos[..., q + 3 : q + 7] = quat_multiply(turn.expand_as(quat), quat)
            qvel[..., v : v + 3] = rotate(turn, qvel[..., v : v + 3])
    return rows


def random_tree(
    rng: np.random.Generator, is_floating: bool, bodies: int = 6
) -> mujoco.MjModel:
    """A robot of random shape: all joint kinds, anchors off the origin, ``ref``.

    A fixed base stands on a body that is itself fixed somewhere in the world.
    """
    combinations = ["h", "s", "b", "hh", "sh", "sb", ""]
    children: dict[int, list[int]] = {body: [] for body in range(bodies)}
    for body in range(1, bodies):
        children[int(rng.integers(body))].append(body)

    def numbers(count: int) -> str:
        return " ".join(str(x) for x in rng.normal(size=count))

    def joint(letter: str) -> str:
        kind = {"h": "hinge", "s": "slide", "b": "ball"}[letter]
        ref = "" if letter == "b" else f'axis="{numbers(3)}" ref="{numbers(1)}"'
        anchor = f'pos="{numbers(3)}"' if rng.random() < 0.7 else ""
        return f'<joint type="{kind}" {ref} {anchor}/>'

    def xml(body: int) -> str:
        kinds = str(rng.choice(combinations[: 6 if body == 0 else 7]))
        joints = "".join(map(joint, kinds))
        if body == 0 and is_floating:
            joints = "<freejoint/>"
        inside = "".join(xml(child) for child in children[body])
        return (
            f'<body pos="{numbers(3)}" quat="{numbers(4)}">'
            f'<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>{joints}{inside}</body>'
        )

    tree = xml(0)
    if not is_floating:
        tree = f'<body pos="{numbers(3)}" quat="{numbers(4)}">{tree}</body>'
    return mujoco.MjModel.from_xml_string(
        f'<mujoco><compiler angle="radian"/><worldbody>{tree}</worldbody></mujoco>'
    )


def simulated(
    scene: Scene, generator: Generator, trajectories: int = 6, states: int = 20
) -> Recording:
    """A log of MuJoCo motion under random torques or controls."""
    state, scale = scene.sample_initial(trajectories, generator)
    command = sample_commands(scene.sampling, scale, states - 1, generator)
    start, dynamics = TensorDict(state, [trajectories]), MujocoDynamics(scene)
    dynamics.reset(start)
    torque, ctrl = held(scene, command)
    path = dynamics.rollout(start, torque, start.get(TERRAIN, None), ctrl)
    ground = start.get(TERRAIN, None)
    if ground is not None:
        ground = ground.repeat_interleave(states, 0)
    qpos, qvel = (
        torch.cat((start[key][:, None], path[key]), 1).flatten(0, 1)
        for key in (QPOS, QVEL)
    )
    told = torch.cat((command, 0.0 * command[:, :1]), 1).flatten(0, 1)
    torque, ctrl = drive(scene, told, qpos, qvel)
    offsets = states * torch.arange(trajectories + 1)
    frame = scene.control_step
    return Recording(qpos, qvel, torque, offsets, frame, terrain=ground, ctrl=ctrl)


def varied_model(variation: Variation, parameters: Tensor) -> mujoco.MjModel:
    """A model of its own for one env's parameters ``(size,)``."""
    model = copy.copy(variation.model)
    for name, value in variation.fields(parameters.numpy()[None]).items():
        owner = model.opt if name.startswith("opt.") else model
        getattr(owner, name.removeprefix("opt."))[...] = value[0]
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model
