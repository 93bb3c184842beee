"""A model that corrects a simulator is that simulator until it has learned something."""

import torch

from torchrl_nerd.checkpoint import load_checkpoint, make_card, save_checkpoint
from torchrl_nerd.dynamics import NeRDDynamics
from torchrl_nerd.evaluation.rollout_error import open_loop
from torchrl_nerd.evaluation.toss_error import first_state
from torchrl_nerd.training.toss_models import from_scratch


def starts(tosses, generator, rows=16):
    found = tosses.starts(10)
    pick = torch.randint(len(found), (rows,), generator=generator)
    return first_state(tosses.windows(found[pick], 10))


def scramble(model, generator):
    """Random numbers for all weights."""
    with torch.no_grad():
        for weight in model.network.parameters():
            weight += 0.05 * torch.randn(weight.shape, generator=generator)
        model.simulator.raw += 0.1


def test_a_fresh_one_moves_as_its_simulator_does(real_cube, tosses, generator):
    model = from_scratch(real_cube, tosses, "residual", seed=0)
    start = starts(tosses, generator)
    path = open_loop(NeRDDynamics(model), start, 5)
    qpos, qvel = start["qpos"], start["qvel"]
    for step in range(5):
        qpos, qvel, _ = model.simulator(qpos, qvel)
        assert (path[:, step] - qpos).abs().max() < 1e-5  # float32 in between


def test_it_comes_back_from_disk(real_cube, tosses, generator, tmp_path):
    model = from_scratch(real_cube, tosses, "residual", seed=1)
    scramble(model, generator)
    save_checkpoint(model, tmp_path, make_card(model))
    loaded = load_checkpoint(str(tmp_path))
    start = starts(tosses, generator)
    paths = [open_loop(NeRDDynamics(m), start, 5) for m in (model, loaded)]
    assert torch.equal(*paths)
    assert loaded.simulator.values() == model.simulator.values()


def test_rows_do_not_see_each_other(real_cube, tosses, generator):
    model = from_scratch(real_cube, tosses, "residual", seed=2)
    scramble(model, generator)
    start = starts(tosses, generator)
    together = open_loop(NeRDDynamics(model), start, 5)
    alone = open_loop(NeRDDynamics(model), start[3:4], 5)
    torch.testing.assert_close(alone[0], together[3], atol=1e-6, rtol=0)


def test_the_network_is_cast_and_the_simulator_is_not(real_cube, tosses):
    model = from_scratch(real_cube, tosses, "residual", seed=3).half()
    assert model.dtype == torch.float16
    assert model.simulator.raw.dtype == torch.float64
