"""Names, ranges and draws of hidden parameters; what they do to a model's constants."""

import copy

import mujoco
import numpy as np
import pytest
import torch
from helpers import make_scene, varied_model

from torchrl_nerd.robots import PRESETS, load_scene
from torchrl_nerd.scenes.variation import Variation

DRAWS = 2000


def variation(name: str, ranges: dict):
    return load_scene(name).vary(ranges).variation


def test_draws_fill_their_ranges(generator):
    ranges = {"mass:pole": (0.25, 4.0), "damping:hinge": (-0.0, 2.0), "delay": (1, 3)}
    drawn = variation("cartpole", ranges).draw(DRAWS, generator)
    factor, damping, delay = drawn.unbind(-1)
    for value, (low, high) in zip((factor, damping), ranges.values(), strict=False):
        width = high - low
        assert low <= value.min() < low + 0.02 * width
        assert high - 0.02 * width < value.max() <= high
    # log-uniform: as many below 1 as above it
    assert abs((factor < 1.0).double().mean() - 0.5) < 0.06
    assert abs((damping < 1.0).double().mean() - 0.5) < 0.06
    counts = torch.stack([(delay == k).sum() for k in (1, 2, 3)])
    assert counts.sum() == DRAWS and counts.min() > DRAWS / 4


def test_shares_are_where_a_parameter_lies_in_its_range():
    found = variation("cartpole", {"mass:pole": (0.25, 4.0), "slope:x": (0.0, 0.2)})
    u = torch.tensor([[0.0, 0.0], [0.5, 0.5], [1.0, 0.25]], dtype=torch.float64)
    torch.testing.assert_close(found.shares(found.values(u)), 2.0 * u - 1.0)


def test_a_payload_is_a_small_heavy_body(generator):
    """The mass matrix is that of a model with one more body, a tiny sphere."""
    scene = load_scene("ant").vary(
        {
            "payload:torso": (2.0, 9.0),
            **{f"payload_{x}:torso": (-0.4, 0.4) for x in "xyz"},
        }
    )
    [given] = scene.variation.draw(1, generator)
    path = "torchrl_nerd/robots/ant/ant.xml"
    spec = mujoco.MjSpec.from_file(path)
    load = spec.body("torso").add_body(name="load", pos=given[1:].tolist())
    load.mass, load.inertia = float(given[0]), [1e-9] * 3
    load.ipos, load.explicitinertial = [0.0] * 3, True
    other, own = spec.compile(), varied_model(scene.variation, given)
    matrices = []
    for model in (own, other):
        data = mujoco.MjData(model)
        data.qpos[3:7] = [0.5, 0.5, -0.5, 0.5]
        data.qpos[7:] = np.linspace(-1.0, 1.0, 8)
        mujoco.mj_forward(model, data)
        dense = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, dense)
        matrices.append((dense, data.qfrc_bias.copy()))
    for a, b in zip(*matrices, strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-6)


def test_the_place_of_a_payload_of_every_body():
    """It is in each body's frame; where no axis has a place, the centre of mass."""
    ranges = {"payload": (0.0, 2.0), "payload_x": (-1.0, 1.0)}
    found, given = (
        variation("double_pendulum", ranges),
        torch.tensor([2.0, 0.5]).double(),
    )
    before, after = found.model, varied_model(found, given)
    for body in found.parameters[0].indices:
        mass, centre = before.body_mass[body], before.body_ipos[body]
        moved = (mass * centre[0] + 2.0 * 0.5) / (mass + 2.0)
        assert after.body_mass[body] == mass + 2.0
        np.testing.assert_allclose(after.body_ipos[body], [moved, *centre[1:]])
    assert len(found.parameters[0].indices) == 2


@pytest.mark.parametrize("friction", [0.1, 0.5])
def test_a_slope_is_steep_where_friction_does_not_hold(friction):
    """A cube rests on ground that rises by less than its friction, and slides on more."""
    scene = load_scene("cube")
    found = scene.vary({"slope:x": (0.0, 0.6), "friction": (0.01, 10.0)}).variation
    speeds = []
    for angle in (0.8 * np.arctan(friction), 1.3 * np.arctan(friction)):
        own = [angle, friction / 0.15]
        model = varied_model(found, torch.tensor(own, dtype=torch.float64))
        data = mujoco.MjData(model)
        data.qpos[2] = 0.0524
        mujoco.mj_step(model, data, nstep=3000)
        speeds.append(-data.qvel[0])
        assert np.isclose(np.linalg.norm(model.opt.gravity), 9.81)
    assert abs(speeds[0]) < 0.05 < 0.3 < speeds[1]  # creep, and a slide


def test_stiffness_keeps_the_damping_ratio():
    """Of both forms of MuJoCo's solref: the penetration at rest divides by the factor."""
    xml = """<mujoco><default><geom solimp="0.9 0.9 0.001" solref="{0}"/></default>
    <worldbody><geom type="plane" size="1 1 1"/><body pos="0 0 .1"><freejoint/>
    <geom size=".1"/></body></worldbody></mujoco>"""
    for solref in ("0.02 0.7", "-2000 -80"):
        model = mujoco.MjModel.from_xml_string(xml.format(solref))
        stiffer = Variation(model, [], {"stiffness": (4.0, 4.0)})
        own = varied_model(stiffer, torch.full((1,), 4.0, dtype=torch.float64))
        depths = []
        for each in (model, own):
            data = mujoco.MjData(each)
            mujoco.mj_step(each, data, nstep=3000)
            depths.append(0.1 - data.qpos[2])
        assert depths[0] / depths[1] == pytest.approx(4.0, rel=0.05)


PAIRS = """<mujoco><option timestep="0.005"/><worldbody>
<geom name="floor" type="plane" size="1 1 1" contype="0" conaffinity="0"/>
<body name="a" pos="0 0 .1"><freejoint/><geom name="a" type="box" size=".1 .1 .1"/></body>
<body name="b" pos="9 0 .1"><freejoint/><geom name="b" type="box" size=".1 .1 .1"/></body>
</worldbody><contact><pair geom1="floor" geom2="a"/><pair geom1="b" geom2="floor"/>
</contact></mujoco>"""


@pytest.mark.parametrize(
    ("target", "moved"), [("", "ab"), (":floor", "ab"), (":a", "a")]
)
def test_explicit_pairs_vary_with_their_geoms(target, moved):
    """With 0.01 of its friction a box slides; with 1/16 of its stiffness it sinks."""
    model = mujoco.MjModel.from_xml_string(PAIRS)
    ranges = {f"friction{target}": (0.01, 1.0), f"stiffness{target}": (0.0625, 1.0)}
    found = Variation(model, [], ranges)
    data = []
    for own in ([1.0, 1.0], [0.01, 0.0625]):
        each = varied_model(found, torch.tensor(own, dtype=torch.float64))
        data.append(mujoco.MjData(each))
        data[-1].qvel[[0, 6]] = 2.0
        mujoco.mj_step(each, data[-1], nstep=200)
    nominal, varied = (x.qpos.reshape(2, 7) for x in data)
    for box, name in enumerate("ab"):
        assert (varied[box, 0] > nominal[box, 0] + 0.5) == (name in moved)
        assert (varied[box, 2] < nominal[box, 2] - 1e-4) == (name in moved)


@pytest.mark.parametrize("kind", ["friction", "stiffness:floor"])
def test_contacts_that_are_overridden_cannot_vary(kind):
    xml = PAIRS.replace('"0.005"/>', '"0.005"><flag override="enable"/></option>')
    model = mujoco.MjModel.from_xml_string(xml)
    with pytest.raises(ValueError, match=f"expected contacts .* '{kind}', got a model"):
        Variation(model, [], {kind: (0.5, 2.0)})


def test_nothing_varied_leaves_hash_and_model_alone():
    scene = load_scene("ant")
    before = copy.copy(scene.model)
    varied = scene.vary({"mass": (0.5, 2.0), "friction": (0.1, 1.0)})
    varied_model(varied.variation, torch.tensor([2.0, 0.5], dtype=torch.float64))
    assert varied.hash == scene.hash and varied.vary({}).variation is None
    np.testing.assert_array_equal(scene.model.body_mass, before.body_mass)
    np.testing.assert_array_equal(scene.model.geom_friction, before.geom_friction)


@pytest.mark.parametrize("name", PRESETS)
def test_presets_name_what_is_there(name):
    scene = load_scene(name).vary(PRESETS[name].variation)
    assert (scene.variation is None) == (not PRESETS[name].variation)


@pytest.mark.parametrize(
    ("ranges", "words"),
    [
        ({"weight:pole": (1, 2)}, "expected a kind of mass"),
        ({"mass:poel": (1, 2)}, "expected a body of cart, pole, got"),
        ({"mass:world": (1, 2)}, "expected a body of cart, pole, got 'mass:world'"),
        ({"mass:pole": (2, 1)}, "possible range for 'mass:pole', got 2:1"),
        ({"mass:pole": (0, 1)}, "possible range"),
        ({"damping:hinge": (-1, 1)}, "possible range"),
        ({"damping:hinge": (0, float("inf"))}, "possible range"),
        ({"delay": (0.5, 2)}, "possible range"),
        ({"delay:slider": (0, 2)}, "without a target"),
        ({"motor:hinge": (0.5, 2)}, "a joint with a motor"),
        ({"payload_x:pole": (0, 1)}, "expected 'payload:pole' beside"),
        ({"payload_x": (0, 1)}, "expected 'payload' beside 'payload_x', got none"),
        ({"slope": (0, 1)}, "slope:x or slope:y"),
        ({"slope:x": (-2, 2)}, "possible range"),
        ({"friction": (1e-300, 1e300)}, "possible range"),
        ({"mass": 3.0}, "lowest and the highest value of 'mass', got 3.0"),
        ({"mass": (1, 2, 3)}, "lowest and the highest"),
        ({"mass": ("a", "b")}, "lowest and the highest"),
        ({5: (1, 2)}, "expected a kind of mass"),
        (["mass"], "expected parameters and their ranges"),
    ],
)
def test_what_cannot_be_is_refused(ranges, words):
    with pytest.raises(ValueError, match=words) as raised:
        load_scene("cartpole").vary(ranges)
    assert "\n" not in str(raised.value)


ONE_HINGE = """<mujoco><worldbody><body><joint name="h" {joint}/><geom size="0.1"/></body>
</worldbody><tendon><fixed name="t"><joint joint="h" coef="1"/></fixed></tendon>
<actuator><motor {actuator}/></actuator></mujoco>"""


@pytest.mark.parametrize(
    ("joint", "actuator", "said"),
    [
        ("", 'tendon="t"', "a motor on the joint, got a tendon's in 'motor:h'"),
        ('actuatorfrcrange="-1 1"', 'joint="h"', "without an actuatorfrcrange"),
    ],
)
def test_motors_that_would_not_vary_alike_everywhere_are_refused(joint, actuator, said):
    scene = make_scene(ONE_HINGE.format(joint=joint, actuator=actuator))
    with pytest.raises(ValueError, match=said):
        scene.vary({"motor:h": (0.5, 1.0)})


BALL_AND_HINGE = """<mujoco><worldbody><body><joint name="b" type="ball"/>
<geom size="0.1" pos="0.2 0 0"/><body pos="0.3 0 0"><joint name="h"/>
<geom size="0.1" pos="0.1 0 0"/></body></body></worldbody>
<actuator><motor joint="b" gear="1 0 0"/><motor joint="h"/></actuator></mujoco>"""


def test_motors_without_a_name_are_all_motors():
    """Those of balls too, whether torques or controls drive them."""
    scene = make_scene(BALL_AND_HINGE).vary({"motor": (2.0, 2.0)})
    twice = np.full((1, 1), 2.0)
    assert (scene.variation.strength(twice) == 2.0).all()
    gains = scene.variation.fields(twice)["actuator_gainprm"][0, :, 0]
    assert gains.tolist() == [2.0, 2.0]


@pytest.mark.parametrize("kind", ["com_x", "payload_z"])
def test_the_centre_of_a_simple_body_stays(kind):
    """Of such bodies, as lone boxes are, MuJoCo keeps no place of the centre."""
    ranges = {kind: (-0.01, 0.01), **({"payload": (0, 1)} if "load" in kind else {})}
    with pytest.raises(ValueError, match=f"no simple one for '{kind}'"):
        load_scene("cube").vary(ranges)


def test_a_joints_own_range_goes_before_that_of_all():
    ranges = {"damping:hinge": (0.0, 1.0), "damping": (0.0, 1.0)}
    for given in (ranges, dict(reversed(ranges.items()))):
        variation = load_scene("cartpole").vary(given).variation
        drawn = np.array([[0.9 if ":" in name else 0.1 for name in given]])
        assert variation.fields(drawn)["dof_damping"].tolist() == [[0.1, 0.9]]


def test_a_payload_that_would_weigh_nothing_is_refused():
    scene = make_scene("""<mujoco><worldbody><body name="arm" gravcomp="1">
      <joint axis="0 1 0"/><geom size="0.1" pos="0.3 0 0"/></body></worldbody></mujoco>""")
    with pytest.raises(ValueError, match="without gravcomp for 'payload:arm'"):
        scene.vary({"payload:arm": (0.0, 3.0)})
    scene.vary({"mass:arm": (1.0, 2.0)})
