"""Learn a task in learned dynamics with skrl, an RL library that knows Gymnasium alone.

    python examples/gymnasium_skrl.py
    python examples/gymnasium_skrl.py --env TorchrlNerd/AntRun-v0 --dynamics mujoco

skrl takes the batched env as it takes any `gymnasium.vector.VectorEnv`: one call of the
dynamics steps all of its envs. The policy is then measured in MuJoCo.
"""

from dataclasses import dataclass
from typing import Any

import gymnasium
import torch
import tyro
from skrl.agents.torch.ppo import PPO
from skrl.envs.wrappers.torch.gymnasium_envs import GymnasiumWrapper
from skrl.memories.torch import RandomMemory
from skrl.resources.preprocessors.torch import RunningStandardScaler
from skrl.trainers.torch import SequentialTrainer
from skrl.utils import set_seed
from skrl.utils.model_instantiators.torch import deterministic_model, gaussian_model

import torchrl_nerd.gymnasium

gymnasium.register_envs(torchrl_nerd.gymnasium)  # only so that linters see a use
MLP = [
    {"name": "net", "input": "OBSERVATIONS", "layers": [64, 64], "activations": "elu"}
]


@dataclass(frozen=True)
class Config:
    """What to learn, where and for how long."""

    env: str = "TorchrlNerd/CartpoleSwingup-v0"  # any id of ours
    dynamics: str = "nerd"  # where it learns: nerd, mujoco, a checkpoint folder
    num_envs: int = 256  # that it learns from together
    rollout: int = 32  # steps of each between two updates
    steps: int = 4800  # of each env
    episode: int = 300  # steps of an episode in the report
    seed: int = 0


def make_env(cfg: Config, dynamics: str, seed: int) -> GymnasiumWrapper:
    """Gymnasium's batched env, as skrl sees it."""
    envs = gymnasium.make_vec(cfg.env, cfg.num_envs, dynamics=dynamics, seed=seed)
    return GymnasiumWrapper(envs)


def make_agent(env: GymnasiumWrapper, cfg: Config) -> PPO:
    """PPO with observations standardised as they come."""
    spaces = {
        "observation_space": env.observation_space,
        "action_space": env.action_space,
        "device": env.device,
    }
    policy = gaussian_model(**spaces, network=MLP, output="tanh(ACTIONS)")
    value = deterministic_model(**spaces, network=MLP, output="ONE")
    settings = {
        "rollouts": cfg.rollout,
        "learning_epochs": 5,
        "mini_batches": 4,
        "learning_rate": 1e-3,
        "time_limit_bootstrap": True,
        "observation_preprocessor": RunningStandardScaler,
        "observation_preprocessor_kwargs": {"size": env.observation_space},
        "value_preprocessor": RunningStandardScaler,
        "value_preprocessor_kwargs": {"size": 1},
        "experiment": {"write_interval": 0, "checkpoint_interval": 0},
    }
    memory = RandomMemory(memory_size=cfg.rollout, num_envs=env.num_envs)
    models: dict[str, Any] = {"policy": policy, "value": value}
    return PPO(models=models, memory=memory, cfg=settings, **spaces)


@torch.no_grad()
def returns(agent: PPO, env: GymnasiumWrapper, steps: int) -> torch.Tensor:
    """Sums of rewards over first episodes, the policy's mean action, ``(num_envs,)``."""
    observations, _ = env.reset()
    total, runs = torch.zeros(env.num_envs, 1), torch.ones(env.num_envs, 1)
    for step in range(steps):
        _, outputs = agent.act(observations, None, timestep=step, timesteps=steps)
        observations, reward, terminated, truncated, _ = env.step(
            outputs["mean_actions"]
        )
        total += runs * reward
        runs *= ~(terminated | truncated)
    return total[:, 0]


def main(cfg: Config) -> dict[str, float]:
    """Learn in one dynamics, measure there and in MuJoCo; mean returns by dynamics."""
    set_seed(cfg.seed)
    env = make_env(cfg, cfg.dynamics, cfg.seed)
    agent = make_agent(env, cfg)
    settings = {"timesteps": cfg.steps, "close_environment_at_exit": False}
    SequentialTrainer(env=env, agents=agent, cfg=settings | {"headless": True}).train()
    agent.enable_training_mode(False)
    found = {}
    for dynamics in dict.fromkeys((cfg.dynamics, "mujoco")):
        sums = returns(agent, make_env(cfg, dynamics, cfg.seed + 2), cfg.episode)
        found[dynamics] = float(sums.mean())
        print(f"{dynamics}: {sums.mean():.1f}, std {sums.std():.1f}")
    return found


if __name__ == "__main__":
    main(tyro.cli(Config))
