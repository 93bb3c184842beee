"""Dyna: few transitions of MuJoCo, many short learned branches that start from them.

    python examples/dyna.py                # 3 learned transitions to 1 of MuJoCo
    python examples/dyna.py --branch 0     # the same without the learned ones

Sutton's Dyna with the branches of Janner et al., "When to trust your model"
(arxiv.org/abs/1906.08253): every round replays states of MuJoCo, sets them in NeRD
(``env.reset(states, set_state=True)``), lets the policy act there for a few steps, and
updates it on both. The learner is that of `sac.py`. Returns in MuJoCo after 4,096 of
its transitions, two seeds, four minutes each on a busy core: 211 and 206 with branches,
47 and 2 without.
"""

from dataclasses import dataclass

import torch
import tyro
from sac import Agent, transitions
from tensordict import TensorDictBase
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from tqdm import tqdm

from torchrl_nerd import make_env
from torchrl_nerd.envs.base import SceneEnv
from torchrl_nerd.evaluation.policy_transfer import transfer, transfer_table


@dataclass(frozen=True)
class Config:
    """The defaults are for minutes on one core."""

    task: str = "cartpole/swingup"  # what to learn
    dynamics: str = "nerd"  # of the branches: nerd or a checkpoint folder
    frames: int = 4096  # transitions of MuJoCo
    num_envs: int = 8  # of MuJoCo
    horizon: int = 8  # transitions of every env of MuJoCo in a round
    branch: int = 5  # learned steps from every replayed state; 0 for none
    starts: int = 128  # replayed states a round
    kept: int = 50  # rounds of learned transitions in the buffer
    learned_fraction: float = 0.75  # of a batch
    updates: int = 72  # gradient steps a round
    batch_size: int = 256  # transitions of a gradient step, MuJoCo's and learned
    episodes: int = 256  # of the evaluation
    seed: int = 0


def branches(
    env: SceneEnv, agent: Agent, states: TensorDictBase, steps: int
) -> TensorDictBase:
    """What the policy does in ``env`` from given states, ``[num_envs, steps]``.

    An env that ends on the way begins anew at a start of the task's own.
    """
    start = env.reset(states.select(*env.state.keys()), set_state=True)
    with torch.no_grad():
        return env.rollout(
            steps,
            agent.actor,
            auto_reset=False,
            tensordict=start,
            break_when_any_done=False,
        )


def make_buffer(size: int, batch_size: int) -> TensorDictReplayBuffer:
    storage = LazyTensorStorage(size)
    return TensorDictReplayBuffer(storage=storage, batch_size=batch_size)


def train(cfg: Config) -> tuple[Agent, TensorDictReplayBuffer, TensorDictReplayBuffer]:
    """An agent, the transitions of MuJoCo and the learned ones."""
    env = make_env(cfg.task, "mujoco", cfg.num_envs, seed=cfg.seed)
    model = make_env(cfg.task, cfg.dynamics, cfg.starts, seed=cfg.seed + 1)
    agent, frames = Agent(env), cfg.num_envs * cfg.horizon
    fraction = cfg.learned_fraction if cfg.branch else 0.0
    num_learned = round(fraction * cfg.batch_size)
    ground_truth = make_buffer(cfg.frames, cfg.batch_size - num_learned)
    learned = make_buffer(cfg.kept * cfg.starts * max(cfg.branch, 1), num_learned)
    collector = Collector(
        env,
        agent.actor,
        frames_per_batch=frames,
        total_frames=cfg.frames,
        track_traj_ids=False,
        auto_register_policy_transforms=False,
    )
    for batch in tqdm(collector, total=-(-cfg.frames // frames), unit="round"):
        ground_truth.extend(transitions(batch, is_mujoco=True))
        if num_learned:
            states = ground_truth.sample(cfg.starts)
            ahead = branches(model, agent, states, cfg.branch)
            learned.extend(transitions(ahead, is_mujoco=False))
        for _ in range(cfg.updates):
            mix = [ground_truth.sample()] + ([learned.sample()] if num_learned else [])
            agent.update(torch.cat(mix))  # pyright: ignore[reportArgumentType]
    return agent, ground_truth, learned


def main(cfg: Config) -> None:
    """Learn from the mix, measure in both dynamics."""
    torch.manual_seed(cfg.seed)
    agent, ground_truth, learned = train(cfg)
    total = f"{len(ground_truth)} transitions of MuJoCo"
    print(f"{total}; the last {len(learned)} learned ones")
    about = cfg.task, agent.actor, (cfg.dynamics,)
    returns = transfer(*about, cfg.episodes, seed=cfg.seed + 2)
    print(transfer_table(returns))


if __name__ == "__main__":
    main(tyro.cli(Config))
