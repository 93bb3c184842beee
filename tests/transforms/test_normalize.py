"""Statistics that are exact, merge, travel and stay as they were."""

import copy

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import check_env_specs

from torchrl_nerd import make_env
from torchrl_nerd.transforms import Normalize, Stats

ROWS, WIDTH = 1000, 4


def samples(generator, rows=ROWS, offset=0.0, scale=1.0):
    draw = torch.randn(rows, WIDTH, dtype=torch.float64, generator=generator)
    return offset + scale * draw


def as_rows(**values):
    return TensorDict(values, batch_size=[len(next(iter(values.values())))])


@pytest.mark.parametrize("offset", [0.0, 1e3, 1e8])
@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e6])
def test_mean_becomes_zero_and_spread_one(offset, scale, generator):
    scale = max(scale, 1e-5 * offset)  # above the floor
    x = samples(generator, offset=offset, scale=scale)
    out = Normalize({"x": Stats.of(x)})(as_rows(x=x.clone()))["x"]
    assert out.mean(0).abs().max() < 1e-9 * (1.0 + offset / scale)
    assert (out.std(0, correction=0) - 1.0).abs().max() < 1e-6


def test_statistics_are_torchs(generator):
    x = samples(generator, offset=3.0, scale=2.0)
    stats = Stats.of(x.reshape(10, 5, -1, WIDTH))
    assert stats.count == ROWS and stats.mean.dtype == torch.float64
    torch.testing.assert_close(stats.mean, x.mean(0))
    torch.testing.assert_close(stats.std, x.std(0, correction=0))


@pytest.mark.parametrize("offset", [0.0, 1e8])
def test_merged_statistics_are_those_of_everything(offset, generator):
    scale = 1.0 + 100.0 * (offset > 0.0)
    x = samples(generator, offset=offset, scale=scale)
    x += torch.linspace(0.0, 5.0, ROWS, dtype=torch.float64)[:, None]  # unequal parts
    cuts = torch.randperm(ROWS - 1, generator=generator)[:4].sort().values + 1
    parts = [Stats.of(part) for part in x.tensor_split(cuts)]
    forth, back = parts[0], parts[-1]
    for part in parts[1:]:
        forth = forth.merge(part)
    for part in parts[-2::-1]:
        back = part.merge(back)
    whole = Stats.of(x)
    for merged in (forth, back):
        assert merged.count == whole.count
        torch.testing.assert_close(merged.mean, whole.mean, rtol=1e-14, atol=1e-12)
        torch.testing.assert_close(merged.m2, whole.m2, rtol=1e-10, atol=0.0)


def test_the_order_of_merging_two_does_not_matter(generator):
    a, b = (Stats.of(samples(generator, rows, rows)) for rows in (1, 500))
    one, other = a.merge(b), b.merge(a)
    torch.testing.assert_close(one.mean, other.mean)
    torch.testing.assert_close(one.m2, other.m2)


def test_a_constant_stays_finite_and_comes_back(generator):
    x = samples(generator)
    x[:, 0], x[:, 1], x[:, 2] = 0.0, 7.0, -1e9
    transform = Normalize({"x": Stats.of(x)})
    out = transform(as_rows(x=x.clone()))["x"]
    assert out.isfinite().all() and out[:, :3].abs().max() < 1e-6
    torch.testing.assert_close(transform.denormalize("x", out), x)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_inverse_returns_what_went_in(dtype, generator):
    x = samples(generator, offset=50.0, scale=0.1).to(dtype)
    transform = Normalize({"x": Stats.of(x)})
    normal = transform.normalize("x", x)
    back = transform.denormalize("x", normal)
    assert normal.dtype == back.dtype == dtype
    tolerance = 1e-5 if dtype == torch.float32 else 1e-13
    torch.testing.assert_close(back, x, rtol=tolerance, atol=0.0)


def test_huge_offsets_cost_no_digits(generator):
    """float64 inside: features at 1e6 with a spread of 1e-2 keep nine digits of it."""
    x = samples(generator, offset=1e6, scale=3.0)
    normal = Normalize({"x": Stats.of(x)}).normalize("x", x)
    want = (x - 1e6 - (x - 1e6).mean(0)) / (x - 1e6).std(0, correction=0)
    torch.testing.assert_close(normal, want, rtol=0.0, atol=1e-9)


def test_a_deep_copy_has_statistics_of_its_own(generator):
    x = samples(generator)
    transform = Normalize({"x": Stats.of(x)})
    other = copy.deepcopy(transform)
    for buffer in other.buffers():
        buffer.add_(1.0)
    before, after = (t.normalize("x", x) for t in (transform, other))
    assert torch.equal(before, Normalize({"x": Stats.of(x)}).normalize("x", x))
    assert not torch.allclose(before, after)


def test_it_shares_no_memory_with_the_statistics_it_got(generator):
    x = samples(generator)
    stats = Stats.of(x)
    transform = Normalize({"x": stats})
    before = transform.normalize("x", x)
    stats.mean.add_(5.0)
    stats.m2.mul_(4.0)
    assert torch.equal(transform.normalize("x", x), before)


def test_statistics_travel_in_the_state_dict(generator):
    x, y = samples(generator, offset=2.0), samples(generator, offset=-3.0)
    stats = {"x": Stats.of(x), ("next", "y"): Stats.of(y)}
    other = Normalize({"x": Stats.of(y), ("next", "y"): Stats.of(x)})
    transform = Normalize(stats)
    other.load_state_dict(transform.state_dict())
    for key, value in (("x", x), (("next", "y"), y)):
        got, want = other.normalize(key, value), transform.normalize(key, value)
        assert torch.equal(got, want)
    assert not list(transform.parameters())


def test_running_changes_no_statistics(generator):
    transform = Normalize({"x": Stats.of(samples(generator))}).train()
    before = copy.deepcopy(transform.state_dict())
    for _ in range(3):
        transform(as_rows(x=samples(generator, offset=100.0)))
    after = transform.state_dict()
    assert all(torch.equal(before[name], after[name]) for name in before)


def test_nested_keys_and_absent_ones(generator):
    x, y = samples(generator), samples(generator, offset=9.0)
    transform = Normalize({"x": Stats.of(x), ("next", "y"): Stats.of(y)})
    rows = as_rows(x=x.clone(), z=y.clone())
    rows["next", "y"] = y.clone()
    out = transform(rows)
    assert torch.equal(out["z"], y)
    torch.testing.assert_close(
        out["next", "y"], (y - y.mean(0)) / y.std(0, correction=0)
    )
    assert "x" not in transform(as_rows(z=y.clone())).keys()


def test_keys_that_are_spelt_alike_have_statistics_of_their_own(generator):
    values = {"a_b": samples(generator), ("a", "b"): samples(generator, offset=9.0)}
    stats = {key: Stats.of(value) for key, value in values.items()}
    for order in (list(stats), list(stats)[::-1]):
        transform = Normalize({key: stats[key] for key in order})
        assert list(transform.state_dict())[0] == "key_a_b_mean"
        for key in order:
            want = (values[key] - stats[key].mean) / stats[key].std
            assert torch.equal(transform.normalize(key, values[key]), want)


def test_inv_acts_on_the_keys_it_was_told_and_no_others(generator):
    x, y = samples(generator), samples(generator, offset=9.0)
    stats = {"x": Stats.of(x), "y": Stats.of(y)}
    normal = Normalize(stats)(as_rows(x=x.clone(), y=y.clone()))
    assert (Normalize(stats).inv(normal.clone()) == normal).all()
    back = Normalize(stats, in_keys_inv=["y"]).inv(normal.clone())
    torch.testing.assert_close(back["y"], y)
    assert torch.equal(back["x"], normal["x"])


def test_empty_samples_change_no_statistics():
    some, none = Stats.of(torch.randn(9, 3)), Stats.of(torch.empty(0, 3))
    for merged in (some.merge(none), none.merge(some), Stats.merge_all([none, some])):
        assert merged.count == 9 and torch.equal(merged.mean, some.mean)


def test_the_inverse_acts_on_what_an_env_is_given():
    """As TorchRL's ObservationNorm does, with bounds that fit."""
    action = Stats.of(torch.tensor([[0.1], [0.3]]))  # mean 0.2, deviation 0.1
    plain = make_env("cartpole/swingup", "mujoco", num_envs=2, seed=0)
    gain = plain.task.controller.gain[0]
    env = TransformedEnv(plain, Normalize({"action": action}, in_keys_inv=["action"]))
    check_env_specs(env)
    low, high = env.action_spec.space.low, env.action_spec.space.high
    torch.testing.assert_close(low, torch.full((2, 1), -12.0))
    torch.testing.assert_close(high, torch.full((2, 1), 8.0))
    given = env.reset().set("action", torch.full((2, 1), 0.5))
    torque = env.step(given)["next", "joint_torque"]
    torch.testing.assert_close(torque, torch.full((2, 1), 0.25 * gain).double())


def test_an_inverse_without_statistics_is_refused():
    with pytest.raises(ValueError, match=r"with statistics \(\['x'\]\), got \['y'\]"):
        Normalize({"x": Stats.unit(2)}, in_keys_inv=["y"])


def test_a_dot_in_a_key_is_a_key_like_another():
    keys = ("a.b", "a_b_2", "a_b", ("a", "b"))
    transform = Normalize({key: Stats.of(torch.randn(9, 3)) for key in keys})
    assert len({*transform.names.values()}) == len(keys)
    x = torch.randn(4, 3)
    found = transform(TensorDict({"a.b": x}, [4]))["a.b"]
    expected = (x - transform.mean("a.b")) / transform.std("a.b")
    torch.testing.assert_close(found, expected.float())


def test_whole_numbers_and_statistics_of_nothing_are_refused():
    transform = Normalize({"n": Stats.of(torch.tensor([[0.0], [10.0]]))})
    with pytest.raises(
        ValueError, match="n of floating-point numbers, got torch.int64"
    ):
        transform(TensorDict({"n": torch.tensor([[0], [7]])}, [2]))
    with pytest.raises(ValueError, match="statistics of samples, got none of"):
        Normalize({"n": Stats.of(torch.empty(0, 1))})


def test_another_width_than_that_of_the_statistics_is_refused():
    stats = Stats.of(torch.randn(10, 3))
    transform = Normalize({"x": stats}, in_keys_inv=["x"])
    narrow = TensorDict({"x": torch.randn(4, 1)}, [4])
    for call in (transform, transform.inv):
        with pytest.raises(ValueError, match=r"expected x of width 3, got \[4, 1\]"):
            call(narrow)
    with pytest.raises(ValueError, match=r"statistics of one width, got \(3, 1\)"):
        stats.merge(Stats.of(torch.randn(10, 1)))


def test_bounds_of_what_is_seen_are_normalised():
    env = make_env("cartpole/swingup", "nerd", num_envs=3, seed=0, guard="flag")
    stats = {"trust": Stats.of(torch.rand(100, 1))}
    env = TransformedEnv(env, Normalize(stats))
    check_env_specs(env)
    space = env.observation_spec["trust"].space
    mean, std = stats["trust"].mean.item(), stats["trust"].std.item()
    assert space.low.unique().item() == pytest.approx(-mean / std)
    assert space.high.unique().item() == pytest.approx((1.0 - mean) / std)


def test_a_state_that_is_set_is_given_normalised_too(generator):
    plain = make_env("cartpole/swingup", "mujoco", num_envs=2, seed=0)
    qpos = Stats.of(torch.randn(50, 2, generator=generator) * 3.0 + 1.0)
    env = TransformedEnv(plain, Normalize({"qpos": qpos}, in_keys_inv=["qpos"]))
    seen, was = env.reset(), plain.state["qpos"].clone()
    env.reset(seen.clone(), set_state=True)
    torch.testing.assert_close(plain.state["qpos"], was)
    check_env_specs(env)


def test_samples_that_are_not_finite_or_no_rows_make_no_statistics():
    samples = torch.randn(10, 2)
    samples[3] = torch.nan
    with pytest.raises(
        ValueError, match=r"finite samples, got NaN or infinity in \['x'\]"
    ):
        Normalize({"x": Stats.of(samples)})
    with pytest.raises(ValueError, match=r"expected samples \(\*batch, D\), got \[3\]"):
        Stats.of(torch.zeros(3))
