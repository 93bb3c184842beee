"""MuJoCo's soft constraints against the springs and dampers that they stand for."""

import mujoco
import numpy as np
import pytest
import torch

from torchrl_nerd.robots import load_scene
from torchrl_nerd.scenes.penalty_law import set_penalty_contact, set_penalty_limit

RADIUS = 0.1  # m
SLIDES = "".join(
    f'<joint type="slide" axis="{a}"/>' for a in ("1 0 0", "0 1 0", "0 0 1")
)


def ball(mass, ke, kd, kf, mu, joints="<freejoint/>"):
    """A ball at height zero above a plane that touches it."""
    model = mujoco.MjModel.from_xml_string(f"""
    <mujoco><option cone="elliptic" tolerance="1e-12"/><worldbody>
      <geom type="plane" size="0 0 1" pos="0 0 {-RADIUS}"/>
      <body>{joints}<geom size="{RADIUS}" mass="{mass}"/></body>
    </worldbody></mujoco>""")
    set_penalty_contact(model, ke=ke, kd=kd, kf=kf, mu=mu)
    model.opt.timestep = 0.005 * np.sqrt(mass / ke)
    return model


def draw(rng):
    """Mass, stiffness and a damping of 0.1 to 1 times the critical one."""
    mass, ke = rng.uniform(0.5, 50.0), 10.0 ** rng.uniform(3, 5)
    return mass, ke, 2.0 * rng.uniform(0.1, 1.0) * np.sqrt(ke * mass)


def contact_force(model, data, contact=0):
    """Normal force and size of the friction, N."""
    force = np.zeros(6)
    mujoco.mj_contactForce(model, data, contact, force)
    return force[0], np.linalg.norm(force[1:3])


def cone(law, slip, kd, kf, mu):
    """Normal force on MuJoCo's friction cone, from that of spring and damper.

    Its cone is a convex constraint: slip beyond the limit also presses on the ground.
    """
    if kf * slip > mu * law:
        law = (law + mu * kd * slip) / (1.0 + mu**2 * kd / kf)
    return max(law, 0.0)


def test_a_ball_at_rest_sinks_by_its_weight_over_the_stiffness(rng):
    mass, ke, _ = draw(rng)
    kd = 2.0 * np.sqrt(ke * mass)
    model = ball(mass, ke, kd, kd, 0.5)
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 3000)
    assert abs(data.qvel[2]) < 1e-4
    np.testing.assert_allclose(-data.qpos[2], 9.81 * mass / ke, rtol=0.02)


@pytest.mark.parametrize("joints", ["<freejoint/>", SLIDES], ids=["free", "slides"])
def test_force_of_a_contact_is_that_of_spring_and_damper(joints, rng):
    mass, ke, kd = draw(rng)
    model = ball(mass, ke, kd, kd, 0.5, joints)
    data, weight = mujoco.MjData(model), 9.81 * mass
    pushed = 0
    for _ in range(50):
        depth = rng.uniform(1.0, 20.0) * weight / ke
        speed = rng.uniform(-2.0, 2.0) * ke * depth / kd
        data.qpos[2], data.qvel[2] = -depth, -speed
        mujoco.mj_forward(model, data)
        want = max(ke * depth + kd * speed, 0.0)
        scale = ke * depth + kd * abs(speed)
        assert abs(contact_force(model, data)[0] - want) < 0.03 * scale
        pushed += want > 0.0
    assert 0 < pushed < 50


def test_a_limit_rings_like_the_closed_form(rng):
    mass, ke, _ = draw(rng)
    rate, damping = np.sqrt(ke / mass), rng.uniform(0.05, 0.5)
    model = mujoco.MjModel.from_xml_string(f"""
    <mujoco><option timestep="{0.005 / rate}" tolerance="1e-12"/><worldbody>
      <body><joint name="z" type="slide" axis="0 0 1" range="0 1"/>
        <geom size="0.1" mass="{mass}"/></body></worldbody></mujoco>""")
    set_penalty_limit(model, "z", ke=ke, kd=2.0 * damping * rate * mass)
    data, sag = mujoco.MjData(model), 9.81 * mass / ke
    data.qpos[0] = -1.5 * sag  # half a sag below rest: it never leaves the limit
    damped = rate * np.sqrt(1.0 - damping**2)
    while data.time < 6.0 * np.pi / damped:
        mujoco.mj_step(model, data)
        decay, phase = np.exp(-damping * rate * data.time), damped * data.time
        shape = np.cos(phase) + damping * rate / damped * np.sin(phase)
        want = -sag - 0.5 * sag * decay * shape
        assert abs(data.qpos[0] - want) < 0.03 * sag


def test_friction_is_mu_times_the_normal_force_beyond_its_limit(rng):
    mass, ke, kd = draw(rng)
    mu, kf = rng.uniform(0.1, 0.9), rng.uniform(1.0, 10.0) * kd
    model = ball(mass, ke, kd, kf, mu, SLIDES)
    data = mujoco.MjData(model)
    for _ in range(50):
        law, angle = rng.uniform(1.0, 20.0) * 9.81 * mass, rng.uniform(-np.pi, np.pi)
        slip = rng.uniform(1.5, 20.0) * mu * law / kf
        data.qpos[2] = -law / ke
        data.qvel[:2] = slip * np.cos(angle), slip * np.sin(angle)
        mujoco.mj_forward(model, data)
        normal, friction = contact_force(model, data)
        np.testing.assert_allclose(friction, mu * normal, rtol=1e-6)
        np.testing.assert_allclose(normal, cone(law, slip, kd, kf, mu), rtol=0.03)
        push = data.qfrc_constraint[:2] / friction
        np.testing.assert_allclose(push, -data.qvel[:2] / slip, atol=1e-6)


def test_friction_below_its_limit_is_kf_times_the_slip(rng):
    mass, ke, kd = draw(rng)
    mu, kf = rng.uniform(0.1, 0.9), rng.uniform(1.0, 10.0) * kd
    model = ball(mass, ke, kd, kf, mu, SLIDES)
    data = mujoco.MjData(model)
    for _ in range(50):
        law = rng.uniform(1.0, 20.0) * 9.81 * mass
        slip = rng.uniform(0.1, 0.9) * mu * law / kf
        data.qpos[2], data.qvel[0] = -law / ke, slip
        mujoco.mj_forward(model, data)
        np.testing.assert_allclose(data.qfrc_constraint[0], -kf * slip, rtol=0.1)


def test_cartpoles_rail_ends_are_the_published_springs(rng):
    model = load_scene("cartpole").model
    data, side = mujoco.MjData(model), rng.choice([-1.0, 1.0])
    for _ in range(20):
        beyond, speed = rng.uniform(0.05, 0.5), rng.uniform(-10.0, 10.0)
        data.qpos[:] = side * (4.0 + beyond), rng.uniform(-np.pi, np.pi)
        data.qvel[:] = side * speed, 0.0
        mujoco.mj_forward(model, data)
        want = -side * (1e4 * beyond + 10.0 * speed)
        np.testing.assert_allclose(data.qfrc_constraint[0], want, rtol=0.03)


def test_pendulums_ground_is_the_published_spring(rng):
    scene = load_scene("double_pendulum")
    model, data, pushed = scene.model, mujoco.MjData(scene.model), 0
    for _ in range(60):
        first, second, angle = rng.uniform(-np.pi, np.pi, size=3)
        links = np.array([[np.cos(x), 0.0, np.sin(x)] for x in (first, first + second)])
        normal = np.array([np.cos(angle), 0.0, np.sin(angle)])
        lowest = min(0.0, *(1.5 * np.cumsum(links, 0) @ normal))
        offset = 2.0 * normal[2] + lowest - 0.1 + rng.uniform(0.005, 0.05)
        plane = torch.tensor([*normal, offset], dtype=torch.float64)
        pose = scene.terrain.mocap_pose(plane).numpy()
        data.mocap_pos[0], data.mocap_quat[0] = pose[:3], pose[3:]
        data.qpos, data.qvel = (first, second), 0.3 * rng.normal(size=2)
        mujoco.mj_forward(model, data)
        for index in range(data.ncon):
            contact, jacobian = data.contact[index], np.zeros((3, model.nv))
            body = max(model.geom_bodyid[contact.geom])
            mujoco.mj_jac(model, data, jacobian, None, contact.pos, body)
            velocity, depth = jacobian @ data.qvel, -contact.dist
            speed = -normal @ velocity
            slip = np.linalg.norm(velocity + speed * normal)
            want = cone(1e4 * depth + 1e3 * speed, slip, 1e3, 1e4, 0.5)
            got, friction = contact_force(model, data, index)
            assert abs(got - want) < 0.05 * (1e4 * depth + 1e3 * (abs(speed) + slip))
            assert friction < 0.501 * got + 1e-9
            pushed += got > 0.0
    assert pushed > 20
