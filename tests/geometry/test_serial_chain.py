"""A site's pose, Jacobian and bias acceleration are MuJoCo's own, on any chain."""

import mujoco
import numpy as np
import pytest
import torch

from torchrl_nerd.geometry.serial_chain import SiteKinematics, bias_acceleration
from torchrl_nerd.robots import load_scene

ROWS = 32
CHAIN = """<mujoco><compiler angle="radian"/><worldbody>
  <body pos="0.3 -0.2 0.4" quat="0.8 0.3 -0.4 0.3">
    <body name="mount" pos="0.1 0 0.2" quat="0.5 0.1 0.7 -0.2">
      <joint name="pan" axis="1 2 3" pos="0.1 0.2 -0.1" ref="0.4"/><geom size="0.1"/>
      <joint name="rail" type="slide" axis="0 1 1" pos="0.3 0 0" ref="-0.2"/>
      <body pos="0.2 0.1 0" quat="0.9 0 0.4 0.1"><geom size="0.1"/>
        <body pos="0 0 0.5"><joint name="tilt" axis="0 1 -1" range="-1 2"/>
          <geom size="0.1"/><site name="tip" pos="0.1 -0.2 0.3" quat="0.7 0.1 -0.6 0.3"/>
        </body></body>
      <body pos="-0.2 0 0"><joint name="aside"/><geom size="0.1"/></body>
    </body></body></worldbody></mujoco>"""
"""Two joints of one body, anchors off the origin, ``ref``, a fixed body, a branch."""
MODELS = {
    "franka": (load_scene("franka").model, "end_effector"),
    "franka_gravity": (load_scene("franka_gravity").model, "end_effector"),
    "handmade": (mujoco.MjModel.from_xml_string(CHAIN), "tip"),
}
each_model = pytest.mark.parametrize(("model", "site"), MODELS.values(), ids=MODELS)


def random_qpos(model, rng):
    return torch.from_numpy(rng.uniform(-3.0, 3.0, (ROWS, model.nq)))


def mujoco_site(model, site, qpos):
    """Position, rotation and Jacobian of each row."""
    data, found, index = mujoco.MjData(model), [], model.site(site).id
    for row in qpos.numpy():
        data.qpos, jacobian = row, np.zeros((6, model.nv))
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_jacSite(model, data, jacobian[:3], jacobian[3:], index)
        place, turn = data.site_xpos[index].copy(), data.site_xmat[index].reshape(3, 3)
        found.append((place, turn.copy(), jacobian))
    return tuple(torch.from_numpy(np.stack(x)) for x in zip(*found, strict=True))


@each_model
def test_pose_and_jacobian_are_mujocos(model, site, rng):
    kinematics, qpos = SiteKinematics(model, site), random_qpos(model, rng)
    got, want = kinematics(qpos), mujoco_site(model, site, qpos)
    jacobian = torch.zeros_like(want[2])
    jacobian[..., kinematics.dof_addresses] = got.jacobian
    for found, true in zip((*got[:2], jacobian), want, strict=True):
        assert (found - true).abs().max() < 1e-10
    assert kinematics.qpos_addresses == kinematics.dof_addresses  # no quaternions


@each_model
def test_leading_dimensions_are_kept(model, site, rng):
    kinematics, qpos = SiteKinematics(model, site), random_qpos(model, rng)
    flat = kinematics(qpos)
    for batch in ((4, 8), (ROWS, 1)):
        for got, want in zip(kinematics(qpos.reshape(*batch, -1)), flat, strict=True):
            assert torch.equal(got.reshape(want.shape), want)
    for got, want in zip(kinematics(qpos[0]), flat, strict=True):
        torch.testing.assert_close(got, want[0], rtol=0.0, atol=1e-14)
    assert kinematics(qpos[:0]).jacobian.shape[0] == 0


@each_model
def test_bias_acceleration_is_the_second_difference_of_the_motion(model, site, rng):
    kinematics, qpos, step = SiteKinematics(model, site), random_qpos(model, rng), 1e-4
    qvel = torch.from_numpy(rng.normal(size=qpos.shape))

    def speed(time):
        jacobian = kinematics(qpos + time * qvel).jacobian
        return (jacobian @ qvel[:, kinematics.dof_addresses, None])[..., 0]

    want = (speed(step) - speed(-step)) / (2.0 * step)
    rates = qvel[:, kinematics.dof_addresses]
    got = bias_acceleration(kinematics(qpos).jacobian, rates)
    torch.testing.assert_close(got, want, rtol=1e-6, atol=1e-6)


@each_model
def test_gradients_of_the_position_are_the_jacobian(model, site, rng):
    kinematics, qpos = SiteKinematics(model, site), random_qpos(model, rng)
    moving = qpos.clone().requires_grad_()
    found = kinematics(moving)
    rows = [
        torch.autograd.grad(found.position[:, i].sum(), moving, retain_graph=True)[0]
        for i in range(3)
    ]
    got = torch.stack(rows, -2)[..., kinematics.dof_addresses]
    torch.testing.assert_close(got, found.jacobian[:, :3].detach())


def test_other_sites_and_joints_are_refused_in_a_sentence():
    model = MODELS["handmade"][0]
    with pytest.raises(ValueError, match=r"name of a site \(tip\), got 'hand'"):
        SiteKinematics(model, "hand")
    for joint, found in (
        ('<joint name="b" type="ball"/>', "joint 'b'"),
        ("", "no joint"),
    ):
        xml = f'<mujoco><worldbody><body>{joint}<geom size="1"/><site name="s"/></body>'
        other = mujoco.MjModel.from_xml_string(f"{xml}</worldbody></mujoco>")
        with pytest.raises(ValueError, match=f"way to site 's', got {found}"):
            SiteKinematics(other, "s")
