"""Scenes hold the published numbers, and their fingerprint follows the physics."""

import copy
from dataclasses import replace
from math import pi

import mujoco
import numpy as np
import pytest
import torch
from helpers import HANDMADE, random_states, random_transitions

from torchrl_nerd.keys import QPOS, QVEL
from torchrl_nerd.robots import SCENES, load_scene
from torchrl_nerd.scenes.fingerprint import fingerprint

FACTS = {
    "cartpole": {
        "control_step": 1 / 60,
        "substeps": 5,
        "masses": {"cart": 50.0, "pole": 2.5},
        "centres": {"cart": (0.0, 0.0, 0.0), "pole": (0.0, 0.0, 0.5)},
        "inertias": {
            "cart": (1.21833, 1.21833, 2.09333),
            "pole": (0.218854, 0.218854, 0.0110417),
        },
        "origins": {"cart": (0.0, 0.0, 0.0), "pole": (0.0, 0.0, 0.0)},
        "limits": {"slider": (-4.0, 4.0), "hinge": None},
        "armature": 0.01,
        "gain": (1500.0,),
        "actuated": ["slider"],
        "points_found": 0,
        "qpos": ((-3.5, -pi), (3.5, pi)),
        "qvel": ((-10.0, -10.0), (10.0, 10.0)),
    },
    "double_pendulum": {
        "control_step": 1 / 60,
        "substeps": 5,
        "masses": {"link1": 25.6563, "link2": 25.6563},
        "centres": {"link1": (0.75, 0.0, 0.0), "link2": (0.75, 0.0, 0.0)},
        "inertias": dict.fromkeys(("link1", "link2"), (0.226187, 5.88105, 5.88105)),
        "origins": {"link1": (0.0, -1.0, 2.0), "link2": (1.5, 0.0, 0.0)},
        "limits": {"joint1": None, "joint2": None},
        "armature": 0.01,
        "gain": (1500.0, 1500.0),
        "actuated": ["joint1", "joint2"],
        "points_found": 4,
        "qpos": ((-pi, -pi), (pi, pi)),
        "qvel": ((-2 * pi, -4 * pi), (2 * pi, 4 * pi)),
    },
}
"""SI; the paper's appendix and the models that its reference code builds."""

MUTATIONS = {
    "mass": lambda m: m.body_mass.__imul__(1.1),
    "inertia": lambda m: m.body_inertia.__imul__(1.1),
    "joint axis": lambda m: m.jnt_axis.__imul__(-1.0),
    "armature": lambda m: m.dof_armature.__iadd__(0.1),
    "damping": lambda m: m.dof_damping.__iadd__(0.5),
    "stiffness": lambda m: m.jnt_stiffness.__iadd__(5.0),
    "dry friction": lambda m: m.dof_frictionloss.__iadd__(0.5),
    "range": lambda m: m.jnt_range.__imul__(0.5),
    "limit margin": lambda m: m.jnt_margin.__iadd__(0.3),
    "shape": lambda m: m.geom_size.__imul__(1.2),
    "friction": lambda m: m.geom_friction.__imul__(0.3),
    "contact margin": lambda m: m.geom_margin.__iadd__(0.1),
    "contact dimension": lambda m: m.geom_condim.fill(1),
    "contact stiffness": lambda m: m.geom_solref.__imul__(0.8),
    "gravity": lambda m: m.opt.gravity.__imul__(0.5),
    "air": lambda m: setattr(m.opt, "density", 100.0),
    "viscosity": lambda m: setattr(m.opt, "viscosity", 1.0),
    "timestep": lambda m: setattr(m.opt, "timestep", 0.7 * m.opt.timestep),
    "integrator": lambda m: setattr(
        m.opt, "integrator", mujoco.mjtIntegrator.mjINT_RK4
    ),
    "friction damping": lambda m: setattr(m.opt, "impratio", 3.0 * m.opt.impratio),
}


def steps_of(model, qpos, qvel):
    """Velocities three MuJoCo steps after each state."""
    data, after = mujoco.MjData(model), []
    for row in range(len(qpos)):
        mujoco.mj_resetData(model, data)
        data.qpos, data.qvel = qpos[row], qvel[row]
        mujoco.mj_step(model, data, 3)
        after.append(data.qvel.copy())
    return np.array(after)


@pytest.mark.parametrize("name", FACTS)
def test_published_numbers(name):
    scene, facts = load_scene(name), FACTS[name]
    model = scene.model
    assert abs(scene.control_step - facts["control_step"]) < 1e-12
    assert scene.substeps == facts["substeps"]
    assert scene.controller.gain == facts["gain"]
    assert scene.sampling.torque == facts["gain"]
    assert len(scene.contacts.stands_for) == facts["points_found"]
    assert scene.actuated == [model.joint(j).dofadr[0] for j in facts["actuated"]]
    np.testing.assert_allclose(model.opt.gravity, (0.0, 0.0, -9.81))
    np.testing.assert_allclose(model.dof_armature, facts["armature"])
    assert not model.dof_damping.any() and not model.dof_frictionloss.any()
    for body, mass in facts["masses"].items():
        np.testing.assert_allclose(model.body(body).mass, mass, rtol=1e-4)
        np.testing.assert_allclose(model.body(body).ipos, facts["centres"][body])
        np.testing.assert_allclose(model.body(body).pos, facts["origins"][body])
        inertia = facts["inertias"][body]
        np.testing.assert_allclose(model.body(body).inertia, inertia, rtol=1e-4)
    for joint, limits in facts["limits"].items():
        assert bool(model.joint(joint).limited[0]) == (limits is not None)
        np.testing.assert_allclose(model.joint(joint).range, limits or (0.0, 0.0))


@pytest.mark.parametrize("name", FACTS)
def test_initial_states_fill_the_published_ranges(name, generator):
    scene, facts = load_scene(name), FACTS[name]
    state, torque_scale = scene.sample_initial(4000, generator)
    for key in (QPOS, QVEL):
        low, high = torch.tensor(facts[key], dtype=torch.float64)
        assert state[key].dtype == torch.float64
        assert (state[key] >= low).all() and (state[key] <= high).all()
        reach = torch.stack((state[key].amin(0) / low, state[key].amax(0) / high))
        assert reach.min() > 0.97
    is_passive = float((torque_scale == 0.0).double().mean())
    assert abs(is_passive - scene.sampling.zero_torque_fraction) < 0.05
    assert float((torque_scale == 1.0).double().mean()) > 0.4


def test_scene_steps_are_sound(scene, generator):
    steps = random_transitions(scene, 200, generator)
    assert steps["next", QPOS].isfinite().all() and steps["next", QVEL].isfinite().all()
    assert steps["next", "joint_torque"].shape == (200, len(scene.actuated))


def test_an_equal_scene_has_an_equal_hash(scene):
    again = SCENES[scene.name].__wrapped__()  # not the one that is kept
    assert again is not scene and again.hash == scene.hash
    again.model.geom_rgba[:] = 0.5  # paint is no physics
    assert replace(again).hash == scene.hash
    assert load_scene(scene.name) is scene


def test_scenes_have_different_hashes():
    hashes = [load_scene(name).hash for name in SCENES]
    hashes += [scene.hash for scene in HANDMADE.values()]
    assert len(set(hashes)) == len(hashes)


def test_another_mass_or_number_of_substeps_is_another_hash(scene):
    hashes = {scene.hash, replace(scene, substeps=scene.substeps + 1).hash}
    moving = [body for body in range(scene.model.nbody) if scene.model.body_mass[body]]
    for body in moving:
        model = copy.copy(scene.model)
        model.body_mass[body] *= 1.0 + 1e-12
        hashes.add(replace(scene, model=model).hash)
    assert len(hashes) == len(moving) + 2


@pytest.mark.parametrize("mutation", MUTATIONS)
def test_what_changes_a_step_changes_the_hash(mutation, rng):
    has_effect = []
    for scene in (*(load_scene(name) for name in SCENES), *HANDMADE.values()):
        mutant = replace(scene, model=copy.copy(scene.model))
        MUTATIONS[mutation](mutant.model)
        states = random_states(scene.model, 30, rng)
        before, after = (steps_of(x.model, *states) for x in (scene, mutant))
        change = abs(after - before).max()
        if change > 1e-6:
            has_effect.append(scene.name)
            assert mutant.hash != scene.hash, (
                f"{mutation} changes steps by {change:.1e}"
            )
    assert has_effect


def test_an_unknown_scene_is_named_with_those_that_exist():
    with pytest.raises(ValueError, match="unknown scene 'hovercraft'") as error:
        load_scene("hovercraft")
    assert all(name in str(error.value) for name in SCENES)


TENDON = """<mujoco><worldbody><site name="w" pos="0 0 1"/><body pos="0 0 0.3">
<joint name="j" axis="0 1 0"/><geom size="0.05" pos="0.3 0 0"/><site name="p" pos="{}"/>
</body></worldbody><tendon>{}</tendon>{}</mujoco>"""
CORD = '<spatial name="t"><site site="w"/><site site="p"/></spatial>'
FIXED = '<fixed name="t" {}><joint joint="j" coef="{}"/></fixed>'
PULL = '<actuator><motor tendon="t"/></actuator>'


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (("0 0 0.2", CORD, PULL), ("0.3 0 -0.2", CORD, PULL)),
        (("0 0 0", FIXED.format("", 1), PULL), ("0 0 0", FIXED.format("", -1), PULL)),
        (
            ("0 0 0", FIXED.format('actuatorfrcrange="-1 1"', 1), PULL),
            ("0 0 0", FIXED.format('actuatorfrcrange="-2 2"', 1), PULL),
        ),
        (
            ("0.1 0 0", "", '<equality><connect site1="w" site2="p"/></equality>'),
            ("0.2 0 0", "", '<equality><connect site1="w" site2="p"/></equality>'),
        ),
    ],
    ids=["a motor's site", "a coefficient", "a force range", "a bound site"],
)
def test_the_fingerprint_knows_what_tendons_and_sites_do(one, other):
    models = (mujoco.MjModel.from_xml_string(TENDON.format(*x)) for x in (one, other))
    hashes = {fingerprint(model, 4) for model in models}
    assert len(hashes) == 2
