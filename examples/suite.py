"""From the name of a dm_control suite task to data, model, policy and transfer report.

    python examples/suite.py cartpole-swingup
    python examples/suite.py cheetah-run

The policy is learned in the learned model alone and measured in dm_control's own
environment. An action is held over a few control steps, as is usual on the suite.
"""

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import ppo
import torch
import tyro

from torchrl_nerd.configs import DataConfig, TrainConfig
from torchrl_nerd.data.generate import generate, load_data
from torchrl_nerd.evaluation.policy import Policy, make_actor, save_policy
from torchrl_nerd.evaluation.policy_transfer import transfer, transfer_table
from torchrl_nerd.files import write_json
from torchrl_nerd.scenes import Scene
from torchrl_nerd.scenes.importer import load_suite
from torchrl_nerd.tasks.suite import SuiteTask
from torchrl_nerd.training.trainer import Trainer


@dataclass(frozen=True)
class Config:
    """What to do and for how long; the defaults are for minutes on two cores."""

    name: Annotated[str, tyro.conf.Positional]  # DOMAIN-TASK, such as cartpole-swingup
    trajectories: int = 4000  # random ones of 100 steps each
    updates: int = 3000  # of the model
    frames: int = 600_000  # actions of the policy
    num_envs: int = 256  # that it learns from together
    hold: int = 4  # control steps that an action is held
    episodes: int = 64  # of the report, in each dynamics
    seed: int = 0
    out: Path = Path("runs/suite")


def make_model(scene: Scene, cfg: Config, folder: Path) -> Path:
    """Random trajectories in MuJoCo, and a network that learns from them."""
    data = DataConfig(trajectories=cfg.trajectories, steps=100, seed=cfg.seed)
    generate(scene, data, folder / "data")
    how = TrainConfig(
        network="mlp-4x64",
        steps=cfg.updates,
        rollout_steps=cfg.updates // 20,
        single_step_fraction=1.0,
        loss_eps=0.02,
        validate_every=max(500, cfg.updates // 3),
        seed=cfg.seed,
    )
    data = load_data(scene, folder / "data")
    Trainer(scene, data, scene, how, folder / "model", horizons=(20, 100)).run()
    return folder / "model" / "best"


def make_policy(task: SuiteTask, model: Path, cfg: Config) -> Policy:
    """PPO in learned dynamics alone."""
    how = ppo.Run(
        dynamics=str(model),
        total_frames=cfg.frames,
        num_envs=cfg.num_envs,
        minibatch=4 * cfg.num_envs,
        lr=2e-3,
        gamma=0.98,
        seed=cfg.seed,
        evaluate_every=10**9,  # at the end alone
        episodes=cfg.episodes,
    )
    policy, _ = ppo.train(how, task)
    return policy


Choose = Callable[[np.ndarray], np.ndarray]  # an action for an observation


def mean_action(policy: Policy) -> Choose:
    """What the policy does without exploring."""

    @torch.no_grad()
    def choose(observation: np.ndarray) -> np.ndarray:
        return policy(torch.from_numpy(observation).float())[0].tanh().double().numpy()

    return choose


def random_action(size: int, seed: int) -> Choose:
    """Uniform random actions."""
    draw = np.random.default_rng(seed)
    return lambda observation: draw.uniform(-1.0, 1.0, size)


def suite_returns(choose: Choose, name: str, hold: int, episodes: int) -> np.ndarray:
    """Whole episodes of 1000 rewards in the suite's own environment, ``(episodes,)``."""
    env, returns = load_suite(*name.split("-", 1)), np.zeros(episodes)
    for episode in range(episodes):
        step = env.reset()
        while not step.last():
            parts = [np.ravel(part) for part in step.observation.values()]
            action = choose(np.concatenate(parts))
            for _ in range(hold):
                if not step.last():
                    step = env.step(action)
                    returns[episode] += step.reward
    return returns


def main(cfg: Config) -> None:
    """Data, model, policy, report."""
    torch.manual_seed(cfg.seed)
    began = time.monotonic()
    task = SuiteTask(f"dm_control/{cfg.name}/{cfg.hold}")
    folder = cfg.out / cfg.name
    model = make_model(task.scene, cfg, folder)
    print(f"model in {model} after {time.monotonic() - began:.0f} s")
    policy = make_policy(task, model, cfg)
    save_policy(policy, folder, {"task": task.scene.name, "dynamics": str(model)})
    print(f"policy in {folder} after {time.monotonic() - began:.0f} s")
    where, actor = (str(model), "mujoco", "dm_control"), make_actor(policy)
    report = transfer(task, actor, where, cfg.episodes, seed=cfg.seed + 1)
    print(transfer_table(report), f"(one reward per {cfg.hold} control steps)")
    played = min(10, cfg.episodes)
    size, suite = task.controller.num_actions, {}
    acts = {"policy": mean_action(policy), "random": random_action(size, cfg.seed)}
    for who, choose in acts.items():
        found = suite_returns(choose, cfg.name, cfg.hold, played)
        suite[who] = {"mean": float(found.mean()), "std": float(found.std())}
        spread = f"{found.mean():.1f} of 1000, std {found.std():.1f}"
        print(f"dm_control itself, {played} episodes, {who} actions: {spread}")
    seconds = time.monotonic() - began
    print(f"{seconds:.0f} s in all")
    returns = {name: asdict(summary) for name, summary in report.items()}
    about = {"configuration": asdict(cfg), "suite": suite, "seconds": seconds}
    write_json(folder / "report.json", {**about, "returns": returns})


if __name__ == "__main__":
    main(tyro.cli(Config))
