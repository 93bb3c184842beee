"""What all dynamics promise, of every kind: envs do not see each other."""

import copy
import pickle

import pytest
import torch
from dynamics_helpers import (
    LEARNED,
    MODELS,
    DynamicsMaker,
    assert_same_motion,
    in_small_steps,
    random_drive,
    random_mask,
    random_model,
    roll,
    unequal_keys,
    warp_too,
)
from tensordict import TensorDict

from torchrl_nerd.dynamics import NeRDDynamics
from torchrl_nerd.modules.nerd import NeRD
from torchrl_nerd.robots import SCENES, load_scene

ROWS, STEPS = 6, 4
PER_ENV = [s for s in map(load_scene, SCENES) if s.terrain and s.terrain.is_per_env]


def rows_of(rows, state, torques, terrain):
    return state[rows], torques[:, rows], None if terrain is None else terrain[rows]


@warp_too
def test_a_row_of_a_batch_moves_as_it_would_alone(scene, dynamics, generator):
    make = DynamicsMaker(scene, dynamics, generator)
    drive = random_drive(scene, ROWS, STEPS, generator)
    together = roll(make(), *drive)
    for row in range(ROWS):
        alone = roll(make(), *rows_of(slice(row, row + 1), *drive))
        tolerance = 1e-6 if dynamics in MODELS else 0.0
        assert_same_motion(alone[0], together[row], tolerance)


@warp_too
def test_a_partial_reset_forgets_its_rows_and_no_others(scene, dynamics, generator):
    make = DynamicsMaker(scene, dynamics, generator)
    start, torques, terrain = random_drive(scene, ROWS, 2 * STEPS, generator)
    reset, untouched = make(), make()
    middle = roll(reset, start, torques[:STEPS], terrain)[:, -1]
    roll(untouched, start, torques[:STEPS], terrain)
    rows = random_mask(ROWS, generator)
    other = random_drive(scene, ROWS, 1, generator)[0]
    state = torch.where(rows, other, middle)
    reset.reset(state, rows)
    after = roll(reset, state, torques[STEPS:], terrain)
    undisturbed = roll(untouched, middle, torques[STEPS:], terrain)
    assert not unequal_keys(after[~rows], undisturbed[~rows])
    fresh = roll(make(), state, torques[STEPS:], terrain)
    # another place in the ring of keys and values sums in another order
    tolerance = 1e-6 if dynamics == "streaming" else 0.0
    assert_same_motion(after[rows], fresh[rows], tolerance)


@warp_too
@pytest.mark.parametrize("junk", [float("nan"), float("inf"), 1e200])
def test_a_broken_row_breaks_no_other(scene, dynamics, junk, generator):
    make = DynamicsMaker(scene, dynamics, generator)
    start, torques, terrain = random_drive(scene, ROWS, STEPS, generator)
    row = int(torch.randint(ROWS, (), generator=generator))
    key = ("qpos", "qvel")[int(torch.randint(2, (), generator=generator))]
    broken = start.clone()
    broken[key][row] = junk
    others = torch.arange(ROWS) != row
    polluted, clean = make(), make()
    after = roll(polluted, broken, torques, terrain)
    undisturbed = roll(clean, start, torques, terrain)
    assert not unequal_keys(after[others], undisturbed[others])
    if junk != 1e200:
        state = torch.cat((after["qpos"], after["qvel"]), -1)
        assert not state[row].isfinite().all(-1).any()
    polluted.reset(start, ~others)
    state = torch.where(others, after[:, -1], start)
    healed = roll(polluted, state, torques, terrain)
    assert healed["qpos"].isfinite().all() and healed["qvel"].isfinite().all()


@warp_too
def test_a_step_keeps_its_inputs_and_shares_no_memory(scene, dynamics, generator):
    make = DynamicsMaker(scene, dynamics, generator)
    start, torques, terrain = random_drive(scene, ROWS, STEPS, generator)
    expected = roll(make(), start, torques, terrain)
    moving, state, states = make(), start, []
    for torque in torques:
        inputs = [state.clone(), torque.clone()]
        inputs += [] if terrain is None else [terrain.clone()]
        moved = moving.step(*inputs)
        assert not unequal_keys(inputs[0], state) and torch.equal(inputs[1], torque)
        state = moved.clone()
        states.append(state)
        for value in (*inputs[0].values(), *inputs[1:], *moved.values()):
            value.fill_(torch.nan)
    assert not unequal_keys(torch.stack(states, 1), expected)


@warp_too
@pytest.mark.parametrize(
    "duplicate", [copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))]
)
def test_a_copy_moves_like_the_original_and_apart_from_it(
    scene, dynamics, duplicate, generator
):
    make = DynamicsMaker(scene, dynamics, generator)
    drive = random_drive(scene, ROWS, STEPS, generator)
    original = make()
    original.reset(drive[0])
    twin = duplicate(original)
    expected = roll(original, *drive)
    assert not unequal_keys(roll(twin, *drive), expected)


@warp_too
def test_a_history_is_restored_as_often_as_asked(scene, dynamics, generator):
    make = DynamicsMaker(scene, dynamics, generator)
    start, torques, terrain = random_drive(scene, ROWS, STEPS, generator)
    moving, every = make(), torch.ones(ROWS, dtype=torch.bool)
    state = roll(moving, start, torques, terrain)[:, -1]
    past, paths = moving.history(), []
    for _ in range(3):
        now, path = state, []
        for torque in torques:
            now = moving.step(now, torque, terrain)
            path.append(now)
        paths.append(torch.stack(path, 1))
        moving.restore(past, every)
    tolerance = 1e-6 if dynamics == "streaming" else 0.0  # of another place in the ring
    for path in paths[1:]:
        assert_same_motion(path, paths[0], tolerance)


@warp_too
@pytest.mark.parametrize("is_reset", [True, False], ids=["reset", "no reset"])
def test_another_number_of_rows_starts_anew(scene, dynamics, is_reset, generator):
    make = DynamicsMaker(scene, dynamics, generator)
    drive = random_drive(scene, ROWS, STEPS, generator)
    used = make()
    roll(used, *drive)
    for rows in (slice(0, 1), slice(1, ROWS - 1), slice(0, ROWS)):
        fewer = rows_of(rows, *drive)
        if is_reset:
            used.reset(fewer[0])
        assert not unequal_keys(roll(used, *fewer), roll(make(), *fewer))


@warp_too
def test_wrong_shapes_are_refused_in_one_sentence(scene, dynamics, generator):
    moving = DynamicsMaker(scene, dynamics, generator)()
    start, torques, terrain = random_drive(scene, ROWS, 1, generator)
    torque, nq = torques[0], scene.model.nq

    def message(state=start, torque=torque, terrain=terrain) -> str:
        with pytest.raises(ValueError) as caught:
            moving.step(state, torque, terrain)
        return str(caught.value)

    wide = start.clone().set("qpos", torch.zeros(ROWS, nq + 1, dtype=torch.float64))
    said = message(state=wide)
    assert "qpos" in said and str((ROWS, nq)) in said and str((ROWS, nq + 1)) in said
    said = message(torque=torque[:-1])
    assert "joint_torque" in said and str(tuple(torque.shape)) in said
    assert "joint_torque" in message(torque=torque[:, None])
    if terrain is not None:
        assert "terrain" in message(terrain=None)
        assert "terrain" in message(terrain=terrain[:, :-1])
        assert "terrain" in message(terrain=terrain[0])


@warp_too
def test_torque_matters(scene, dynamics, generator):
    make = DynamicsMaker(scene, dynamics, generator)
    if isinstance(make.model, NeRD):
        in_small_steps(make.model)
    start, torques, terrain = random_drive(scene, ROWS, 1, generator)
    pushed = roll(make(), start, torques, terrain)["qvel"]
    passive = roll(make(), start, 0.0 * torques, terrain)["qvel"]
    assert (pushed != passive).any(-1).all() == bool(scene.actuated)


@warp_too
@pytest.mark.parametrize("scene", PER_ENV, ids=lambda scene: scene.name)
def test_terrain_matters(scene, dynamics, generator):
    make = DynamicsMaker(scene, dynamics, generator)
    if isinstance(make.model, NeRD):
        in_small_steps(make.model)
    start, torques, terrain = random_drive(scene, ROWS, 1, generator)
    touching = terrain.clone()
    touching[:, 3] += 3.0  # m, nearer
    apart = roll(make(), start, torques, terrain)["qvel"]
    touched = roll(make(), start, torques, touching)["qvel"]
    assert (touched != apart).any()


@warp_too
def test_states_are_float64_and_of_the_scene(scene, dynamics, generator):
    moving = DynamicsMaker(scene, dynamics, generator)()
    start, torques, terrain = random_drive(scene, ROWS, 1, generator)
    moved = moving.step(start, torques[0].float(), terrain)
    assert isinstance(moved, TensorDict) and moved.batch_size == (ROWS,)
    for key, size in (("qpos", scene.model.nq), ("qvel", scene.model.nv)):
        assert moved[key].shape == (ROWS, size) and moved[key].dtype == torch.float64


@pytest.mark.parametrize("inference", LEARNED)
def test_a_model_answers_where_it_was_asked(scene, inference, monkeypatch, generator):
    """On meta tensors, which know their device and hold no numbers: zeros come back."""
    real = torch.Tensor.to

    def to(tensor, *args, **kwargs):
        if tensor.is_meta and args[:1] == (torch.device("cpu"),):
            return torch.zeros(tensor.shape, dtype=tensor.dtype)
        return real(tensor, *args, **kwargs)

    monkeypatch.setattr(torch.Tensor, "to", to)
    monkeypatch.setattr(torch, "is_autocast_enabled", lambda device: False)
    dynamics = NeRDDynamics(random_model(scene, generator).to("meta"), inference)
    state, torques, terrain = random_drive(scene, ROWS, STEPS, generator)
    after = state.select("qpos", "qvel")
    dynamics.reset(after)
    for torque in torques:
        dynamics.reset(after, random_mask(ROWS, generator))
        after = dynamics.step(after, torque, terrain, is_scored=True)
        assert set(after.keys()) == {"qpos", "qvel", "ood_score"}
        assert {x.device.type for x in after.values()} == {"cpu"}
    assert dynamics.model.device.type == "meta"
