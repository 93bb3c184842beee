"""Policies learned in a learned model alone, beside PPO in MuJoCo at equal frames.

    python experiments/policies_in_the_model.py dm_control/walker-walk/4 --json FILE

1. Random trajectories of the robot in MuJoCo, and a network that learns from them.
2. In rounds: trajectories along the policy in MuJoCo, from which the model goes on
   learning; PPO in the model alone, where an episode fails as soon as a step is unlike the
   data.
   After the last round the model learns once more, and says what the policy earns.
3. Its rivals learn in MuJoCo beside it, with the same PPO and episodes that begin anew
   with each round: one for as many frames as the policy had in the model, one for as many
   as the model's data cost the robot.
4. All play whole episodes in MuJoCo, from the same held-out starts.

The two ways take a processor each at the same time, and each counts what it took of it.
"""

import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import cast

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Generator, Tensor
from torchrl.envs import Transform, TransformedEnv
from tyro.conf import Positional

sys.path.insert(0, str(Path(__file__).parents[1] / "examples"))
import ppo
from learner import Clock, Learner, processor_time, run, use_one_thread

from torchrl_nerd import make_env
from torchrl_nerd.configs import TrainConfig
from torchrl_nerd.data.simulate import is_sound, simulate
from torchrl_nerd.dynamics import GuardedDynamics, NeRDDynamics
from torchrl_nerd.envs.actor import Actor
from torchrl_nerd.envs.base import SceneEnv
from torchrl_nerd.evaluation.policy import save_policy
from torchrl_nerd.evaluation.policy_transfer import policy_returns, summarize
from torchrl_nerd.evaluation.results import write_results
from torchrl_nerd.keys import NEXT_QPOS, NEXT_QVEL, QPOS, QVEL, TRUST
from torchrl_nerd.modules.nerd import NeRD
from torchrl_nerd.modules.networks import network_config
from torchrl_nerd.robots import make_task
from torchrl_nerd.seeds import fold_in
from torchrl_nerd.tasks import Task
from torchrl_nerd.training.policy_data import policy_data
from torchrl_nerd.training.trainer import Trainer

SEGMENT = 100  # control steps of a random trajectory
PIECE = 20  # control steps along the policy until a robot that fell starts anew
WATCHED = 64  # episodes of a point of the learning curves


@dataclass(frozen=True)
class Config:
    """What to learn, and for how long."""

    name: Positional[str]  # a task with rewards, such as dm_control/cheetah-run/4
    trajectories: int = 500  # random ones of 100 control steps
    updates: int = 1500  # of the model, on them
    rounds: int = 10  # of PPO in the model; data are added between two of them
    along: int = 32  # trajectories along the policy before a round
    length: int = 1000  # control steps of each
    more_updates: int = 1000  # of the model, after the first round
    last_updates: int = 3000  # of the model that promises what the last policy earns
    batch: int = 512  # transitions of an update
    trust: float = 0.5  # a step fails below: twice as far out as 99% of the data
    network: str = "mlp-4x64-products"
    symmetries: int = 0  # of the robot, built into the network; 0: all that it has
    near_symmetry: bool = False  # those that it has but nearly, as well
    noise: float = 0.3  # of actions along the policy, largest standard deviation
    frames: int = 3_000_000  # actions of PPO, all rounds together; in MuJoCo as well
    num_envs: int = 512
    horizon: int = 32
    minibatch: int = 4096
    lr: float = 1e-3
    gamma: float = 0.99
    widths: tuple[int, ...] = (128, 128)
    episodes: int = 256  # of the report, in each dynamics
    device: str = "cpu"  # of the model, and of PPO in it
    seed: int = 0
    out: Path = Path("runs/policies")
    json: Path | None = None
    """Write the results to this file."""

    @property
    def folder(self) -> Path:
        """Of models and policies."""
        return self.out / self.name.replace("/", "-")

    @property
    def ppo(self) -> ppo.Run:
        """Settings of PPO, the same in all dynamics."""
        names = ("num_envs", "horizon", "minibatch", "lr", "gamma", "widths", "seed")
        kept = {name: getattr(self, name) for name in names}
        return ppo.Run(total_frames=self.frames, **kept)


class Trusted(Transform):
    """Ends an episode as failed where a model is asked for what it has no data of.

    ``least``: the trust that a step needs.
    """

    def __init__(self, least: float) -> None:
        super().__init__()
        self.least = least

    def _step(
        self, tensordict: TensorDictBase, next_tensordict: TensorDictBase
    ) -> TensorDictBase:
        lost = next_tensordict[TRUST] < self.least  # (num_envs, 1)
        for key in ("done", "terminated"):
            next_tensordict[key] = next_tensordict[key] | lost
        return next_tensordict


def begin(cfg: Config, device: str = "cpu") -> tuple[Task, Clock]:
    """One processor for this process, and the task; with a GPU wall time counts."""
    use_one_thread()
    torch.manual_seed(cfg.seed)
    read = processor_time if device == "cpu" else time.monotonic
    return make_task(cfg.name), Clock(read)


def returns_of(cfg: Config, actor: Actor, count: int, seed: int) -> Tensor:
    """Of whole episodes in MuJoCo, ``(count,)``."""
    return policy_returns(make_env(make_task(cfg.name), "mujoco", count, seed), actor)


def watched(cfg: Config, actor: Actor) -> float:
    """Mean return in MuJoCo, from starts that the report does not use."""
    return float(returns_of(cfg, actor, WATCHED, cfg.seed + 100).mean())


def pieces_along(
    task: Task,
    actor: Actor,
    rows: int,
    length: int,
    draw: Generator,
    noise: float,
    steps: int = PIECE,
) -> TensorDict:
    """Pieces ``[n, steps]`` of trajectories in MuJoCo, without those that diverge.

    A robot that fell starts anew at the end of its piece.
    """
    start, pieces = None, []
    for _ in range(length // steps):
        piece = policy_data(task, actor, rows, steps, draw, noise, start)
        after = {QPOS: piece[NEXT_QPOS], QVEL: piece[NEXT_QVEL]}
        sound = is_sound(piece)  # (rows,)
        stays = sound & ~task.terminated(after).any(1)
        u = torch.rand(rows, task.num_uniforms, dtype=torch.float64, generator=draw)
        fresh = TensorDict(task.initial_state(u), [rows])
        last = cast(TensorDict, piece[:, -1])
        last = last.update({key: value[:, -1] for key, value in after.items()})
        start = last.select(*fresh.keys()).where(stays, fresh)
        pieces.append(piece[sound])
    return cast(TensorDict, TensorDict.cat(pieces))


def train_model(
    task: Task, data: TensorDict, cfg: Config, number: int, start: NeRD | None
) -> NeRD:
    """The model of a round, from scratch or from the one before."""
    updates = cfg.last_updates if number == cfg.rounds else cfg.more_updates
    how = TrainConfig(
        network=cfg.network,
        symmetries=cfg.symmetries,
        near_symmetry=cfg.near_symmetry,
        steps=cfg.updates if start is None else updates,
        rollout_steps=0,
        batch_size=cfg.batch,
        sequence_length=1,
        bf16_fraction=0.85,
        loss_eps=0.02,
        lr=0.02 if start is None else 0.01,
        adamw_lr=3e-3,
        validate_every=10**9,  # at the end alone
        save_every=10**9,
        seed=cfg.seed,
    )
    folder = cfg.folder / f"model_{number}"
    given = {"quiet": True, "logger": "csv", "init_from": start, "horizons": (20,)}
    about = task.scene, data, task.scene, how, folder, cfg.device
    return Trainer(*about, **given).run().eval()


def env_in(
    task: Task, model: NeRD, num_envs: int, seed: int, device: str = "cpu"
) -> SceneEnv:
    """The task in a model that says how well it knows a step."""
    return SceneEnv(task, GuardedDynamics(NeRDDynamics(model)), num_envs, seed, device)


def in_the_model(cfg: Config) -> dict:
    """A policy learned in models alone, what it took, and how it does."""
    task, clock = begin(cfg, cfg.device)
    data = simulate(task.scene, cfg.trajectories, SEGMENT, fold_in(cfg.seed, 0))
    data = cast(TensorDict, data[is_sound(data)].reshape(-1, PIECE))
    curve = []
    learner = Learner(cfg.ppo, make_env(task, "mujoco", 8, cfg.seed, device=cfg.device))
    model: NeRD | None = None

    def learned(number: int) -> NeRD:
        """The model, once it learned along the policy as well."""
        nonlocal data
        draw = fold_in(cfg.seed, 1 + number)
        along = task, learner.on_the_processor(), cfg.along, cfg.length
        more = pieces_along(*along, draw, cfg.noise)
        data = cast(TensorDict, TensorDict.cat((data, more)))
        clock.note("data")
        found = train_model(task, data, cfg, number, model)
        clock.note("model")
        return found

    for number in range(cfg.rounds):
        model = learned(number)
        env = env_in(task, model, cfg.num_envs, cfg.seed + number, cfg.device)
        env = TransformedEnv(env, Trusted(cfg.trust))
        last = learner.learn(env, 1.0 / cfg.rounds)
        clock.note("policy")
        found = watched(cfg, learner.on_the_processor())
        point = {"robot_frames": data.numel(), "return": found, **last}
        curve.append(point | {"seconds": clock.spent()})
        print(f"model, round {number + 1}: {curve[-1]}", flush=True)
        clock.note("watching")  # no part of the method
    model = learned(cfg.rounds)
    save_policy(learner.policy, cfg.folder / "policy", {})
    seed, count, actor = cfg.seed + 10_000, cfg.episodes, learner.on_the_processor()
    promised = policy_returns(env_in(task, model.cpu(), count, seed), actor)
    reached = returns_of(cfg, actor, count, seed)
    return {
        "curve": curve,
        "seconds": clock.seconds,
        "reached": reached,
        "promised": promised,
    }


def in_mujoco(cfg: Config) -> dict:
    """A policy learned in MuJoCo, what it took, and how it does."""
    task, clock = begin(cfg)
    learner = Learner(cfg.ppo, make_env(task, "mujoco", cfg.num_envs, cfg.seed))
    curve = []
    for number in range(cfg.rounds):
        env = make_env(task, "mujoco", cfg.num_envs, cfg.seed + number)
        last = learner.learn(env, 1.0 / cfg.rounds)
        clock.note("policy")
        found = watched(cfg, learner.actor)
        robot_frames = learner.done * learner.batch * task.frame_skip
        point = {"robot_frames": robot_frames, "return": found, **last}
        curve.append(point | {"seconds": clock.spent()})
        print(f"MuJoCo, {curve[-1]}", flush=True)
        clock.note("watching")
    reached = returns_of(cfg, learner.actor, cfg.episodes, cfg.seed + 10_000)
    return {"curve": curve, "seconds": clock.seconds, "reached": reached}


def few_frames(cfg: Config, robot_frames: int) -> Tensor:
    """Returns of a policy that learned from as many robot frames as the model had."""
    actions = robot_frames // make_task(cfg.name).frame_skip
    return in_mujoco(replace(cfg, frames=actions, rounds=1))["reached"]


def main(cfg: Config) -> None:
    """Both ways side by side, then the report.

    Raises:
        ValueError: an unknown task or network, trajectories that are too short, or a
            folder that holds models already.
    """
    make_task(cfg.name)
    network_config(cfg.network)
    if cfg.length < PIECE:
        raise ValueError(f"expected --length of at least {PIECE}, got {cfg.length}")
    if any(cfg.folder.glob("model_*")):
        raise ValueError(
            f"expected no models in {cfg.folder}, got some: choose another --out"
        )
    with ProcessPoolExecutor(2, get_context("spawn")) as pool:
        ways = pool.submit(in_the_model, cfg), pool.submit(in_mujoco, cfg)
        learned, rival = (way.result() for way in ways)
        report(cfg, learned, rival, {})
        robot_frames = learned["curve"][-1]["robot_frames"]
        fewer = pool.submit(few_frames, cfg, robot_frames).result()
    report(cfg, learned, rival, {"the model's robot frames": fewer})


def report(cfg: Config, learned: dict, rival: dict, others: dict[str, Tensor]) -> None:
    """Print what all policies earn, and write it down."""
    reached, promised = learned["reached"], learned["promised"]
    theirs, same = rival["reached"], "ground truth"
    returns = {
        "learned in the model, in MuJoCo": summarize(reached, theirs, same),
        "learned in the model, in the model": summarize(promised, reached),
        "learned in MuJoCo": summarize(theirs, theirs, same),
    }
    for name, found in others.items():
        returns[f"learned in MuJoCo, {name}"] = summarize(found, theirs, same)
    for name, found in returns.items():
        print(f"{name}: {found.mean:.1f} +- {found.interval:.1f}", flush=True)
    spent = {
        name: {k: v for k, v in way["seconds"].items() if k != "watching"}
        for name, way in (("model", learned), ("mujoco", rival))
    }
    print({name: round(sum(times.values())) for name, times in spent.items()}, "s")
    if cfg.json is not None:
        how = asdict(replace(cfg, json=None)) | {"out": str(cfg.out)}
        found = {name: asdict(summary) for name, summary in returns.items()}
        results = {"configuration": how, "returns": found, "seconds": spent}
        results |= {"model": learned["curve"], "mujoco": rival["curve"]}
        write_results(cfg.json, results, cfg.seed)


if __name__ == "__main__":
    run(main, Config, __doc__)
