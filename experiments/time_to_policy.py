"""How long PPO takes in each dynamics until its policy earns enough in MuJoCo.

    python experiments/time_to_policy.py ant/run --json results/time_to_policy_ant_run.json

The same PPO, with the same seed, learns in each dynamics alone. On the way its policy plays
whole episodes in MuJoCo and is saved; from the same starts it plays in the dynamics that it
learned in, which promised so much. Time is the processor's, of one thread: compilation
counts, the curve's episodes do not, and nor does what a model took to learn.
Dynamics are those of `make_env`, and `mujoco-N` is MuJoCo with N substeps.
"""

import os
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from tyro.conf import Positional

sys.path.insert(0, str(Path(__file__).parents[1] / "examples"))
import ppo
from learner import Clock, Learner, run, use_one_thread

from torchrl_nerd import make_env
from torchrl_nerd.dynamics import ENGINES
from torchrl_nerd.envs.base import SceneEnv
from torchrl_nerd.envs.frame_stack import stack_frames
from torchrl_nerd.evaluation.policy import save_policy
from torchrl_nerd.evaluation.policy_transfer import policy_returns
from torchrl_nerd.evaluation.results import write_results
from torchrl_nerd.files import folder_name, read_json, write_json
from torchrl_nerd.robots import PPO_CONFIGS, make_task

FEW = "mujoco-"  # and a number of substeps


@dataclass(frozen=True)
class Config:
    """What to learn, where, and how."""

    task: Positional[str]
    dynamics: tuple[str, ...] = ("nerd", "analytic", "mujoco")
    points: int = 10  # of a curve, after the first
    wanted: float | None = None  # return in MuJoCo; None: see `wanted_of`
    frames: int | None = None  # actions; None: as the task's PPO has it
    num_envs: int | None = None  # so are these
    horizon: int | None = None
    minibatch: int | None = None
    lr: float | None = None
    episodes: int = 128  # of a point
    seed: int = 0
    out: Path = Path("runs/time_to_policy")
    json: Path | None = None
    """Write the results to this file."""

    @property
    def folder(self) -> Path:
        """Of policies."""
        return self.out / self.task.replace("/", "-")

    @property
    def ppo(self) -> ppo.Run:
        """Settings of PPO, the same in all dynamics."""
        kept = PPO_CONFIGS.get(self.task, ppo.PPOConfig())
        given = {"total_frames": self.frames, "seed": self.seed}
        for name in ("num_envs", "horizon", "minibatch", "lr"):
            given[name] = getattr(self, name)
        given = {name: value for name, value in given.items() if value is not None}
        return replace(ppo.Run(**vars(kept), task=self.task), **given)


def json_of(cfg: Config) -> dict[str, Any]:
    """What a curve depends on, as JSON has it."""
    names = ("task", "points", "episodes", "seed")
    settings = asdict(cfg.ppo) | {"out": None, "widths": list(cfg.ppo.widths)}
    return {name: getattr(cfg, name) for name in names} | {"ppo": settings}


def env_of(
    name: str, task: str, num_envs: int, seed: int, compile: bool = False
) -> SceneEnv:
    """Of a dynamics; ``compile``: where it is a model."""
    if name.startswith(FEW):
        own = make_task(task)
        count = name.removeprefix(FEW)
        if not count.isdecimal():
            raise ValueError(f"expected {FEW} and a number of substeps, got '{name}'")
        few = own.scene.with_substeps(int(count))
        return make_env(own.with_scene(few), "mujoco", num_envs, seed)
    return make_env(task, name, num_envs, seed, compile=compile and name not in ENGINES)


def learn_in(name: str, cfg: Config) -> list[dict[str, Any]]:
    """The curve of one dynamics, with a policy in the folder for each point.

    A curve that is in the folder already, with the same settings, is not made again.
    """
    folder = cfg.folder / folder_name(name)
    kept, same = folder / "curve.json", json_of(cfg)
    if kept.exists() and (found := read_json(kept))["configuration"] == same:
        return found["curve"]
    use_one_thread()
    cold = TemporaryDirectory()  # nothing is compiled yet, whoever came first
    os.environ["TORCHINDUCTOR_CACHE_DIR"] = cold.name
    how, clock, curve = cfg.ppo, Clock(), []
    env = env_of(name, cfg.task, how.num_envs, cfg.seed, compile=True)
    env = stack_frames(env, how.frame_stack)
    torch.manual_seed(cfg.seed)  # behind the env, so that all begin with one policy
    learner = Learner(how, env)
    for point in range(cfg.points + 1):
        if point:
            learner.learn(env, 1.0 / cfg.points)
        clock.note("learning")
        returns = {}
        for judge in dict.fromkeys(("mujoco", name)):
            tried = env_of(judge, cfg.task, cfg.episodes, cfg.seed + 100)
            returns[judge] = float(policy_returns(tried, learner.actor).mean())
        reached, promised = returns["mujoco"], returns[name]
        about = {"learned_in": name, "task": cfg.task, "return": reached}
        save_policy(learner.policy, folder / f"{point}", about)
        frames = learner.done * learner.batch
        curve.append({"frames": frames, "seconds": clock.spent()})
        curve[-1] |= {"return": reached, "promised": promised}
        print(f"{name}: {curve[-1]}", flush=True)
        clock.note("watching")
    cold.cleanup()
    write_json(kept, {"configuration": same, "curve": curve})
    return curve


def time_to(curve: list[dict[str, Any]], wanted: float) -> float | None:
    """Seconds until a curve reaches a return and stays there; None: it does not."""
    found = None
    for point in curve:
        if not point["return"] >= wanted:  # NaN is not
            found = None
        elif found is None:
            found = point["seconds"]
    return found


def wanted_of(curve: list[dict[str, Any]]) -> float:
    """Nine tenths of the way from a curve's first return to its last."""
    first, last = curve[0]["return"], curve[-1]["return"]
    return first + 0.9 * (last - first)


def main(cfg: Config) -> None:
    """Two dynamics at a time, then the time of each to a return that MuJoCo's reached.

    Raises:
        ValueError: neither a return is wanted nor does a policy learn in MuJoCo.
    """
    if cfg.wanted is None and "mujoco" not in cfg.dynamics:
        raise ValueError(
            f"expected --wanted, or mujoco among {', '.join(cfg.dynamics)}"
        )
    for name in cfg.dynamics:  # a wrong one is refused before anything learns
        env_of(name, cfg.task, 1, cfg.seed)
    with ProcessPoolExecutor(2, get_context("spawn"), max_tasks_per_child=1) as pool:
        runs = {name: pool.submit(learn_in, name, cfg) for name in cfg.dynamics}
        curves = {name: run.result() for name, run in runs.items()}
    wanted = wanted_of(curves["mujoco"]) if cfg.wanted is None else cfg.wanted
    times = {name: time_to(curve, wanted) for name, curve in curves.items()}
    print(f"seconds to a return of {wanted:.0f} in MuJoCo: {times}")
    if cfg.json is not None:
        found = {"configuration": json_of(cfg), "wanted": wanted}
        found |= {"seconds": times, "curves": curves}
        write_results(cfg.json, found, cfg.seed)


if __name__ == "__main__":
    os.environ["TORCHINDUCTOR_COMPILE_THREADS"] = "1"  # so that it is counted
    run(main, Config, __doc__)
