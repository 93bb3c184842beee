"""Data sets: MuJoCo's transitions in TorchRL's layout, the same bits for one seed."""

from dataclasses import replace

import pytest
import torch
from helpers import mujoco_step
from tensordict import TensorDict

from torchrl_nerd.configs import DataConfig
from torchrl_nerd.data.generate import expect_few_dropped, generate, load_data
from torchrl_nerd.data.simulate import (
    LARGEST,
    SEGMENT,
    first_beyond,
    is_sound,
    simulate,
)
from torchrl_nerd.data.store import chunk_path, read_chunk
from torchrl_nerd.data.strategies import strategy
from torchrl_nerd.dynamics import MujocoDynamics
from torchrl_nerd.files import read_json
from torchrl_nerd.geometry.manifold import joint_label
from torchrl_nerd.robots import load_scene
from torchrl_nerd.seeds import fold_in

SCENE, OTHER = (load_scene(name) for name in ("cartpole", "double_pendulum"))
STATE = ("qpos", "qvel")


def unequal(data: TensorDict, expected: TensorDict) -> list:
    """Keys whose bits differ."""
    assert data.batch_size == expected.batch_size
    keys = set(data.keys(True, True)) | set(expected.keys(True, True))
    return [key for key in keys if not torch.equal(data[key], expected[key])]


def test_layout_is_torchrls(scene, tmp_path, seed):
    config = DataConfig(trajectories=7, steps=5, seed=seed)
    data = load_data(scene, generate(scene, config, tmp_path, quiet=True))
    model = scene.model
    widths = {"qpos": model.nq, "qvel": model.nv, ("next", "qpos"): model.nq}
    widths |= {("next", "qvel"): model.nv, ("next", "joint_torque"): model.nu}
    if scene.terrain is not None and scene.terrain.is_per_env:
        widths["terrain"] = scene.terrain.size
    assert data.batch_size == (7, 5)
    assert {k: data[k].shape for k in data.keys(True, True)} == {
        key: (7, 5, width) for key, width in widths.items()
    }
    assert all(data[key].dtype == torch.float64 for key in widths)
    card = read_json(tmp_path / "data.json")
    assert (card["trajectories"], card["dropped"]) == (7, 0)
    assert card["scene_hash"] == scene.hash and card["config"]["seed"] == seed


def test_sets_follow_each_other_in_the_order_given(scene, tmp_path, seed):
    folders = [tmp_path / name for name in "abc"]
    counts = (3, 1, 4)
    for i, (folder, count) in enumerate(zip(folders, counts, strict=True)):
        config = DataConfig(trajectories=count, steps=2, seed=seed + i)
        generate(scene, config, folder, quiet=True)
    for order in (folders, folders[::-1], folders[:1]):
        parts = [load_data(scene, folder) for folder in order]
        assert not unequal(load_data(scene, *order), torch.cat(parts))
    generate(scene, DataConfig(trajectories=2, steps=3), tmp_path / "d", quiet=True)
    with pytest.raises(ValueError, match=f"of 2 steps, as .* in {tmp_path}/d, got 3"):
        load_data(scene, *[*folders, tmp_path / "d"])
    with pytest.raises(ValueError, match=f"data set in {tmp_path}/none"):
        load_data(scene, *[*folders, tmp_path / "none"])


def test_long_trajectories_are_cut_to_the_length_of_the_first_set(scene, tmp_path):
    for name, steps in (("short", 2), ("long", 6)):
        config = DataConfig(trajectories=3, steps=steps)
        generate(scene, config, tmp_path / name, quiet=True)
    data = load_data(scene, tmp_path / "short", tmp_path / "long")
    assert data.batch_size == (12, 2)
    whole = load_data(scene, tmp_path / "long")
    for i, start in enumerate((0, 2, 4)):
        assert not unequal(data[3 + i :: 3], whole[:, start : start + 2])


def test_every_transition_obeys_the_mujoco_dynamics(scene, generator):
    data = simulate(scene, 16, 6, generator)
    data = data[is_sound(data)]
    for key in STATE:
        assert torch.equal(data["next", key][:, :-1], data[key][:, 1:])
    first = mujoco_step(
        scene, data[:, 0].exclude("next"), data[:, 0]["next", "joint_torque"]
    )
    for key in STATE:  # without a past there is nothing that could differ
        expected, got = first["next", key], data[:, 0]["next", key]
        torch.testing.assert_close(got, expected, rtol=0, atol=1e-12)
    every = data.reshape(-1)  # later steps had a solver that started warm
    again = mujoco_step(scene, every.exclude("next"), every["next", "joint_torque"])
    for key in STATE:
        expected, got = again["next", key], every["next", key]
        torch.testing.assert_close(got, expected, rtol=1e-7, atol=1e-6)
    if scene.terrain is not None and scene.terrain.is_per_env:
        assert torch.equal(data["terrain"], data["terrain"][:, :1].expand(-1, 6, -1))


def test_starts_and_torques_lie_within_the_ranges(scene, generator):
    ranges, data = scene.sampling, simulate(scene, 500, 3, generator)
    first = {"qpos": 7, "qvel": 6} if ranges.base else dict.fromkeys(STATE, 0)
    for key in STATE if ranges.qpos_low else ():
        low, high = (
            torch.tensor(getattr(ranges, f"{key}_{end}")) for end in ("low", "high")
        )
        start = data[key][:, 0, first[key] :]
        assert ((start >= low) & (start <= high)).all()
        spread = start.amax(0) - start.amin(0)
        assert (spread > 0.9 * (high - low)).all()
    if ranges.drive is None:
        torque = data["next", "joint_torque"].abs()
        assert (torque <= torch.tensor(ranges.torque)).all()


def test_passive_and_quiet_rows_have_their_shares(motor_scene, generator):
    scene = motor_scene
    rows, steps = 1000, 30
    data = simulate(scene, rows, steps, generator)
    relative = data["next", "joint_torque"] / torch.tensor(scene.sampling.torque)
    peak = relative.abs().amax((1, 2))
    passive = peak == 0.0
    assert abs(passive.double().mean() - scene.sampling.zero_torque_fraction) < 0.07
    calm = (peak > 0.0) & (peak < 0.7)  # a loud row peaks above 0.7, but for 0.7^30
    share = scene.sampling.low_torque_fraction * 0.72
    assert abs(calm.double().mean() - share) < 0.07
    speed = data["qvel"][:, 0].abs().mean(-1)
    assert 0.35 < speed[passive].mean() / speed[peak > 0.9].mean() < 0.75


def test_shares_of_none_and_all(generator):
    for passive, quiet in ((1.0, 0.0), (0.0, 0.0), (0.0, 1.0)):
        shares = {"zero_torque_fraction": passive, "low_torque_fraction": quiet}
        scene = replace(SCENE, sampling=replace(SCENE.sampling, **shares))
        torque = simulate(scene, 200, 40, generator)["next", "joint_torque"]
        peak = (torque / torch.tensor(scene.sampling.torque)).abs().amax((1, 2))
        if passive:
            assert (peak == 0.0).all()
        else:
            assert (peak > 0.0).all()
            assert (peak < 0.7).double().mean() > 0.4 if quiet else (peak > 0.7).all()


def test_the_seed_decides_every_bit(scene, tmp_path, seed):
    sets = []
    for folder, number in (("a", seed), ("b", seed), ("c", seed + 1)):
        torch.rand(seed % 7)  # other random numbers do not matter
        config = DataConfig(trajectories=9, steps=3, seed=number)
        path = generate(scene, config, tmp_path / folder, quiet=True)
        sets.append(load_data(scene, path))
    assert not unequal(sets[0], sets[1])
    assert not (sets[0]["qpos"] == sets[2]["qpos"]).any()
    torques = (data["next", "joint_torque"] for data in (sets[0], sets[2]))
    assert torch.equal(*torques) != bool(scene.actuated)


def test_soundness_is_finite_and_bounded(generator):
    sound = torch.randn(6, 4, 2, generator=generator).double()
    for key in STATE:
        for row, bad in enumerate((torch.nan, torch.inf, -2 * LARGEST, LARGEST)):
            data = TensorDict({k: sound.clone() for k in STATE}, batch_size=[6, 4])
            column = int(torch.randint(8, (), generator=generator))
            data[key][row].view(-1)[column] = bad
            expected = torch.arange(6) != row
            wrapped = TensorDict({"next": data}, batch_size=[6, 4])
            assert torch.equal(is_sound(wrapped), expected)


def test_broken_trajectories_are_dropped_and_counted(motor_scene, tmp_path, seed):
    scene = motor_scene
    strong = tuple(1e9 * torque for torque in scene.sampling.torque)
    ranges = {"torque": strong, "zero_torque_fraction": 0.5, "low_torque_fraction": 0.0}
    wild = replace(scene, sampling=replace(scene.sampling, **ranges))
    config = DataConfig(trajectories=60, steps=2, seed=seed)
    generate(wild, config, tmp_path, quiet=True)
    data = read_chunk(chunk_path(tmp_path, 0), 2)
    card = read_json(tmp_path / "data.json")
    assert card["trajectories"] == len(data) == 60 - card["dropped"]
    assert 10 < len(data) < 50
    assert is_sound(data).all()
    assert (data["next", "joint_torque"] == 0.0).all()
    drawn = simulate(wild, 60, 2, fold_in(seed, 0))
    assert not unequal(data, drawn[is_sound(drawn)])
    with pytest.raises(ValueError, match=f"{card['dropped']} of 60 did not"):
        load_data(wild, tmp_path)


@pytest.mark.parametrize("size", [0, -3])
@pytest.mark.parametrize("name", ["trajectories", "steps"])
def test_sizes_below_one_are_refused(name, size):
    with pytest.raises(ValueError, match=f"expected {name} of at least 1, got {size}"):
        DataConfig(**{name: size})


def test_a_folder_that_cannot_be_written_is_named(tmp_path):
    config = DataConfig(trajectories=2, steps=1)
    place = tmp_path / "taken"
    place.write_text("not a folder")
    for folder in (place, place / "below"):
        with pytest.raises(ValueError, match=f"can be written, got {folder}"):
            generate(SCENE, config, folder, quiet=True)
    assert place.read_text() == "not a folder"


def test_loading_says_what_is_wrong(tmp_path):
    with pytest.raises(ValueError, match=f"{tmp_path}, found no data.json"):
        load_data(SCENE, tmp_path)
    generate(SCENE, DataConfig(trajectories=2, steps=1), tmp_path, quiet=True)
    assert load_data(SCENE, tmp_path).batch_size == (2, 1)
    with pytest.raises(ValueError, match=f"'{SCENE.name}'.*expected '{OTHER.name}'"):
        load_data(OTHER, tmp_path)


def test_many_dropped_trajectories_are_refused_by_name(scene, generator):
    """The first to leave the bounds is named; a few may."""
    data = simulate(scene, 4, 3, generator)
    name = joint_label(scene.model, scene.model.njnt - 1)
    for row, step in ((1, 2), (2, 0)):
        data["next", "qvel"][row, step:, -1] = 2.0 * LARGEST
        data["next", "qpos"][row, step + 1 :] = torch.inf
    data["next", "qpos"][3, 1:] = data["next", "qvel"][3, 1:] = torch.nan
    assert is_sound(data).tolist() == [True, False, False, False]
    found = first_beyond(scene, data[1:])
    assert found == [f"qvel of joint '{name}'"] * 2 + ["MuJoCo"]
    card = {"trajectories": 95, "dropped": 5, "beyond": {found[0]: 4, "MuJoCo": 1}}
    expect_few_dropped(card)
    card["trajectories"] = 94
    with pytest.raises(ValueError, match="5 of 99 did not; first beyond it: qvel of"):
        expect_few_dropped(card)


RANGES = {"mass:pole": (0.3, 3.0), "motor": (0.6, 1.4), "delay": (0, 2)}


def test_varied_data_are_steps_of_each_trajectorys_own_robot(tmp_path, seed):
    scene = SCENE.vary(RANGES)
    config = DataConfig(trajectories=9, steps=20, seed=seed)
    data = load_data(scene, generate(scene, config, tmp_path, quiet=True))
    own = data["parameters"]
    assert (
        torch.equal(own, own[:, :1].expand_as(own))
        and len(own[:, 0].unique(dim=0)) == 9
    )
    assert not unequal(data, simulate(scene, 9, 20, fold_in(seed, 0)))
    dynamics, state = MujocoDynamics(scene), data[:, 0].select(*STATE, "parameters")
    dynamics.reset(state)
    for t in range(20):
        state = dynamics.step(state, data[:, t]["next", "joint_torque"])
        for key in STATE:
            assert torch.equal(state[key], data[:, t]["next", key])


def test_hidden_parameters_change_once_between_two_segments(seed):
    """Every step is one of MuJoCo with the parameters that the data give it."""
    scene, rows, steps = SCENE.vary(RANGES), 40, 3 * SEGMENT
    data = strategy(scene, "changing")(rows, steps, fold_in(seed, 0))
    own, dynamics = data["parameters"], MujocoDynamics(scene)
    is_new = (own[:, 1:] != own[:, :-1]).any(-1)  # (rows, steps - 1)
    assert not is_new[: rows // 2].any() and is_new.sum(1).max() == 1
    assert set((is_new.nonzero()[:, 1] + 1).tolist()) == {SEGMENT, 2 * SEGMENT}
    is_kept = own[rows // 2 :, 0] == own[rows // 2 :, -1]
    assert (0.2 < is_kept.double().mean(0)).all() and (
        is_kept.double().mean(0) < 0.8
    ).all()
    state = data[:, 0].select(*STATE)
    dynamics.reset(state)
    for t in range(steps):
        state["parameters"] = own[:, t]
        state = dynamics.step(state, data[:, t]["next", "joint_torque"])
        for key in STATE:
            assert torch.equal(state[key], data[:, t]["next", key])


def test_robots_that_change_need_two_segments(seed):
    with pytest.raises(
        ValueError, match="of more than 16 steps for robots that change"
    ):
        strategy(SCENE.vary(RANGES), "changing")(4, SEGMENT, fold_in(seed, 0))


def test_data_of_other_parameters_are_refused(tmp_path):
    varied, config = SCENE.vary(RANGES), DataConfig(trajectories=2, steps=2)
    generate(varied, config, tmp_path / "varied", quiet=True)
    generate(SCENE, config, tmp_path / "plain", quiet=True)
    other = SCENE.vary(RANGES | {"delay": (0, 1)})
    for scene, folder in ((SCENE, "varied"), (other, "varied"), (varied, "plain")):
        with pytest.raises(ValueError, match=f"expected data that vary .*{folder}"):
            load_data(scene, tmp_path / folder)
        with pytest.raises(ValueError, match="holds data with variation"):
            generate(scene, config, tmp_path / folder, quiet=True)
