"""TorchRL's contract of a transform, for each of the four on every scene with a task."""

import pytest
import torch
from helpers import slow_but
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.envs import (
    Compose,
    ParallelEnv,
    SerialEnv,
    TransformedEnv,
    check_env_specs,
)
from transform_helpers import (
    STEPS,
    TASK_OF,
    TRANSFORMS,
    assert_transformed,
    creators,
    features_of,
    make_buffer,
    make_compose,
    make_transform,
    plain_env,
    recorded,
    transformed_env,
)

from torchrl_nerd.keys import NEXT_QPOS, NEXT_QVEL, OBSERVATION, QPOS, QVEL, STATE_DELTA
from torchrl_nerd.robots import load_scene
from torchrl_nerd.transforms import Normalize, RobotCentric, Stats

each_transform = pytest.mark.parametrize("name", TRANSFORMS)
each_scene = pytest.mark.parametrize("scene", TASK_OF)


def each_slow_but(quick):
    """Two processes an env: what is of a scene, one process shows as well."""
    return pytest.mark.parametrize("scene", slow_but([quick], TASK_OF))


def check(env, *names):
    """Specs hold, and every state of a rollout with resets in it carries its features."""
    try:
        check_env_specs(env)
        rollout = env.rollout(STEPS, break_when_any_done=False)
        for name in names:
            assert_transformed(name, env.scene_name, rollout)
    finally:
        env.close(raise_if_closed=False)


def named(env, scene):
    env.__dict__["scene_name"] = scene
    return env


@each_transform
@each_scene
def test_single_trans_env_check(name, scene):
    check(named(transformed_env(scene, name), scene), name)


@each_transform
@each_scene
def test_serial_trans_env_check(name, scene):
    env = SerialEnv(2, creators(scene, of_transformed=True, name=name))
    check(named(env, scene), name)


@each_slow_but("cartpole")
def test_parallel_trans_env_check(scene):
    env = ParallelEnv(2, creators(scene, of_transformed=True))
    check(named(env, scene), *TRANSFORMS)


@each_transform
@each_scene
def test_trans_serial_env_check(name, scene):
    env = SerialEnv(2, creators(scene, of_transformed=False))
    env = TransformedEnv(env, make_transform(name, scene))
    check(named(env, scene), name)


@pytest.mark.slow
@each_scene
def test_trans_parallel_env_check(scene):
    env = ParallelEnv(2, creators(scene, of_transformed=False))
    check(named(TransformedEnv(env, make_compose(scene)), scene), *TRANSFORMS)


@each_transform
@each_scene
def test_transform_no_env(name, scene):
    rows, transform = recorded(scene), make_transform(name, scene)
    out = transform(rows.clone())
    assert set(transform.out_keys) <= set(out.keys(True))
    if name == "StateDelta":
        out["next", STATE_DELTA] = out[STATE_DELTA]
        assert_transformed(name, scene, out)
    else:
        for key, want in features_of(name, scene, rows).items():
            torch.testing.assert_close(out[key], want)


@each_transform
@each_scene
def test_transform_compose(name, scene):
    rows = recorded(scene)
    alone = make_transform(name, scene)(rows.clone())
    composed = Compose(make_transform(name, scene))(rows.clone())
    assert (alone == composed).all()
    together = make_compose(scene)(rows.clone())
    keys = make_transform(name, scene).out_keys
    assert (together.select(*keys) == alone.select(*keys)).all()


@each_transform
@each_scene
def test_transform_env(name, scene):
    """Reset and step, each looked at by itself; old data stay as they were."""
    env = transformed_env(scene, name)
    root = env.reset()
    if name == "StateDelta":
        assert not root[STATE_DELTA].any()
    else:
        for key, want in features_of(name, scene, root).items():
            torch.testing.assert_close(root[key], want)
    kept = root.clone()
    step = env.step(env.rand_action(root.clone()))
    assert_transformed(name, scene, step)
    env.step(env.rand_action(step["next"].clone()))
    assert (root == kept).all()
    rows = torch.tensor([[True], [False], [False]])
    again = env.reset(step["next"].clone().set("_reset", rows))
    for key in make_transform(name, scene).out_keys:
        if key in again.keys():
            assert torch.equal(again[key][1:], step["next", key][1:])


@each_transform
@each_scene
def test_transform_model(name, scene):
    transform, rows = make_transform(name, scene), recorded(scene)
    want = transform(rows.clone())
    for key in transform.out_keys:
        linear = nn.Linear(want[key].shape[-1], 5, dtype=want[key].dtype)
        module = TensorDictModule(linear, in_keys=[key], out_keys=["out"])
        model = nn.Sequential(make_transform(name, scene), module)
        out = model(rows.clone())["out"]
        torch.testing.assert_close(out, linear(want[key]))
        out.sum().backward()
        gradient = want[key].sum(0).expand_as(linear.weight)
        torch.testing.assert_close(linear.weight.grad, gradient)


@each_transform
@each_scene
def test_transform_rb(name, scene):
    """A buffer stores what it was given and samples it with the features."""
    rows = recorded(scene)
    buffer = make_buffer(make_transform(name, scene))
    buffer.extend(rows.clone())
    stored = buffer._storage[:].clone()
    assert (stored.select(*rows.keys(True, True)) == rows).all()
    want = make_transform(name, scene)(rows.clone())
    for _ in range(2):  # sampling leaves the storage alone
        sample = buffer.sample()
        chosen = want[sample["index"].reshape(-1)]
        for key in make_transform(name, scene).out_keys:
            torch.testing.assert_close(sample[key], chosen[key])
        torch.testing.assert_close(sample["next"], chosen["next"])


@each_transform
@each_scene
def test_transform_inverse(name, scene):
    rows, transform = recorded(scene), make_transform(name, scene)
    out = transform(rows.clone())
    if name == "StateDelta":
        back = transform.inv(out.select(QPOS, QVEL, STATE_DELTA))
        for key in (NEXT_QPOS, NEXT_QVEL):
            torch.testing.assert_close(back[key], rows[key])
    elif name == "Normalize":
        back = transform.denormalize(OBSERVATION, out[OBSERVATION])
        torch.testing.assert_close(back, rows[OBSERVATION])
    elif transform.out_keys:
        with pytest.raises(ValueError, match=f"{name} has no inverse: "):
            transform.inv(out.select(*transform.out_keys))
    else:
        assert (transform.inv(rows.clone()) == rows).all()


@each_transform
@each_scene
def test_an_env_moves_as_it_does_without_the_transform(name, scene):
    env, plain = transformed_env(scene, name), plain_env(scene)
    root, bare = env.reset(), plain.reset()
    for _ in range(STEPS):
        action = plain.rand_action(bare.clone())["action"]
        root = env.step(root.set("action", action))["next"]
        bare = plain.step(bare.set("action", action))["next"]
        for key in (QPOS, QVEL, "reward", "done"):
            assert torch.equal(root[key], bare[key])


def test_tensors_may_be_given_by_their_names(generator):
    """As to TorchRL's own transforms: they give the tensors alone."""
    scene = load_scene("cartpole")
    qpos, qvel = torch.randn(2, 5, 2, generator=generator).double()
    transform = RobotCentric(scene)
    found = transform(qpos=qpos, qvel=qvel)
    expected = transform(TensorDict({"qpos": qpos, "qvel": qvel}, [5]))
    assert torch.equal(found, expected["robot_state"])
    normalize = Normalize({"x": Stats.of(qpos)})
    expected = normalize(TensorDict({"x": qpos.clone()}, [5]))["x"]
    assert torch.equal(normalize(x=qpos.clone()), expected)
