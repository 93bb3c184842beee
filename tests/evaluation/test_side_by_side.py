"""Both rollouts start alike; in closed loop each is driven by its own observation.

Videos keep their frames; captions name the dynamics and their kind.
"""

from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
import torch

from torchrl_nerd.envs.rendering import find_gl
from torchrl_nerd.evaluation.policy import Policy, make_actor
from torchrl_nerd.evaluation.side_by_side import SideBySide, write_video
from torchrl_nerd.robots import make_task

STEPS = 6
BOTH = ("nerd", "mujoco")
CARTPOLE = "cartpole/swingup"
WIDTH = 160
has_gl = pytest.mark.skipif(
    find_gl() is None, reason="no OpenGL library works on this machine"
)


def paths_of(pair: SideBySide, steps: int = STEPS) -> list[torch.Tensor]:
    """``qpos (steps + 1, nq)`` of both, the start first."""
    paths = [[env.state["qpos"][0]] for env in pair.envs]
    while pair.steps < steps and not pair.ending:
        pair.step()
        for path, env in zip(paths, pair.envs, strict=True):
            path.append(env.state["qpos"][0])
    return [torch.stack(path) for path in paths]


@pytest.mark.parametrize("frame_stack", [1, 3])
@pytest.mark.parametrize("task_id", ["ant/run", "cube_slope/toss", "franka/reach"])
def test_equal_dynamics_give_equal_rollouts(task_id, frame_stack, seed):
    task = make_task(task_id)
    sizes = (frame_stack * task.observation_size, 8, task.controller.num_actions)
    policy = Policy(sizes, frame_stack=frame_stack)
    torch.nn.init.normal_(policy.mlp[-1].weight)
    actor = make_actor(policy.eval())
    pair = SideBySide(task_id, ("mujoco", "mujoco"), actor, seed)
    first, second = paths_of(pair)
    assert torch.equal(first, second) and pair.returns[0] == pair.returns[1]
    assert len(first) == STEPS + 1 and not torch.equal(first[0], first[-1])
    assert pair.seconds == pytest.approx(STEPS * task.step_size)


@pytest.mark.parametrize("closed_loop", [True, False])
def test_in_closed_loop_the_policy_acts_on_what_it_sees(closed_loop, seed):
    seen: list[torch.Tensor] = []

    def actor(shown):
        seen.append(shown["qpos"][0].clone())
        return shown.set("action", torch.full((1, 1), 0.3 if len(seen) % 2 else -0.3))

    pair = SideBySide(CARTPOLE, BOTH, actor, seed, closed_loop)
    learned, ground_truth = paths_of(pair)
    assert pair.kinds == ["learned", "ground truth"]
    assert torch.equal(learned[0], ground_truth[0]) and not torch.equal(
        learned[2], ground_truth[2]
    )
    assert torch.equal(torch.stack(seen[0::2]), learned[:-1])
    assert torch.equal(torch.stack(seen[1::2]), ground_truth[:-1])
    # the policy pushes the two carts to opposite sides; in open loop to the same
    assert (abs(learned[-1] - ground_truth[-1]).max() > 1e-3) == closed_loop


def test_random_actions_are_those_of_their_seed_and_the_same_in_both(seed):
    def path(actor, seed):
        both = paths_of(SideBySide("ant/run", ("mujoco", "mujoco"), actor, seed))
        assert torch.equal(*both)
        return both[0]

    first, same, other = (path("random", s) for s in (seed, seed, seed + 1))
    assert torch.equal(first, same) and not torch.equal(first, other)
    assert torch.equal(path("zero", seed)[0], first[0])
    assert not torch.equal(path("zero", seed), first)


def test_the_rollouts_end_with_the_first_episode(seed):
    """Full force to one side takes the cart off its rail."""
    pair = SideBySide(
        CARTPOLE, BOTH, lambda td: td.set("action", torch.ones(1, 1)), seed
    )
    learned, ground_truth = paths_of(pair, 300)
    assert pair.ending in ("nerd terminated", "mujoco terminated")
    assert len(learned) == len(ground_truth) == pair.steps + 1 < 301
    state = {"qpos": ground_truth[-2], "qvel": torch.zeros(2, dtype=torch.float64)}
    assert not make_task(CARTPOLE).terminated(state)


@has_gl
def test_an_image_shows_both_robots_under_their_captions(seed):
    def push(shown):
        return shown.set("action", torch.full((1, 1), float(shown["qpos"].sum() < 9.0)))

    pair = SideBySide(CARTPOLE, BOTH, push, seed)
    pair.envs[1].reset(pair.envs[0].state, set_state=True)
    first = pair.image(WIDTH).astype(int)
    head = len(first) - WIDTH // 2 * 2 // 5 * 2  # height of the captions
    pair.envs[0].step(pair.envs[0].rand_action().set("action", torch.ones(1, 1)))
    for _ in range(9):  # on the left alone
        pair.envs[0].step(pair.envs[0].rand_action().set("action", torch.ones(1, 1)))
    changes = abs(pair.image(WIDTH).astype(int) - first).max(-1) > 30
    assert first.shape[1] == WIDTH
    assert changes[head:, : WIDTH // 2].any() and not changes[:, WIDTH // 2 :].any()
    pair.kinds[0] = "hybrid"
    changes = abs(pair.image(WIDTH).astype(int) - first).max(-1) > 30
    assert changes[:head, : WIDTH // 2].any() and not changes[:, WIDTH // 2 :].any()


@has_gl
@pytest.mark.parametrize("suffix", [".gif", ".mp4"])
def test_a_video_has_its_frames_and_speed(suffix, tmp_path, seed):
    path: Path = tmp_path / f"a{suffix}"
    steps = round(0.2 / make_task(CARTPOLE).step_size)
    for slowdown, count in ((2.0, 11), (1.0, 6)):
        pair = SideBySide(CARTPOLE, BOTH, "random", seed)
        assert write_video(pair, path, steps, WIDTH, slowdown, quiet=True) == count
    frames = iio.imread(path, index=None if suffix == ".gif" else ...)
    assert len(frames) == 6 and frames.shape[2] == WIDTH
    again = SideBySide(CARTPOLE, BOTH, "random", seed)
    first = again.image(WIDTH)
    paths_of(again, steps)
    last = again.image(WIDTH)

    def differ(a: np.ndarray, b: np.ndarray) -> float:
        return (abs(a.astype(int) - b).max(-1) > 60).mean()

    assert differ(frames[0], first) < 0.5 * differ(frames[0], last)
    assert differ(frames[-1], last) < 0.5 * differ(frames[-1], first)
    assert [x.name for x in tmp_path.iterdir()] == [path.name]
    if suffix == ".gif":
        assert iio.immeta(path)["duration"] == 40
