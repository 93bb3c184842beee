"""Open-loop error: the documented formulas, zero for the ground truth against itself."""

from copy import copy
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import HANDMADE, make_scene, random_quats, random_states
from scipy import stats
from tensordict import TensorDict

from torchrl_nerd.checkpoint import from_pretrained
from torchrl_nerd.dynamics import MujocoDynamics, NeRDDynamics
from torchrl_nerd.evaluation.position_error import position_errors, unit_of
from torchrl_nerd.evaluation.rollout_error import (
    action_drive,
    initial_states,
    motion_before,
    open_loop,
    passive_errors,
    summarize,
)
from torchrl_nerd.robots import TASKS, load_scene, make_task
from torchrl_nerd.seeds import fold_in

ROWS, STEPS = 6, 5


def each(names):
    return pytest.mark.parametrize("name", names)


def random_paths(scene, rng):
    """Two sets of positions ``(ROWS, STEPS, nq)``."""
    for _ in range(2):
        qpos, _ = random_states(scene.model, ROWS * STEPS, rng)
        yield qpos.reshape(ROWS, STEPS, -1)


def angle_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Of two unit quaternions, whatever their signs."""
    return 2.0 * np.arccos(np.clip(np.abs((a * b).sum(-1)), 0.0, 1.0))


def wrapped(difference: np.ndarray) -> np.ndarray:
    return np.abs(np.angle(np.exp(1j * difference)))


def heavier(scene):
    """The same robot with stronger gravity."""
    model = copy(scene.model)
    model.opt.gravity[2] *= 1.1
    return replace(scene, model=model)


def test_the_ground_truth_against_itself_has_no_error(task_id, seed):
    task = make_task(task_id)
    dynamics = [MujocoDynamics(task.scene, num_threads=n) for n in (1, 2)]
    summaries = passive_errors(task, *dynamics, [3, 12], ROWS, seed)
    assert list(summaries) == [3, 12]
    for by_name in summaries.values():
        assert by_name
        for error in by_name.values():
            results = (error.mean, error.interval, error.final, error.p95)
            assert max(results) < 1e-15  # a quaternion against itself: not quite zero


def test_fixed_base_by_hand(rng):
    scene = load_scene("cartpole")
    ground_truth, learned = (10.0 * path for path in random_paths(scene, rng))
    errors = position_errors(scene, ground_truth, learned)
    difference = (ground_truth - learned).numpy()
    np.testing.assert_allclose(errors["slider"], np.abs(difference[..., 0]))
    np.testing.assert_allclose(errors["hinge"], wrapped(difference[..., 1]), atol=1e-12)
    assert list(errors) == ["slider", "hinge"]


def test_ball_joint_by_hand(rng):
    scene = HANDMADE["arm"]
    ground_truth, learned = random_paths(scene, rng)
    errors = position_errors(scene, ground_truth, learned)
    a, b = ground_truth.numpy(), learned.numpy()
    expected = angle_between(a[..., :4], b[..., :4])
    np.testing.assert_allclose(errors["shoulder"], expected, atol=1e-7)
    np.testing.assert_allclose(errors["elbow"], np.abs(a[..., 4] - b[..., 4]))


def test_floating_base_by_hand(rng):
    scene = HANDMADE["floater"]
    ground_truth, learned = random_paths(scene, rng)
    errors = position_errors(scene, ground_truth, learned)
    a, b = ground_truth.numpy(), learned.numpy()
    offset = np.linalg.norm(a[..., :3] - b[..., :3], axis=-1)
    np.testing.assert_allclose(errors["base_position"], offset)
    turn = angle_between(a[..., 3:7], b[..., 3:7])
    np.testing.assert_allclose(errors["base_orientation"], turn, atol=1e-7)
    knee = np.abs(a[..., 7] - b[..., 7])  # it has limits
    hip = angle_between(a[..., 8:12], b[..., 8:12])
    rod = np.abs(a[..., 12] - b[..., 12])
    np.testing.assert_allclose(errors["joints"], (knee + hip) / 2, atol=1e-7)
    np.testing.assert_allclose(errors["slides"], rod, atol=1e-7)
    assert set(errors) == {"base_position", "base_orientation", "joints", "slides"}


def test_full_turns_and_quaternion_signs_are_no_error(rng, generator):
    cartpole, scene = load_scene("cartpole"), HANDMADE["floater"]
    path, _ = random_paths(cartpole, rng)
    turned = path.clone()
    turned[..., 1] += 2.0 * torch.pi * torch.randint(-3, 4, (ROWS, STEPS)).double()
    assert position_errors(cartpole, path, turned)["hinge"].max() < 1e-6
    ground_truth, _ = random_paths(scene, rng)
    other = ground_truth.clone()
    other[..., 3:7] *= -1.0
    other[..., 8:12] *= torch.where(torch.rand(ROWS, STEPS, 1) < 0.5, -1.0, 1.0)
    for error in position_errors(scene, ground_truth, other).values():
        assert error.abs().max() < 1e-6
    quats = random_quats(ROWS * STEPS, generator).reshape(ROWS, STEPS, 4)
    other[..., 3:7] = quats
    there, back = (
        position_errors(scene, *paths)["base_orientation"]
        for paths in ((ground_truth, other), (other, ground_truth))
    )
    torch.testing.assert_close(there, back)
    assert (there <= torch.pi + 1e-9).all() and there.max() > 0.1


def test_turns_of_a_limited_hinge_are_an_error(rng):
    scene = HANDMADE["floater"]
    path, _ = random_paths(scene, rng)
    turned = path.clone()
    turned[..., 7] += 2.0 * torch.pi
    errors = position_errors(scene, path, turned)["joints"]  # of the knee and the hip
    torch.testing.assert_close(errors, torch.full_like(errors, torch.pi))


def test_a_slide_is_never_wrapped(rng):
    scene = load_scene("cartpole")
    ground_truth, _ = random_paths(scene, rng)
    errors = position_errors(scene, ground_truth, ground_truth + 2.0 * torch.pi)
    assert (errors["slider"] - 2.0 * torch.pi).abs().max() < 1e-9
    assert errors["hinge"].max() < 1e-9


def test_units():
    cartpole, floater = load_scene("cartpole"), HANDMADE["floater"]
    assert unit_of(cartpole, "slider") == "m" and unit_of(cartpole, "hinge") == "rad"
    assert unit_of(HANDMADE["arm"], "shoulder") == "rad"
    assert unit_of(HANDMADE["arm"], "elbow") == "rad"
    assert unit_of(floater, "base_position") == unit_of(floater, "slides") == "m"
    assert unit_of(floater, "base_orientation") == unit_of(floater, "joints") == "rad"


def test_starts_are_those_of_no_data_set(seed):
    """Of a scene both are drawn by `Scene.sample_initial`."""
    scene = load_scene("ant")
    start = initial_states(scene, 3, seed)["qpos"]
    for chunk in (0, seed, seed + 1):
        assert not torch.equal(
            start, scene.sample_initial(3, fold_in(0, chunk))[0]["qpos"]
        )
        drawn = scene.sample_initial(3, fold_in(seed, chunk))[0]["qpos"]
        assert not torch.equal(start, drawn)


def test_summaries_by_hand(rng):
    scene, rows = load_scene("cartpole"), int(rng.integers(2, 90))
    error = rng.exponential(size=(rows, 7))
    summary = summarize(scene, {"slider": torch.from_numpy(error)})["slider"]
    per_trajectory = error.mean(1)
    assert summary.unit == "m"
    assert summary.mean == pytest.approx(error.mean())
    half = stats.t.ppf(0.975, rows - 1) * np.std(per_trajectory, ddof=1) / np.sqrt(rows)
    assert summary.interval == pytest.approx(half)
    assert summary.final == pytest.approx(error[:, -1].mean())
    assert summary.p95 == pytest.approx(np.quantile(per_trajectory, 0.95))


def test_non_finite_errors_stay_visible(rng):
    error = rng.exponential(size=(20, 7))
    error[int(rng.integers(20)), int(rng.integers(7))] = np.nan
    scene = load_scene("cartpole")
    summary = summarize(scene, {"hinge": torch.from_numpy(error)})["hinge"]
    assert np.isnan(summary.mean) and np.isnan(summary.p95)


def test_horizons_are_prefixes_of_one_rollout(task_id, seed):
    task = make_task(task_id)
    ground_truth, other = (
        MujocoDynamics(task.scene),
        MujocoDynamics(heavier(task.scene)),
    )
    together = passive_errors(task, other, ground_truth, [2, 9, 5], ROWS, seed)
    is_moving = task.scene.name != "franka"  # at rest, without gravity
    for horizon, by_name in together.items():
        alone = passive_errors(task, other, ground_truth, [horizon], ROWS, seed)
        assert alone == {horizon: by_name}
        assert any(error.mean > 0.0 for error in by_name.values()) == is_moving
    again = passive_errors(task, other, ground_truth, [2, 9, 5], ROWS, seed)
    assert again == together
    unlike = passive_errors(task, other, ground_truth, [2, 9, 5], ROWS, seed + 1)
    assert (unlike != together) == is_moving


@each(TASKS)
def test_starts_are_the_tasks_and_of_their_seed(name, seed):
    task = make_task(name)
    torch.manual_seed(1)
    first = initial_states(task, 50, seed)
    expected = torch.rand(1)
    torch.manual_seed(1)
    assert torch.equal(torch.rand(1), expected), "global random numbers were used"
    second, third = initial_states(task, 50, seed), initial_states(task, 50, seed + 1)
    assert first.batch_size == (50,)
    for key in first.keys():
        assert torch.equal(first[key], second[key])
    assert (first["qpos"] != third["qpos"]).any(-1).all()
    generator = torch.Generator().manual_seed(seed)
    u = torch.rand(50, task.num_uniforms, dtype=torch.float64, generator=generator)
    assert torch.equal(first["qpos"], task.initial_state(u)["qpos"])


def test_random_actions_are_not_the_numbers_of_the_starts(seed):
    task, count = make_task("cartpole/swingup"), 1000
    drawn = initial_states(task, count, seed)["qpos"][:, 0]
    drive = action_drive(task, count, 1, seed, random_actions=True)
    torque = drive(0, initial_states(task, count, seed))[0][:, 0]
    assert abs(torch.corrcoef(torch.stack((drawn, torque)))[0, 1]) < 0.15


@each(HANDMADE)
def test_open_loop_is_step_after_step(name, rng):
    scene = make_scene(HANDMADE[name].model)
    qpos, qvel = random_states(scene.model, ROWS, rng)
    start = TensorDict({"qpos": qpos, "qvel": qvel}, batch_size=[ROWS])
    torque = torch.from_numpy(rng.normal(size=(ROWS, STEPS, scene.model.nu)))
    before = start.clone()
    path = open_loop(MujocoDynamics(scene), start, STEPS, torque)
    assert all(torch.equal(start[key], before[key]) for key in before.keys())
    dynamics, state = MujocoDynamics(scene), start
    dynamics.reset(state)
    for step in range(STEPS):
        state = dynamics.step(state, torque[:, step])
        assert torch.equal(path[:, step], state["qpos"])
    passive = open_loop(MujocoDynamics(scene), start, STEPS)
    idle = open_loop(MujocoDynamics(scene), start, STEPS, torch.zeros_like(torque))
    assert torch.equal(passive, idle) and not torch.equal(passive, path)


@pytest.mark.parametrize("random_actions", [False, True])
@pytest.mark.parametrize("name", ["cartpole/swingup", "anymal/forward"])
def test_actions_become_torque_through_the_tasks_controller(name, random_actions, seed):
    task, steps = make_task(name), 4
    start = initial_states(task, 3, seed)
    drive = action_drive(task, 3, steps, seed, random_actions)
    ground_truth = MujocoDynamics(task.scene, num_threads=1)
    path = open_loop(ground_truth, start, steps, drive)
    again = action_drive(task, 3, steps, seed, random_actions)
    state = start
    ground_truth.reset(state)
    for step in range(steps):
        torque, ctrl = again(step, state)
        assert ctrl is None
        idle = task.controller(
            torch.zeros(3, 12)[:, : torque.shape[1]], **state_of(state)
        )
        assert torch.equal(torque, idle) != random_actions
        low, high = (
            task.controller(sign * torch.ones_like(idle), **state_of(state))
            for sign in (-1.0, 1.0)
        )
        assert ((torque >= low) & (torque <= high)).all()
        state = ground_truth.step(state.select("qpos", "qvel"), torque)
        torch.testing.assert_close(path[:, step], state["qpos"], rtol=0, atol=1e-12)


def state_of(state):
    return {key: state[key] for key in ("qpos", "qvel")}


@pytest.mark.parametrize("base", ["", "<freejoint/>"])
def test_joints_without_a_name_count_one_by_one(base, rng):
    """A fixed base has an error for each; a floating one the mean of those of a unit."""
    body = '<body pos="0 0 1"><geom size="0.1"/>{joint}{inside}</body>'
    slide, hinge = ('<joint type="slide"/>', '<joint axis="0 1 0"/>')
    leg = body.format(joint=hinge, inside=body.format(joint=slide, inside=""))
    inside = leg + (leg if base else "")
    xml = body.format(joint=base or hinge, inside=inside)
    scene = make_scene(f"<mujoco><worldbody>{xml}</worldbody></mujoco>")
    paths = list(random_paths(scene, rng))
    found = summarize(scene, position_errors(scene, *paths))
    units = {name: error.unit for name, error in found.items()}
    if not base:
        assert units == {"joint 0": "rad", "joint 1": "rad", "joint 2": "m"}
        return
    assert list(units) == ["base_position", "base_orientation", "joints", "slides"]
    assert [*units.values()] == ["m", "rad", "rad", "m"]
    apart = (paths[0] - paths[1]).abs().numpy()[..., 7:]  # hinge, slide, hinge, slide
    hinges = wrapped(apart[..., ::2])
    assert found["joints"].mean == pytest.approx(hinges.mean())
    assert found["slides"].mean == pytest.approx(apart[..., 1::2].mean())


VARIED = make_task("cartpole/swingup").vary(
    {"motor": (0.6, 1.4), "mass:pole": (0.3, 3.0)}
)


def test_a_rollout_goes_on_where_its_history_ends(seed):
    """In the ground truth it is the rest of one long motion; nothing else moves so."""
    history, exact = 4, MujocoDynamics(VARIED.scene)
    start = initial_states(VARIED, ROWS, seed)
    drive = action_drive(VARIED, ROWS, history + STEPS, seed, random_actions=True)
    whole = open_loop(exact, start, history + STEPS, drive)
    end, seen, later = motion_before(exact, start, history, drive)
    assert seen is not None and seen.batch_size == (ROWS, history)
    torch.testing.assert_close(seen[:, 1:]["qpos"], whole[:, : history - 1])
    rest = open_loop(exact, end, STEPS, later, history=seen)
    torch.testing.assert_close(rest, whole[:, history:], rtol=0.0, atol=1e-9)
    same = motion_before(exact, start, 0, drive)
    assert same[0] is start and same[1] is None and same[2] is drive


def test_a_model_that_adapts_is_measured_after_a_history(seed):
    dynamics = from_pretrained("cartpole-adaptive", VARIED.scene)
    both = NeRDDynamics(dynamics), MujocoDynamics(VARIED.scene)
    how = {"random_actions": True, "seed": seed}
    blind, adapted = (
        passive_errors(VARIED, *both, [20], 64, **how, history=n)[20]["hinge"].mean
        for n in (0, 30)
    )
    assert adapted < 0.6 * blind
