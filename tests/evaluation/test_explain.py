"""The report of a scene, and its text."""

from collections import Counter

import mujoco
import numpy as np
import pytest
import torch
from helpers import every_scene, make_scene

from torchrl_nerd.data.simulate import simulate
from torchrl_nerd.evaluation.explain import TRAJECTORIES, explain
from torchrl_nerd.geometry.manifold import HINGE, SLIDE, joint_label
from torchrl_nerd.keys import QPOS
from torchrl_nerd.modules.nerd import SceneFeatures
from torchrl_nerd.robots import load_scene

CROSSED = """
<mujoco><worldbody><body name="upper"><joint axis="0 1 0"/><geom size="0.1"/>
  <body name="middle" pos="0.5 0 0"><joint axis="0 1 0"/>
    <geom size="0.1" contype="0" conaffinity="0"/>
    <body name="lower" pos="0.5 0 0"><joint axis="0 1 0"/><geom size="0.1"/></body>
  </body></body></worldbody></mujoco>"""


@every_scene
def test_the_report_adds_up_and_its_text_names_all(scene):
    report = explain(scene)
    text = str(report)
    assert report.token_width == SceneFeatures(scene).size
    assert text.startswith(f"{scene.name}: {report.token_width} features a step")
    assert all(feature.key in text for feature in report.features)
    assert all(body in text for body in report.contact_bodies)
    assert len(report.contact_bodies) == len(scene.contacts)
    kept = report.points_found - report.points_merged - report.points_fixed
    assert kept == len(scene.contacts) and f", {kept} kept" in text
    assert type(scene.controller).__name__ in text
    assert ("none that the robot can touch" in text) == (scene.terrain is None)
    assert f"control step: {scene.control_step:.6g} s, MuJoCo Euler, " in text
    assert f" {scene.substeps} substep" in text
    reason, moved = report.why_all_kept, {effect.name for effect in report.effects}
    for joint in np.flatnonzero(np.isin(scene.model.jnt_type, (HINGE, SLIDE))):
        assert (joint_label(scene.model, joint) in moved) == (reason is None)
    assert (reason is None) == ("every hinge and slide is kept: " not in text)
    has_props = scene.model.ntree > 1
    assert ("several moving trees" in (reason or "")) == has_props


@pytest.mark.parametrize(
    ("name", "step"),
    [
        ("cartpole", "unconstrained"),
        ("ant", "penalty-contact-2-outer-steps"),
        ("dm_control/cheetah-run", None),
    ],
)
def test_an_analytic_step_is_named_or_why_there_is_none(name, step):
    report = explain(load_scene(name))
    assert report.analytic_step == step
    assert f"analytic step: {step or 'none'}" in str(report)
    reason = report.why_no_step
    assert reason is None if step else reason and name in reason


def test_self_contacts_are_those_that_mujoco_finds():
    scene = make_scene(CROSSED)
    report = explain(scene)
    (pair,) = report.self_contacts
    assert set(pair.bodies) == {"lower", "upper"}
    assert "self-contacts: 1 pairs of bodies" in str(report)
    data = mujoco.MjData(scene.model)
    data.qpos[1:] = 2.0944, 2.0944  # rad: the three bodies at a triangle's corners
    data.qpos[1] = 3.14159  # folded: lower lies in upper
    mujoco.mj_forward(scene.model, data)
    assert data.ncon == 1
    assert "self-contacts: none" in str(explain(load_scene("cartpole")))


def test_pairs_are_named_by_how_often_they_touch_in_training_data():
    scene = load_scene("dm_control/hopper-hop")
    model, report = scene.model, explain(scene)
    data = simulate(scene, *TRAJECTORIES, torch.Generator().manual_seed(0))
    states, touching = data["next", QPOS].flatten(0, 1), Counter()
    engine = mujoco.MjData(model)
    for state in states:
        engine.qpos[:] = state
        mujoco.mj_forward(model, engine)
        ends = ((contact.geom1, contact.geom2) for contact in engine.contact)
        pairs = (model.geom_bodyid[list(pair)] for pair in ends)
        touching.update({frozenset(model.body(b).name for b in x) for x in pairs})
    shares = [pair.share for pair in report.self_contacts]
    assert shares == sorted(shares, reverse=True) and 0.0 < shares[0] < 1.0
    for pair in report.self_contacts:
        assert pair.share == pytest.approx(
            touching[frozenset(pair.bodies)] / len(states)
        )
    most = report.self_contacts[0]
    assert f"{'-'.join(most.bodies)} {most.share:.1%}" in str(report)


def test_merged_and_fixed_contact_points_are_counted():
    report = explain(load_scene("double_pendulum"))
    assert (report.points_found, report.points_merged, report.points_fixed) == (4, 1, 1)
    assert "4 found, 1 merged" in str(report)


def test_a_hinge_that_a_servo_holds_is_no_sine_and_cosine(tmp_path):
    for actuator, words in (("motor", True), ("position", False)):
        path = tmp_path / f"{actuator}.xml"
        path.write_text(f"""<mujoco><worldbody><body><joint name="j"/>
          <geom size="0.1" pos="0.2 0 0"/></body></worldbody><actuator>
          <{actuator} joint="j" ctrllimited="true" ctrlrange="-1 1"/></actuator>
          </mujoco>""")
        assert ("sine and cosine" in str(explain(load_scene(str(path))))) == words
