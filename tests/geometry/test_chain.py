"""Points of an arm are where an independent library puts them: pytorch-kinematics."""

import numpy as np
import pytorch_kinematics as pk
import torch
from helpers import random_transitions

from torchrl_nerd.geometry.kinematics import PointKinematics
from torchrl_nerd.keys import QPOS
from torchrl_nerd.robots import load_scene

ROWS = 16


def chain_of(model) -> pk.Chain:
    """Its chain, link by link from the compiled model, one hinge a body."""
    frame = None
    for body in reversed(range(1, model.nbody)):
        place = pk.Transform3d(
            pos=model.body_pos[body].tolist(),
            rot=model.body_quat[body].tolist(),
            dtype=torch.float64,
        )
        joint = pk.frame.Joint(f"fixed{body}", offset=place, joint_type="fixed")
        joints = np.flatnonzero(model.jnt_bodyid == body)
        if len(joints):
            (number,) = joints
            assert not model.jnt_pos[number].any()  # its axis goes through the origin
            axis = torch.tensor(model.jnt_axis[number])
            name = f"joint{int(model.jnt_qposadr[number])}"
            joint = pk.frame.Joint(name, place, "revolute", axis, torch.float64)
        link = pk.frame.Link(f"body{body}")
        above = pk.frame.Frame(f"body{body}", link, joint)
        above.children = [] if frame is None else [frame]
        frame = above
    root = pk.frame.Frame("world", pk.frame.Link("world"), pk.frame.Joint("root"))
    root.children = [frame]
    return pk.Chain(root, dtype=torch.float64)


def test_the_hand_of_the_arm_is_where_pytorch_kinematics_puts_it(generator):
    scene = load_scene("franka_gravity")
    model = scene.model
    parents = model.body_parentid[1:]
    assert (parents == np.arange(model.nbody - 1)).all()  # one chain
    hand = model.nbody - 1
    qpos = random_transitions(scene, ROWS, generator)[QPOS]
    points = PointKinematics(model, scene.base, [hand], np.zeros((1, 3)))
    local, _ = points(qpos, qpos[:0])
    position, rotation = scene.base_pose(qpos)
    got = position + (rotation @ local[:, 0, :, None])[..., 0]
    frames = chain_of(model).forward_kinematics(qpos)
    want = frames[f"body{hand}"].get_matrix()[:, :3, 3]
    torch.testing.assert_close(got, want, atol=1e-6, rtol=1e-6)
