"""A robot's isometries: groups that the MuJoCo solver and the features agree with."""

import copy
from functools import cache
from itertools import product
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from torch import Generator, Tensor

from torchrl_nerd.configs import NO_PREDICTIONS, FeatureConfig, TrainConfig
from torchrl_nerd.data.simulate import is_sound, simulate
from torchrl_nerd.dynamics import MujocoDynamics
from torchrl_nerd.geometry.rotations import orientation_error
from torchrl_nerd.keys import (
    CTRL,
    JOINT_TORQUE,
    NEXT_QPOS,
    NEXT_QVEL,
    PARAMETERS,
    QPOS,
    QVEL,
)
from torchrl_nerd.modules.nerd import TARGET, TOKEN, NeRD, SceneFeatures
from torchrl_nerd.modules.networks import NETWORKS, MLPConfig
from torchrl_nerd.robots import load_scene, make_task
from torchrl_nerd.scenes import Scene
from torchrl_nerd.scenes.contact_points import own_contacts
from torchrl_nerd.settings import SettingError
from torchrl_nerd.training.isometries import find_isometries
from torchrl_nerd.training.losses import rollout_loss
from torchrl_nerd.training.samples import cover, data_stats, raw_tokens
from torchrl_nerd.training.sequences import Sequences
from torchrl_nerd.training.signed_permutations import SignedPermutations, match_entries
from torchrl_nerd.training.symmetry import Symmetry
from torchrl_nerd.training.trainer import Trainer
from torchrl_nerd.transforms import StateDelta

# Quarter turns and mirrors of the ant; the cube's whole group; ANYmal's trunk is heavier
# on one side. Of fixed bases a mirror, and walkers whose legs are at two places and at one.
ORDERS = {"ant": 8, "cube": 48, "anymal": 1}
ORDERS |= {"cartpole": 2, "dm_control/walker-walk": 2, "gymnasium/Walker2d-v5": 2}


@pytest.fixture(params=list(ORDERS))
def scene(request) -> Scene:
    """Each robot that has a symmetry, or may have one."""
    return load_scene(request.param)


@cache
def symmetry_of(name: str) -> Symmetry:
    """Found once: it takes seconds for the cube's 48."""
    return Symmetry(load_scene(name))


@pytest.mark.parametrize(("name", "order"), ORDERS.items())
def test_the_groups_are_those_of_the_shapes(name, order):
    assert len(find_isometries(load_scene(name))) == order


def test_anymal_has_two_mirrors_and_a_half_turn_but_nearly():
    """Its features have them exactly, those that a contact law predicts as well."""
    symmetry = Symmetry(load_scene("anymal"), FeatureConfig(True), is_near=True)
    assert symmetry.counts() == [1, 2, 4]


@pytest.mark.parametrize("name", ["double_pendulum", "cube_slope"])
def test_a_ground_that_varies_is_refused(name):
    with pytest.raises(ValueError, match=f"one ground .* got '{name}'"):
        find_isometries(load_scene(name))


QUADRUPED = """
<mujoco>
  <option timestep="0.005"/>
  <default>
    <joint type="hinge" axis="0 1 0" damping="0.3" armature="0.01" range="-60 60"/>
    <geom density="400"/>
  </default>
  <worldbody>
    <geom type="plane" size="20 20 0.1"/>
    <body pos="0 0 0.45">
      <freejoint/>
      <geom type="box" size="0.2 0.12 0.04"/>
      {legs}
    </body>
  </worldbody>
  <actuator>{motors}</actuator>
  {more}
</mujoco>
"""
LEG = """
<body name="leg{n}" pos="{x} {y} 0"><joint name="h{n}"/>
  <geom type="capsule" size="0.025" fromto="0 0 0 0 0 -0.18" {thigh}/>
  <body pos="0 0 -0.18"><joint name="k{n}" {knee}/>
    <geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.18"/>
  </body>
</body>
"""


USUAL = {"knee": 'range="-90 20"', "thigh": ""}


def quadruped(folder: Path, more: str = "", **first: str) -> Scene:
    """A robot with a left and a right side, whose ``first`` leg may be another one."""
    legs, motors = "", ""
    for n, (x, y) in enumerate(product((0.18, -0.18), (0.14, -0.14))):
        legs += LEG.format(n=n, x=x, y=y, **(USUAL | first if n == 0 else USUAL))
        for joint in "hk":
            motors += f'<motor joint="{joint}{n}" gear="8" ctrlrange="-1 1"/>'
    path = folder / "robot.xml"
    path.write_text(QUADRUPED.format(legs=legs, motors=motors, more=more))
    return Scene.from_mjcf(path)


@pytest.mark.parametrize(
    ("first", "order", "near"),
    [
        ({}, 2, 2),
        ({"knee": 'range="-90 22"'}, 1, 2),
        ({"knee": 'range="-90 20" damping="0.31"'}, 1, 2),
        ({"knee": 'range="-90 20" damping="30"'}, 1, 1),
        ({"knee": 'range="-90 20" armature="0.0101"'}, 1, 2),
        ({"thigh": 'friction="0.9"'}, 1, 1),
        ({"thigh": 'density="410"'}, 1, 2),
        ({"more": '<contact><exclude body1="leg0" body2="leg2"/></contact>'}, 1, 1),
        ({"more": '<contact><exclude body1="leg0" body2="leg1"/></contact>'}, 2, 2),
    ],
    ids=str,
)
def test_a_robot_that_touches_itself_may_have_a_mirror(first, order, near, tmp_path):
    """MuJoCo's contacts of two of its shapes do not always commute with its mirror.

    A leg that is a little unlike the others is found all the same, and one that touches
    others. Some of these robots are nearly symmetric.
    """
    scene = quadruped(tmp_path, **first)
    assert own_contacts(scene.model)
    assert len(find_isometries(scene)) == order
    assert len(find_isometries(scene, is_near=True)) == near


TWO_ARMS = """
<mujoco>
  <default><geom type="capsule" size="0.03" density="500"/></default>
  <worldbody>
    <body pos="1 2 0.5">
      <joint name="lift" type="slide" axis="0 0 1"/>
      <geom fromto="0 -0.2 0 0 0.2 0"/>
      <body pos="0 0.2 0"><joint name="left" axis="0.6 0 0.8" range="-80 {high}"/>
        <geom fromto="0 0 0 0 0.3 -0.2"/><site name="hand"/></body>
      <body pos="0 -0.2 0"><joint name="right" axis="0.6 0 0.8" range="-70 80"/>
        <geom fromto="0 0 0 0 -0.3 -0.2"/></body>
    </body>
  </worldbody>
  <actuator>{actuators}</actuator>
</mujoco>
"""
MOTORS = '<motor joint="right"/><motor joint="left"/>'
SERVO = '<position joint="{}" kp="{}" kv="0.5" ctrlrange="{}"/>'


def two_arms(folder: Path, high: float = 70, actuators: str = MOTORS) -> Scene:
    """A lift with two arms, whose range ends at ``high`` degrees on the left."""
    path = folder / "arms.xml"
    path.write_text(TWO_ARMS.format(high=high, actuators=actuators))
    return Scene.from_mjcf(path)


@pytest.mark.parametrize(("high", "order"), [(70, 2), (75, 1)])
def test_two_arms_of_a_fixed_base_anywhere_are_mirrored(high, order, tmp_path):
    """The hinges turn about axes that the mirror does not put on each other as they are."""
    found = find_isometries(two_arms(tmp_path, high))
    assert len(found) == order
    for mirror in found[1:]:
        qpos = torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64)
        assert mirror.qpos(qpos).tolist() == [0.1, -0.3, -0.2]
        torque = torch.tensor([1.0, 2.0], dtype=torch.float64)
        assert mirror.torque(torque).tolist() == [-2.0, -1.0]


@pytest.mark.parametrize(
    ("right", "order"),
    [((30, "-1 0.5"), 2), ((31, "-1 0.5"), 1), ((30, "-1 0.4"), 1)],
    ids=["alike", "another law", "another range"],
)
def test_controls_of_servos_are_mirrored(right, order, tmp_path, generator):
    servos = SERVO.format("right", *right) + SERVO.format("left", 30, "-0.5 1")
    scene = two_arms(tmp_path, actuators=servos)
    symmetry = Symmetry(scene)
    assert len(symmetry.isometries) == order
    data = simulate(scene, 8, 10, generator)
    encode = SceneFeatures(scene), StateDelta(scene)
    dynamics = MujocoDynamics(scene)
    for number, mirror in enumerate(symmetry.isometries):
        copy, choice = mirror(data), torch.full((8,), number)
        if number == 1:
            assert copy[CTRL][0, 0].tolist() == (-data[CTRL][0, 0].flip(0)).tolist()
        dynamics.reset(copy[:, 0])
        path = dynamics.rollout(copy[:, 0], None, None, copy[CTRL])
        for key, there in ((QPOS, NEXT_QPOS), (QVEL, NEXT_QVEL)):
            torch.testing.assert_close(path[key], copy[there], rtol=1e-7, atol=1e-7)
        both = symmetry.tokens, symmetry.targets
        here, mirrored = raw_tokens(*encode, data), raw_tokens(*encode, copy)
        for copies, x, expected in zip(both, here, mirrored, strict=True):
            torch.testing.assert_close(copies(x, choice), expected)


def test_a_servo_that_no_joint_has_is_refused(tmp_path):
    servo = '<position site="hand" kp="3" gear="1 0 0 0 0 0"/>'
    with pytest.raises(ValueError, match="actuators on them and one ground .*arms.xml"):
        find_isometries(two_arms(tmp_path, actuators=servo))


def test_a_feature_that_only_the_data_fill_is_refused(generator):
    """A planar walker's contacts have no speed out of its plane, in data neither."""
    symmetry = symmetry_of("gymnasium/Walker2d-v5")
    scene = load_scene(symmetry.name)
    stats = data_stats(scene, simulate(scene, 8, 50, generator))
    symmetry.complete(stats)
    unseen = symmetry.is_still.nonzero()[:, 0]
    assert len(unseen)
    stats[TOKEN].m2[unseen[0]] = 1.0
    with pytest.raises(
        ValueError, match=rf"got none for \[{unseen[0]}\]: train without"
    ):
        symmetry.complete(stats)


@pytest.mark.parametrize(
    ("more", "order"),
    [
        ({}, 8),
        ({"damping:hip_1": (0.0, 5.0)}, 2),
        ({"slope:y": (0.0, 0.1)}, 4),
        ({"motor:hip_1": (0.6, 1.2), "delay": (1, 2)}, 2),
    ],
    ids=["whole robot", "one leg", "slope", "one motor, late"],
)
def test_varied_robots_keep_the_isometries_that_all_of_them_have(
    more, order, generator
):
    scene = load_scene("ant").vary({"payload:torso": (0.0, 20.0), "motor": (0.6, 1.2)})
    scene = scene.vary(scene.variation.ranges | more)
    symmetry = Symmetry(scene, FeatureConfig(parameters=True))
    assert len(symmetry.isometries) == order
    data = simulate(scene, 20, 6, generator)
    data = data[is_sound(data)]
    dynamics = MujocoDynamics(scene)
    for isometry in symmetry.isometries:
        copy = isometry(data)
        assert torch.equal(copy[PARAMETERS], data[PARAMETERS])
        start = copy[:, 0]
        dynamics.reset(start)
        after = dynamics.step(start, start[JOINT_TORQUE])
        torch.testing.assert_close(
            after[QVEL], copy[NEXT_QVEL][:, 0], rtol=0.0, atol=1e-4
        )


def test_isometries_that_features_do_not_have_are_left_out(tmp_path):
    """Such as what bounds a motor, which few steps tell."""
    scene = quadruped(tmp_path, knee='range="-90 20" actuatorfrcrange="-1 1"')
    assert len(find_isometries(scene)) == 2
    assert Symmetry(scene).counts() == [1]
    with pytest.raises(SettingError, match="expected symmetries 1, .* got 2"):
        Symmetry(scene).mirrors(2)


def test_products_that_are_no_isometries_are_no_symmetries():
    """A robot so nearly symmetric that the product of two mirrors is refused."""
    one, three = [1.0, 1.0, 1.0], [0, 1, 2]
    flips = [[-1.0, 1.0, 1.0], [1.0, -1.0, 1.0]]
    copies = SignedPermutations([(three, signs) for signs in (one, *flips)])
    assert copies.mirrors(2) == [0, 1]
    assert copies.mirrors(4) is None


def small_model(name: str, generator: Generator) -> tuple[NeRD, TensorDict]:
    """An untrained one whose statistics have the symmetries, and its data."""
    scene = load_scene(name)
    data = simulate(scene, 20, 10, generator)
    data = data[is_sound(data)]
    stats = symmetry_of(name).complete(data_stats(scene, data))
    return NeRD(scene, NO_PREDICTIONS, MLPConfig(1, 16), stats), data


@pytest.mark.parametrize("name", ["ant", "cube", "dm_control/walker-walk"])
def test_the_range_of_a_training_has_the_symmetries(name, generator):
    """So that what is clamped is so in every symmetric copy."""
    model, data = small_model(name, generator)
    symmetry = symmetry_of(name)
    cover(model, data)
    seen, before = model.training_range, copy.deepcopy(model.training_range)
    symmetry.complete_range(seen)
    for key, copies in (("feature", symmetry.tokens), ("target", symmetry.targets)):
        low, high = seen.get_buffer(f"{key}_low"), seen.get_buffer(f"{key}_high")
        assert (low <= before.get_buffer(f"{key}_low")).all()
        assert (high >= before.get_buffer(f"{key}_high")).all()
        x = 3.0 * torch.randn(50, 1, len(low), dtype=torch.float64, generator=generator)
        for number in range(len(symmetry.isometries)):
            choice = torch.full((len(x),), number)
            there = copies(x.clamp(low, high), choice)
            torch.testing.assert_close(copies(x, choice).clamp(low, high), there)
    q, v = symmetry.isometries[0].base
    ends, speed = torch.stack((seen.qpos_low, seen.qpos_high))[:, q:], seen.speed[v:]
    for isometry in symmetry.isometries:
        there = isometry.joints(ends).sort(0).values
        torch.testing.assert_close(there, ends, atol=1e-12, rtol=0)
        assert (isometry.joints(speed).abs() == speed).all()
    assert (seen.qpos_low <= before.qpos_low).all()
    assert (seen.speed >= before.speed).all()


@pytest.mark.parametrize("name", ["ant", "cube", "dm_control/walker-walk"])
def test_the_score_of_a_copy_is_that_of_the_original(name, generator):
    """Without the copies of the data it is another one."""
    model, data = small_model(name, generator)
    symmetry = symmetry_of(name)
    x = 3.0 * torch.randn(50, 1, symmetry.tokens.signs.shape[1], generator=generator)
    x = x.double()

    def scores() -> Tensor:
        """Of every copy (K, 50)."""
        every = torch.arange(len(symmetry.isometries))[:, None].expand(-1, 50)
        there = [symmetry.tokens(x, choice) for choice in every]
        return model.ood.mahalanobis(torch.stack(there)[:, :, 0]) / model.ood.reach

    cover(model, data, copies=symmetry.tokens.copies)
    torch.testing.assert_close(scores(), scores()[:1].expand_as(scores()))
    cover(model, data)
    assert (scores() - scores()[0]).abs().amax() > 0.01


@pytest.fixture
def data(scene, generator):
    data = simulate(scene, 60, 40, generator)
    return data[is_sound(data)]


def test_a_copy_of_a_trajectory_is_the_trajectory_of_the_copy(scene, data):
    """Whole rollouts of the MuJoCo solver, impacts included."""
    steps, start = 10, data[:, 0]
    torque = data[JOINT_TORQUE][:, :steps]
    dynamics = MujocoDynamics(scene, num_threads=1)
    for isometry in symmetry_of(scene.name).isometries:
        mirrored = isometry(start)
        dynamics.reset(mirrored)
        path = dynamics.rollout(mirrored, isometry.torque(torque))
        expected = isometry.qpos(data[NEXT_QPOS][:, :steps])
        assert _apart(scene, path[QPOS], expected).median() < 1e-9
        assert _apart(scene, path[QPOS], expected).max() < 1e-3  # sensitive, in contact
        expected = isometry.qvel(data[NEXT_QVEL][:, :steps])
        assert (path[QVEL] - expected).abs().median() < 1e-8


def _apart(scene: Scene, a: Tensor, b: Tensor) -> Tensor:
    if not scene.base.is_floating:
        return (a - b).abs().amax(-1)
    rest = torch.cat((a[..., :3] - b[..., :3], a[..., 7:] - b[..., 7:]), -1)
    return rest.abs().amax(-1) + orientation_error(a[..., 3:7], b[..., 3:7])


def test_the_group_is_closed_and_has_inverses(scene, data):
    """Every product of two is one of them again."""
    state = data[:, 0]
    group = symmetry_of(scene.name).isometries
    copies = [isometry(state) for isometry in group]
    for first in group[:8]:
        for second in group[-8:]:
            twice = second(first(state))
            gaps = [
                _apart(scene, twice[QPOS], mirrored[QPOS]).max() for mirrored in copies
            ]
            assert min(gaps) < 1e-9


def test_tokens_and_targets_are_renumbered(scene, data):
    symmetry = symmetry_of(scene.name)
    encode = SceneFeatures(scene), StateDelta(scene)
    flat = data.flatten(0, 1)[::7]
    here = raw_tokens(*encode, flat)
    for number, isometry in enumerate(symmetry.isometries):
        there = raw_tokens(*encode, isometry(flat))
        choice = torch.full((len(flat),), number)
        both = symmetry.tokens, symmetry.targets
        for copies, x, expected in zip(both, here, there, strict=True):
            mirrored = copies(x[:, None], choice)[:, 0]
            torch.testing.assert_close(mirrored, expected, rtol=1e-6, atol=1e-6)


def test_statistics_are_those_of_all_copies(scene, data):
    """So that normalised vectors are renumbered as raw ones are."""
    symmetry = symmetry_of(scene.name)
    found = symmetry.complete(data_stats(scene, data))
    copies = [isometry(data) for isometry in symmetry.isometries]
    expected = data_stats(scene, torch.cat(copies))
    for key, own in ((TOKEN, symmetry.tokens), (TARGET, symmetry.targets)):
        assert found[key].count == expected[key].count
        torch.testing.assert_close(
            found[key].mean, expected[key].mean, atol=1e-6, rtol=0
        )
        torch.testing.assert_close(
            found[key].std, expected[key].std, rtol=1e-5, atol=1e-6
        )
        for source, sign in zip(own.sources, own.signs, strict=True):
            mean, std = found[key].mean, found[key].std
            torch.testing.assert_close(mean, sign * mean[source], atol=1e-9, rtol=1e-9)
            torch.testing.assert_close(std, std[source], atol=1e-12, rtol=1e-9)


def test_batches_show_symmetric_copies_of_the_data(scene, data, generator):
    """Those of one step and those of rollouts, which the MuJoCo solver also takes."""
    symmetry = symmetry_of(scene.name)
    model = NeRD(
        scene,
        NO_PREDICTIONS,
        MLPConfig(1, 4),
        symmetry.complete(data_stats(scene, data)),
    )
    sequences = Sequences(model, data, symmetry)
    qpos, qvel, torque, terrain, _ = sequences.rollout(32, 2, generator)
    dynamics = MujocoDynamics(scene, num_threads=1)
    state = data[:32, 0].empty().update({QPOS: qpos[:, 0], QVEL: qvel[:, 0]})
    dynamics.reset(state)
    path = dynamics.rollout(state, torque, terrain)
    assert _apart(scene, path[QPOS], qpos[:, 1:]).median() < 1e-6
    loss = rollout_loss(model, qpos, qvel, torque, terrain, 0.02)
    assert loss.isfinite()
    inputs, targets = sequences.one_step(64, 2, generator)
    assert inputs.token.shape[:2] == targets.shape[:2] == (64, 2)


def test_what_is_no_symmetry_is_refused():
    x = torch.randn(20, 3).double()
    assert match_entries(x, x * torch.tensor([1.0, 2.0, 1.0])) is None
    swapped = torch.stack((x[:, 1], -x[:, 0], x[:, 2]), -1)
    found = [match_entries(x, copy) for copy in (x, swapped)]
    copies = SignedPermutations([one for one in found if one is not None])
    assert copies.sources.tolist() == [[0, 1, 2], [1, 0, 2]]
    assert copies.signs.tolist() == [[1, 1, 1], [1, -1, 1]]


@pytest.mark.slow
def test_training_with_symmetry_resumes_to_the_same_bits(tmp_path):
    scene = load_scene("ant")
    data = simulate(scene, 60, 12, Generator().manual_seed(1))
    config = TrainConfig(
        **dict(
            network="mlp-4x64",
            use_symmetry=True,
            steps=6,
            rollout_steps=4,
            batch_size=16,
        ),
        **dict(
            sequence_length=4, rollout_batch_size=16, rollout_length=4, save_every=4
        ),
        validate_every=20,
    )
    task = make_task("ant/run")

    def train(name: str, *stops: int) -> dict:
        for stop in stops:
            trainer = Trainer(
                scene, data, task, config, tmp_path / name, horizons=(2,), quiet=True
            )
            model = trainer.run(stop)
        return model.state_dict()

    assert config.network in NETWORKS
    whole, parts = train("whole", 10), train("parts", 4, 8, 10)
    assert all(torch.equal(whole[key], parts[key]) for key in whole)
