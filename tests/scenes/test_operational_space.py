"""The law of operational-space control against MuJoCo's own accelerations."""

from math import inf, nan

import mujoco
import numpy as np
import pytest
import torch

from torchrl_nerd.robots import load_scene
from torchrl_nerd.robots.franka.scene import GAIN, HOME
from torchrl_nerd.scenes.operational_space import OperationalSpaceController

ARMS = ("franka", "franka_gravity")
SITE, ROWS = "end_effector", 16


TWO_LINKS = """<mujoco><option gravity="0 0 0"/><worldbody><body>
  <joint name="a" axis="0 0 1"/><geom size="0.01" pos="1 0 0" mass="1"/>
  <body pos="1 0 0"><joint name="b" axis="0 0 1"/><site name="tip" pos="1 0 0"/>
    <geom size="0.01" pos="1 0 0" mass="1"/></body></body></worldbody>
  <actuator><motor joint="a"/><motor joint="b"/></actuator></mujoco>"""
"""In the plane: 1 kg at each end of two links of 1 m."""
MASS_MATRIX = torch.tensor([[5.0, 2.0], [2.0, 1.0]]).double()  # kg m^2, stretched


def two_links(**changes):
    model = mujoco.MjModel.from_xml_string(TWO_LINKS)
    numbers = {"kp": (50.0,) * 3, "kd": (9.0,) * 3, "scale": (0.1,) * 3}
    numbers |= {"home": (0.0, 0.5), **changes}
    return OperationalSpaceController(model, "tip", **numbers)


def controller(name="franka", size=3, **changes):
    numbers = {"kp": (50.0,) * size, "kd": (0.0,) * size, "scale": (0.1,) * size}
    model = load_scene(name).model
    return OperationalSpaceController(
        model, SITE, **{**numbers, "home": HOME, **changes}
    )


def random_state(rng, spread=0.4):
    qpos = np.array(HOME) + rng.uniform(-spread, spread, (ROWS, 7))
    return torch.from_numpy(qpos), torch.from_numpy(rng.normal(size=(ROWS, 7)))


def mujoco_acceleration(name, qpos, qvel, torque):
    """Of the joints ``(rows, 7)`` and, linear and angular, of the site ``(rows, 6)``.

    The latter from MuJoCo's Jacobian and its derivative.
    """
    model = load_scene(name).model
    data, joints, site = mujoco.MjData(model), [], []
    index, body = model.site(SITE).id, int(model.site(SITE).bodyid[0])
    for q, v, push in zip(qpos.numpy(), qvel.numpy(), torque.numpy(), strict=True):
        mujoco.mj_resetData(model, data)
        data.qpos, data.qvel, data.qfrc_applied = q, v, push
        mujoco.mj_forward(model, data)
        jacobian, rate = np.zeros((2, 6, model.nv))
        mujoco.mj_jacSite(model, data, jacobian[:3], jacobian[3:], index)
        place = data.site_xpos[index]
        mujoco.mj_jacDot(model, data, rate[:3], rate[3:], place, body)
        joints.append(data.qacc.copy())
        site.append(jacobian @ data.qacc + rate @ v)
    return torch.from_numpy(np.array(joints)), torch.from_numpy(np.array(site))


@pytest.mark.parametrize("size", [3, 6])
@pytest.mark.parametrize("name", ARMS)
def test_the_hand_accelerates_as_told(name, size, rng):
    """With no bound on its mass, whatever the arm's motion, gravity and damping."""
    qpos, qvel = random_state(rng)
    told = torch.from_numpy(rng.normal(size=(ROWS, size)))
    law = controller(name, size, max_mass=inf)
    torque = law.torque(told, qpos, qvel)
    _, site = mujoco_acceleration(name, qpos, qvel, torque)
    torch.testing.assert_close(site[:, :size], told, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("name", ARMS)
def test_an_action_is_a_spring_to_a_displacement_and_a_damper(name, rng):
    qpos, qvel = random_state(rng)
    law = controller(name, kd=(7.0, 8.0, 9.0), scale=(0.1, 0.2, 0.3), max_mass=inf)
    action = torch.from_numpy(rng.uniform(-2.0, 2.0, (ROWS, 3)))
    _, site = mujoco_acceleration(name, qpos, qvel, law(action, qpos, qvel))
    speed = (law.site(qpos).jacobian @ qvel[..., None])[..., 0]
    displacement = action.clamp(-1.0, 1.0) * qpos.new_tensor([0.1, 0.2, 0.3])
    want = 50.0 * displacement - qpos.new_tensor([7.0, 8.0, 9.0]) * speed[:, :3]
    torch.testing.assert_close(site[:, :3], want, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("size", [3, 6])
def test_free_joints_go_home_by_what_does_not_move_the_hand(size, rng):
    """q'' = u + M^-1 J^T F: what is left of u has no part that a force at the hand has."""
    qpos, qvel = random_state(rng)
    law = controller(size=size, max_mass=inf, home_kp=4.0, home_kd=3.0)
    torque = law.torque(torch.zeros(ROWS, size).double(), qpos, qvel)
    joints, _ = mujoco_acceleration("franka", qpos, qvel, torque)
    home = 4.0 * (qpos.new_tensor(HOME) - qpos) - 3.0 * qvel
    model, data = load_scene("franka").model, mujoco.MjData(load_scene("franka").model)
    jacobian, matrix = law.site(qpos).jacobian[:, :size], np.zeros((7, 7))
    for row, rest, pull in zip(qpos, joints - home, jacobian, strict=True):
        data.qpos = row.numpy()
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, matrix)
        force = matrix @ rest.numpy()
        left = force - pull.T.numpy() @ np.linalg.lstsq(pull.T.numpy(), force)[0]
        assert abs(left).max() < 1e-8 * abs(force).max()
        assert abs(force).max() > 1e-3


def test_a_stretched_arm_is_not_torn():
    """Along itself it cannot accelerate, and out of its plane it never can."""
    qpos = torch.tensor([[0.0, 1e-6]]).double()  # rad: the second link in line
    qvel, told = torch.zeros_like(qpos), torch.ones(1, 3).double()
    jacobian = two_links().site(qpos).jacobian[:, :3]
    bound, free = (
        two_links(max_mass=mass, home_kp=0.0).torque(told, qpos, qvel)
        for mass in (100.0, 1e12)
    )
    force = 100.0 * torch.linalg.vector_norm(told)  # max_mass a
    most = torch.linalg.matrix_norm(jacobian, 2) * force
    assert torch.linalg.vector_norm(bound) < most < 1e-2 * free.abs().max()
    across = jacobian[0, 1] @ torch.linalg.solve(MASS_MATRIX, bound[0])
    assert abs(across - 1.0) < 0.05  # where it can, it does as told


@pytest.mark.parametrize("max_mass", [5.0, 100.0])
def test_no_direction_seems_heavier_than_max_mass(max_mass, rng):
    """Damped: a' = A (A + I / m)^-1 a, with the mobility A = J M^-1 J^T of MuJoCo."""
    qpos, _ = random_state(rng)
    qvel, told = torch.zeros_like(qpos), torch.from_numpy(rng.normal(size=(ROWS, 3)))
    law = controller(max_mass=max_mass, home_kp=0.0)
    _, site = mujoco_acceleration("franka", qpos, qvel, law.torque(told, qpos, qvel))
    model, data = load_scene("franka").model, mujoco.MjData(load_scene("franka").model)
    jacobian, matrix = np.zeros((3, 7)), np.zeros((7, 7))
    for row, want, got in zip(qpos.numpy(), told.numpy(), site.numpy(), strict=True):
        data.qpos = row
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, matrix)
        mujoco.mj_jacSite(model, data, jacobian, None, 0)
        mobility = jacobian @ np.linalg.solve(matrix, jacobian.T)
        share = mobility @ np.linalg.inv(mobility + np.eye(3) / max_mass)
        np.testing.assert_allclose(got[:3], share @ want, rtol=1e-7, atol=1e-9)


def test_torques_stay_within_the_limits(rng):
    qpos, qvel = random_state(rng)
    told = 1e3 * torch.from_numpy(rng.normal(size=(ROWS, 3)))
    free = controller().torque(told, qpos, qvel)
    limit = torch.tensor(GAIN, dtype=torch.float64)
    got = controller(limit=GAIN).torque(told, qpos, qvel)
    assert torch.equal(got, torch.minimum(torch.maximum(free, -limit), limit))
    assert (got.abs() == limit).any() and (got.abs() < limit).any()


def test_numbers_may_come_as_arrays(rng):
    qpos, qvel = random_state(rng)
    names = {"kp": (50.0,) * 3, "kd": (9.0,) * 3, "home": HOME, "limit": GAIN}
    names |= {"scale": (0.1,) * 3}
    arrays = {name: np.array(value) for name, value in names.items()}
    one, other = (controller(**x) for x in (names, arrays))
    action = torch.from_numpy(rng.normal(size=(ROWS, 3)))
    assert torch.equal(one(action, qpos, qvel), other(action, qpos, qvel))


def test_leading_dimensions_and_the_dtype_are_kept(rng):
    qpos, qvel = random_state(rng)
    action, law = torch.from_numpy(rng.normal(size=(ROWS, 3))), controller(limit=GAIN)
    flat = law(action, qpos, qvel)
    batch = (x.reshape(2, ROWS // 2, -1) for x in (action, qpos, qvel))
    assert torch.equal(law(*batch).reshape(flat.shape), flat)
    torch.testing.assert_close(law(action[0], qpos[0], qvel[0]), flat[0])
    assert law(action[:0], qpos[:0], qvel[:0]).shape == (0, 7)
    assert law(action.float(), qpos, qvel).dtype == torch.float64
    assert law(action, qpos.float(), qvel.float()).dtype == torch.float32
    bad = qpos.clone()
    bad[0] = torch.nan  # of one row: no error, and no other row notices
    got = law(action, bad, qvel)
    assert got[0].isnan().all() and torch.equal(got[1:], flat[1:])


def two_link_state(rng):
    """Action, positions and velocities of two rows."""
    sizes = ((2, 3), (2, 2), (2, 2))
    return tuple(torch.from_numpy(rng.uniform(0.2, 0.8, size)) for size in sizes)


def test_gradients_are_those_of_differences(rng):
    given = tuple(x.requires_grad_() for x in two_link_state(rng))
    assert torch.autograd.gradcheck(two_links(), given, atol=1e-4, rtol=1e-4)


def test_compiled_it_is_the_same(rng):
    given, law = two_link_state(rng), two_links(limit=(20.0, 5.0))
    compiled = torch.compile(law, backend="eager", fullgraph=True)
    torch.testing.assert_close(compiled(*given), law(*given))


BAD = {
    "3 or 6 numbers as scale, got 2": {"scale": (1.0,) * 2},
    "3 numbers as kp, got 6": {"kp": (1.0,) * 6},
    "3 numbers as kd, got 1": {"kd": (1.0,)},
    "7 numbers as home, got 3": {"home": (0.0,) * 3},
    "7 numbers as limit, got 2": {"limit": (1.0,) * 2},
    "max_mass above 0, got 0": {"max_mass": 0.0},
    "kp of at least 0.0, got nan": {"kp": (1.0, nan, 1.0)},
    "kd of at least 0.0, got -1": {"kd": (1.0, -1.0, 1.0)},
    "limit of at least 0.0, got -2": {"limit": (-2.0,) * 7},
    "home_kp of at least 0.0, got -1": {"home_kp": -1.0},
    "home_kd of at least 0.0, got nan": {"home_kd": nan},
    "finite numbers as kp, kd, home_kp, home_kd, scale": {"scale": (nan,) * 3},
    "finite numbers as kp, kd, home_kp, home_kd, scale and home": {"home": (inf,) * 7},
    "finite numbers as kp, kd": {"kp": (1.0, inf, 1.0)},
}


@pytest.mark.parametrize(("message", "changes"), BAD.items())
def test_numbers_that_do_not_fit_are_refused_in_a_sentence(message, changes):
    with pytest.raises(ValueError, match=message):
        controller(**changes)


PASSIVE = """<mujoco><worldbody><body><joint name="a"/><geom size="0.1" pos="1 0 0"/>
  <body pos="1 0 0">{}<geom size="0.1" pos="1 0 0"/><site name="tip"/></body></body>
  </worldbody><actuator><motor joint="a"/></actuator></mujoco>"""


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("<body>", '<body gravcomp="1">', "gravity compensation"),
        ("<worldbody>", '<option density="1000"/><worldbody>', "air or water"),
        ('name="a"', 'name="a" frictionloss="1"', "dry friction"),
        ("<worldbody>", '<option><flag gravity="disable"/></option><worldbody>', "off"),
    ],
)
def test_forces_that_it_does_not_know_are_refused(old, new, said):
    model = mujoco.MjModel.from_xml_string(TWO_LINKS.replace(old, new, 1))
    with pytest.raises(ValueError, match=said):
        OperationalSpaceController(
            model, "tip", (1.0,) * 3, (1.0,) * 3, (1.0,) * 3, (0.0, 0.0)
        )


def test_other_robots_are_refused_in_a_sentence():
    numbers = {"kp": (1.0,) * 3, "kd": (1.0,) * 3, "scale": (1.0,) * 3}
    model = mujoco.MjModel.from_xml_string(PASSIVE.format('<joint name="b"/>'))
    with pytest.raises(ValueError, match="way to site 'tip', got none on 'b'"):
        OperationalSpaceController(model, "tip", **numbers, home=(0.0, 0.0))
    ant = load_scene("ant").model
    with pytest.raises(ValueError, match="an arm on a fixed base"):
        OperationalSpaceController(ant, "tip", **numbers, home=(0.0,) * ant.nq)
