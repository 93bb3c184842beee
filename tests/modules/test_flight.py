"""Rows that nothing pushes for a whole step move as MuJoCo has them move."""

import pytest
import torch
from dynamics_helpers import random_model, roll
from helpers import random_transitions, true_step
from torch._dynamo.testing import CompileCounterWithBackend

from torchrl_nerd.checkpoint import load_checkpoint, make_card, save_checkpoint
from torchrl_nerd.compiled import Compiled
from torchrl_nerd.dynamics import NeRDDynamics
from torchrl_nerd.keys import JOINT_TORQUE, QPOS, QVEL, TERRAIN
from torchrl_nerd.modules.flight import LEAST_GAP, Flight
from torchrl_nerd.robots import SCENES, load_scene

ROWS = 64


def can_fly(scene):
    try:
        Flight(scene)
    except ValueError:
        return False
    return True


FLYING = [s for s in map(load_scene, SCENES) if can_fly(s)]
each_flying = pytest.mark.parametrize("scene", FLYING, ids=lambda scene: scene.name)


def step(model, rows):
    state = rows.select(QPOS, QVEL)
    return NeRDDynamics(model).step(state, rows[JOINT_TORQUE], rows.get(TERRAIN, None))


def transitions(scene, rows, generator):
    """Some high above the ground and some near it, joints within their limits or not."""
    found = random_transitions(scene, rows, generator)
    if scene.base.is_floating:
        found[QPOS][: rows // 2, scene.base.qpos_address + 2] += 5.0
    return found


def flying(model, rows):
    """Rows that it moves along the free motion: those that the network does not tell."""
    alone = model.over(model.scene)
    alone.flight = None
    own, without = step(model, rows), step(alone, rows)
    return (own[QVEL] != without[QVEL]).any(-1), own, without


def test_the_paper_robots_fly():
    assert {"ant", "anymal", "cube", "double_pendulum"} <= {s.name for s in FLYING}


@each_flying
def test_what_flies_goes_where_mujoco_goes(scene, generator):
    model = random_model(scene, generator, "mlp-4x64").fly()
    rows = transitions(scene, 4 * ROWS, generator)
    flies, found, _ = flying(model, rows)
    assert flies.any()
    here = rows[flies]
    true = true_step(scene, here.exclude("next"), here[JOINT_TORQUE])["next"]
    change = (true[QVEL] - here[QVEL]).norm(dim=-1)
    error = (found[QVEL][flies] - true[QVEL]).norm(dim=-1)
    assert (error / change).median() < 0.02  # wild torques; a network errs by more
    slip = (found[QPOS][flies] - true[QPOS]).norm(dim=-1)
    assert (slip / (scene.control_step * change)).median() < 0.02


@each_flying
def test_it_flies_where_nothing_is_met(scene, generator):
    """Gaps at both ends are MuJoCo's own distances, limits those of the file."""
    model = random_model(scene, generator, "mlp-4x64").fly()
    rows = transitions(scene, 4 * ROWS, generator)
    flies, found, _ = flying(model, rows)
    terrain = rows.get(TERRAIN, None)
    for qpos in (rows[QPOS], found[QPOS]):
        gaps = scene.clearances(qpos, terrain).amin(-1)
        assert (gaps[flies] > LEAST_GAP).all()
        for joint in range(scene.model.njnt):
            if scene.model.jnt_limited[joint]:
                low, high = scene.model.jnt_range[joint]
                angle = qpos[flies, scene.model.jnt_qposadr[joint]]
                assert ((angle >= low) & (angle <= high)).all()


@each_flying
def test_other_rows_are_the_networks_to_the_bit(scene, generator):
    model = random_model(scene, generator, "mlp-4x64").fly()
    rows = transitions(scene, ROWS, generator)
    flies, found, without = flying(model, rows)
    for key in (QPOS, QVEL):
        assert torch.equal(found[key][~flies], without[key][~flies])


@each_flying
def test_a_row_flies_the_same_whoever_flies_beside_it(scene, generator):
    """To the bit: a neighbour that breaks or lands changes nothing."""
    model = random_model(scene, generator, "mlp-4x64").fly()
    rows = transitions(scene, ROWS, generator)
    found = step(model, rows)
    for broken in torch.randperm(ROWS, generator=generator)[:5].tolist():
        others = rows.clone()
        others[QVEL][broken] = torch.nan
        other = step(model, others)
        keep = torch.arange(ROWS) != broken
        for key in (QPOS, QVEL):
            assert torch.equal(found[key][keep], other[key][keep])


@each_flying
def test_all_rows_at_once_are_close_to_some(scene, generator):
    """As a GPU takes them."""
    flight, rows = Flight(scene), transitions(scene, ROWS, generator)
    terrain, before = rows.get(TERRAIN, None), (rows[QPOS], rows[QVEL])
    gap = scene.clearances(rows[QPOS], terrain)
    some = flight(before, rows[JOINT_TORQUE], terrain, gap, before)
    may_fly = (gap > LEAST_GAP).all(-1)
    every = flight.fly_at_once(before, rows[JOINT_TORQUE], terrain, may_fly, before)
    torch.testing.assert_close(some, every, atol=1e-9, rtol=1e-9)
    assert (some[1] != before[1]).any()


@pytest.mark.parametrize(
    ("scene", "backend"),
    [
        (load_scene("ant"), "eager"),
        *(pytest.param(s, "inductor", marks=pytest.mark.slow) for s in FLYING),
    ],
    ids=lambda x: getattr(x, "name", x),
)
def test_one_code_is_compiled_for_any_number_that_flies(
    backend, scene, generator, monkeypatch
):
    """None, a block of rows, all of them: close to eager, and nothing compiled anew."""
    fly, traced = Flight._fly, []

    def noting(*args):
        traced.append(torch.compiler.is_compiling())
        return fly(*args)

    monkeypatch.setattr(Flight, "_fly", noting)
    model = random_model(scene, generator, "mlp-4x64").fly()
    rows = transitions(scene, 8 * ROWS, generator)
    flies = flying(model, rows)[0]
    most = min(ROWS, int(flies.sum()))
    assert most > 0
    counter = CompileCounterWithBackend(backend)
    compiled = NeRDDynamics(model, compile=True)
    compiled._compiled = Compiled(compiled._predict, warmup=0, backend=counter)
    counts = [0, most, 1, most // 2, most - 1]
    pieces = []
    for count in counts:
        parts = rows[flies][:count], rows[~flies][: ROWS - count]
        here = torch.cat(parts)
        given = here.select(QPOS, QVEL), here[JOINT_TORQUE], here.get(TERRAIN, None)
        expected = NeRDDynamics(model).step(*given)
        traced.clear()
        found = compiled.step(*given)
        torch.testing.assert_close(found, expected, atol=1e-5, rtol=1e-5)
        pieces.append(counter.frame_count)
        assert all(traced)
        assert traced or not count
    assert pieces[1:] == [pieces[1]] * (len(counts) - 1)


def test_a_checkpoint_knows_that_it_flies(tmp_path, generator):
    scene = load_scene("ant")
    for flies in (False, True):
        model = random_model(scene, generator, "mlp-4x64")
        model = model.fly() if flies else model
        card = make_card(model)
        loaded = load_checkpoint(save_checkpoint(model, tmp_path / str(flies), card))
        assert (loaded.flight is not None) == flies == card["flies"]
        rows = transitions(scene, ROWS, generator)
        torch.testing.assert_close(step(loaded, rows), step(model, rows))


def test_a_path_through_the_air_is_a_parabola(generator):
    """However little the network has learned."""
    scene = load_scene("cube")
    model = random_model(scene, generator, "mlp-4x64").fly()
    rows = random_transitions(scene, ROWS, generator)
    rows[QPOS][:, 2] += 50.0
    torque = torch.zeros(60, ROWS, 0, dtype=torch.float64)
    path = roll(NeRDDynamics(model), rows.select(QPOS, QVEL), torque, None)
    seconds = scene.control_step * torch.arange(1, 61, dtype=torch.float64)[:, None]
    gravity = torch.as_tensor(scene.model.opt.gravity)
    lag = (
        scene.control_step / scene.substeps
    )  # semi-implicit Euler falls so much longer
    fall = 0.5 * gravity * seconds * (seconds + lag)
    start = rows[QPOS][:, None, :3] + seconds * rows[QVEL][:, None, :3]
    torch.testing.assert_close(path[QPOS][..., :3], start + fall)


@pytest.mark.parametrize("what", ["ground", "gymnasium/Swimmer-v5"])
def test_other_robots_are_refused(what):
    scene = load_scene("franka") if what == "ground" else load_scene(what)
    with pytest.raises(ValueError, match=r"expected a (ground|robot).*got scene"):
        Flight(scene)


@each_flying
def test_no_rows_at_all_have_clearances_and_a_free_step(scene, generator):
    """As an empty share of a batch has them."""
    rows = transitions(scene, ROWS, generator)[:0]
    gaps = scene.clearances(rows[QPOS], rows.get(TERRAIN, None))
    assert gaps.shape == (0, len(scene.contacts))
    after = Flight(scene).free_step(rows[QPOS], rows[QVEL], rows[JOINT_TORQUE])
    assert [len(x) for x in after] == [0] * 4
