"""Formulas of suite tasks: the suite's own code is the only reference."""

import numpy as np
import pytest
import torch
from dm_control import suite
from helpers import slow_but

from torchrl_nerd import load_scene
from torchrl_nerd.geometry.manifold import normalize_pos
from torchrl_nerd.tasks.body_motion import BodyMotion, tolerance
from torchrl_nerd.tasks.suite import SuiteTask
from torchrl_nerd.tasks.suite_formulas import FORMULAS

TASKS = [f"{domain}-{task}" for domain, task in suite.ALL_TASKS if domain in FORMULAS]
STATES = 64
COMPILED = "walker-run", "hopper-hop", "reacher-hard"


def test_every_domain_with_formulas_is_in_the_suite():
    assert FORMULAS.keys() <= {domain for domain, _ in suite.ALL_TASKS}


@pytest.mark.parametrize("name", TASKS)
def test_formulas_equal_the_suite(name, generator):
    """Every other state near the pose that earns something, the others as they start."""
    domain, _, task_name = name.partition("-")
    task = SuiteTask(f"dm_control/{name}")
    model, formula = task.scene.model, FORMULAS[domain](task.scene, task_name)
    u = torch.rand(STATES, 1, dtype=torch.float64, generator=generator)
    state = task.initial_state(u)

    def normal(size: int) -> torch.Tensor:
        return torch.randn(STATES, size, dtype=torch.float64, generator=generator)

    near = torch.from_numpy(model.qpos0) + 0.05 * normal(model.nq)
    state["qpos"][::2] = near[::2]
    state["qpos"] = normalize_pos(task.scene.layout, state["qpos"])
    state["qvel"] = 2.0 * u * normal(model.nv)
    if task.parameters:  # some targets are nearly reached
        gap = formula._gap(state["qpos"], state["qvel"], state["target"])
        state["target"][::2, :2] -= 0.95 * gap[::2]
    if len(task._forces):
        state["sensordata"] = normal(model.nsensordata).abs()
    extra, ctrl = task._extra(state), 2.0 * normal(model.nu)
    judge = task._judge.function
    known = state["qpos"], state["qvel"]
    after = (ctrl, extra) if len(task._forces) else (extra, ctrl)
    rows = torch.cat((*known, *after), -1).numpy()
    theirs = np.stack([judge(row) for row in rows])
    mine = formula.reward(*known, ctrl, extra).numpy()
    assert np.abs(mine - theirs[:, 0]).max() < 1e-9
    seen = formula.observation(*known, extra).numpy()
    assert seen.shape == theirs[:, 2:].shape
    assert np.abs(seen - theirs[:, 2:]).max() < 1e-8 * (1.0 + np.abs(theirs).max())
    assert not theirs[:, 1].any(), "the suite ends episodes early"
    if name != "acrobot-swingup_sparse":  # two arms, upright at once
        assert len(np.unique(mine.round(6))) > 1, "no state told rewards apart"


@pytest.mark.parametrize("shape", ["gaussian", "linear", "quadratic"])
@pytest.mark.parametrize(("margin", "at_margin"), [(0.0, 0.1), (0.7, 0.3)])
def test_tolerance_equals_the_suites(shape, margin, at_margin, generator):
    from dm_control.utils import rewards

    x = 2.0 * torch.randn(500, dtype=torch.float64, generator=generator)
    x[:3] = torch.tensor([-0.2, 0.9, 1.6])
    mine = tolerance(x, -0.2, 0.9, margin, at_margin, shape).numpy()
    theirs = rewards.tolerance(x.numpy(), (-0.2, 0.9), margin, shape, at_margin)
    assert np.abs(mine - theirs).max() < 1e-12


@pytest.mark.parametrize("scene", ["ant", "franka", "dm_control/humanoid-run"])
def test_body_motion_is_mujocos(scene, generator):
    import mujoco

    scene = load_scene(scene)
    model, data = scene.model, mujoco.MjData(scene.model)
    moving = np.flatnonzero(model.body_dofnum[model.body_weldid])
    names = tuple(model.body(body).name for body in moving[[0, len(moving) // 2, -1]])
    state, _ = scene.sample_initial(4, generator)
    found = BodyMotion(scene, names)(state["qpos"], state["qvel"])
    root = int(moving[0])
    for row in range(4):
        data.qpos[:], data.qvel[:] = state["qpos"][row], state["qvel"][row]
        mujoco.mj_forward(model, data)
        mujoco.mj_subtreeVel(model, data)
        ids = [model.body(name).id for name in names]
        pairs = (
            (found.position, data.xpos[ids]),
            (found.rotation, data.xmat[ids].reshape(-1, 3, 3)),
            (found.com, data.subtree_com[root]),
            (found.com_velocity, data.subtree_linvel[root]),
        )
        for mine, theirs in pairs:
            assert np.abs(mine[row].numpy() - theirs).max() < 1e-9


@pytest.mark.parametrize("name", slow_but(["walker-run"], COMPILED))
def test_a_judgement_is_one_graph_and_keeps_its_precision(name, generator):
    task = SuiteTask(f"dm_control/{name}")
    u = torch.rand(3, 1, dtype=torch.float64, generator=generator)
    state = task.initial_state(u)
    felt = torch.zeros(3, task.scene.model.nsensordata)
    state = {key: x.float() for key, x in state.items()} | {"sensordata": felt}
    action = torch.zeros(3, task.controller.num_actions)

    def judge(state, action):
        return task.observation(state), task.reward(state, action, state)

    expected = judge(state, action)
    found = torch.compile(judge, fullgraph=True, backend="eager")(state, action)
    for mine, other in zip(found, expected, strict=True):
        assert mine.dtype == torch.float32
        assert torch.equal(mine, other)
