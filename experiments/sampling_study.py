"""Which training data make the better model: sampling strategies compared.

    python experiments/sampling_study.py --scene cartpole --json results/sampling.json

Each strategy draws as many transitions, the same network gets as many updates, and each
model meets the same tests: open-loop error, passive and under random actions, and the
return of one and the same policy. What is done is kept under `--out`: a killed run goes on.
"""

import subprocess
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import Any

import torch
import tyro
from torch import Generator, Tensor

from torchrl_nerd.checkpoint import load_checkpoint
from torchrl_nerd.configs import DataConfig, TrainConfig
from torchrl_nerd.data.generate import CARD, Draw, generate, load_data
from torchrl_nerd.data.strategies import SettledStates, along, mix, strategy
from torchrl_nerd.dynamics import MujocoDynamics, dynamics_of
from torchrl_nerd.envs import make_env
from torchrl_nerd.envs.actor import Actor
from torchrl_nerd.evaluation.policy import WEIGHTS, load_policy, make_actor
from torchrl_nerd.evaluation.policy_transfer import policy_returns, summarize
from torchrl_nerd.evaluation.results import write_results
from torchrl_nerd.evaluation.rollout_error import passive_errors
from torchrl_nerd.files import read_json, write_json
from torchrl_nerd.keys import QPOS, QVEL
from torchrl_nerd.modules.networks import network_config
from torchrl_nerd.robots import PPO_CONFIGS, PRESETS, make_task
from torchrl_nerd.scenes import Scene
from torchrl_nerd.tasks import Task
from torchrl_nerd.training.policy_data import policy_data
from torchrl_nerd.training.trainer import Trainer

MIN_TORQUE_SCALE = 0.01  # of the largest torque
ZERO_TORQUE_FRACTION = 0.1
TEST_SEED = 500  # of starts and episodes; never one of training or validation
PPO = Path(__file__).parents[1] / "examples" / "ppo.py"


@dataclass(frozen=True)
class TaskResets:
    """Initial states of a task's episodes.

    The task's terrain is not used, since models may be tested on it: where the terrain
    varies, the scene's sampling draws it.
    """

    task: Task

    def __call__(self, rows: int, generator: Generator) -> dict[str, Tensor]:
        """See `Starts`."""
        size = (rows, self.task.num_uniforms)
        u = torch.rand(size, dtype=torch.float64, generator=generator)
        state = self.task.initial_state(u)
        return {QPOS: state[QPOS], QVEL: state[QVEL]}


def strategies(
    scene: Scene, task: Task, explorer: Actor | None = None
) -> dict[str, Draw]:
    """The sampling strategies of a scene, by name.

    | name | initial states and torques |
    |---|---|
    | ``uniform`` | uniform in the ranges, new torques in every step |
    | ``shares`` | the scene's own sampling, with zero-torque and low-torque trajectories |
    | ``scales`` | torque scales log-uniform over two decades |
    | ``starts`` | equal parts of ``shares``, task resets and settled states |
    | ``correlated``, ``level``, ``resting`` | see `data.strategies` |
    | ``policy`` | trajectories of an exploring policy |
    | ``mixed`` | equal parts of ranges, task resets, settled states and policy |

    All parts of ``mixed`` but the policy's have torque scales and correlation. Scenes
    without such ground have no ``level``. Scenes whose torques follow the state have no
    correlation. Without an explorer there is no ``policy`` and no part of it in ``mixed``.

    Args:
        scene: the robot.
        task: of the same scene; its resets are among the initial states.
        explorer: the policy that explores.
    """
    scaled: dict[str, Any] = {
        "min_torque_scale": MIN_TORQUE_SCALE,
        "zero_torque_fraction": ZERO_TORQUE_FRACTION,
        "low_torque_fraction": 0.0,
    }
    own = along(scene)
    resets, settled = {"starts": TaskResets(task)}, {"starts": SettledStates(scene)}
    found = {
        "uniform": along(scene, zero_torque_fraction=0.0, low_torque_fraction=0.0),
        "shares": own,
        "scales": along(scene, **scaled),
        "starts": mix(own, along(scene, **resets), along(scene, **settled)),
        "resting": strategy(scene, "resting"),
    }
    if scene.sampling.level_ground is not None:
        found["level"] = strategy(scene, "level")
    if scene.sampling.drive is None:
        found["correlated"] = strategy(scene, "correlated")
        scaled["correlation_time"] = (scene.control_step, 1.0)
    mixed = [along(scene, **scaled, **starts) for starts in ({}, resets, settled)]
    if explorer is not None:
        found["policy"] = partial(policy_data, task, explorer)
        mixed.append(found["policy"])
    return {**found, "mixed": mix(*mixed)}


@dataclass(frozen=True)
class Options:
    """What to compare, and how much to spend on it."""

    scene: str = "cartpole"
    """A scene with a preset."""
    only: tuple[str, ...] = ()
    """Names of strategies; all that the scene has by default."""
    task: str | None = None
    """What the policies do; the task of the scene's preset by default."""
    transitions: int = 200_000
    """Of each data set, at 100 steps a trajectory."""
    network: str = "mlp-4x64"
    updates: int = 4_000
    """On 1,024 single states each."""
    seeds: tuple[int, ...] = (0,)
    """Of data, weights and batches: one model each."""
    rows: int = 512
    """Trajectories of each test."""
    horizon: int = 100
    """Control steps of the open-loop tests."""
    policy: Path | None = None
    """Folder of the policy that is measured; learned in MuJoCo by default."""
    explorer: Path | None = None
    """Folder of the policy that makes data; another seed of the same by default."""
    policy_frames: int = 2_000_000
    """Actions that these two learn from; 0: only policies that are given are used."""
    learn_frames: int = 0
    """Actions that a policy learns from in each model, then run in MuJoCo; 0: none."""
    episodes: int = 256
    """Of each return."""
    threads: int | None = None
    """Of torch; its own choice by default."""
    out: Path = Path("runs/sampling_study")
    json: Path | None = None
    """Write the results to this file."""


def learned_policy(
    folder: Path, task: str, dynamics: str, seed: int, frames: int
) -> Path:
    """The policy in ``folder``, learned first where there is none."""
    if not (folder / WEIGHTS).exists():
        settings = {"task": task, "dynamics": dynamics, "seed": seed, "out": folder}
        settings |= {"total-frames": frames, "episodes": 64, "evaluate-every": 10**6}
        flags = [str(x) for k, v in settings.items() for x in (f"--{k}", v)]
        subprocess.run([sys.executable, str(PPO), *flags], check=True)
    return folder


@dataclass(frozen=True)
class Study:
    """Tests and policies that all strategies share."""

    options: Options
    folder: Path
    task_id: str
    policy: Path | None
    explorer: str | None  # hash of its weights

    def model(self, name: str, draw: Draw, seed: int) -> Path:
        """Checkpoint of a strategy's model, made as far as it is not there."""
        options, scene = self.options, make_task(self.task_id).scene
        folder = self.folder / name / str(seed)
        config = DataConfig(trajectories=options.transitions // 100, seed=seed)
        # data along another policy are others, and refused in the same folder
        its = name if self.explorer is None else f"{name} {self.explorer}"
        generate(scene, config, folder / "data", strategy=(its, draw))
        train = TrainConfig(
            network=options.network,
            steps=options.updates,
            rollout_steps=0,
            single_step_fraction=1.0,
            loss_eps=PRESETS[options.scene].train.loss_eps,
            validate_every=options.updates,
            seed=seed,
        )
        data, task = load_data(scene, folder / "data"), make_task(self.task_id)
        horizons = (options.horizon,)
        Trainer(scene, data, task, train, folder / "run", horizons=horizons).run()
        return folder / "run" / "last"

    def returns(self, policy: Path, dynamics: str | Path) -> torch.Tensor:
        """Of one episode from each of the same starts."""
        episodes = self.options.episodes
        env = make_env(self.task_id, dynamics, episodes, seed=TEST_SEED)
        loaded = load_policy(policy, env.task)
        return policy_returns(env, make_actor(loaded))

    def measure(self, model: Path, name: str, seed: int) -> dict[str, Any]:
        """Errors by test, and returns."""
        options, task = self.options, make_task(self.task_id)
        results: dict[str, Any] = {"strategy": name, "seed": seed}
        card = read_json(model.parents[1] / "data" / CARD)
        results |= {"trajectories": card["trajectories"], "dropped": card["dropped"]}
        for test, is_random in (("passive", False), ("random", True)):
            learned = dynamics_of(load_checkpoint(model, task.scene))
            ground_truth = MujocoDynamics(task.scene)
            sizes = ([options.horizon], options.rows, TEST_SEED)
            errors = passive_errors(
                task, learned, ground_truth, *sizes, random_actions=is_random
            )[options.horizon]
            results[test] = {k: asdict(v) for k, v in errors.items()}
        if self.policy is not None:
            ground_truth = self.returns(self.policy, "mujoco")
            transfer = summarize(self.returns(self.policy, model), ground_truth)
            results["transfer"] = asdict(transfer)
        if options.learn_frames:
            where = (self.task_id, str(model), seed, options.learn_frames)
            learned_there = learned_policy(model.parent / f"policy_{where[-1]}", *where)
            there, ground_truth = (
                self.returns(learned_there, d) for d in (model, "mujoco")
            )
            results["learned_there"] = asdict(summarize(there, ground_truth)) | {
                "mujoco_mean": float(ground_truth.mean())
            }
        return results


def run(options: Options) -> Iterator[dict[str, Any]]:
    """Results of every strategy and seed; those already measured are read."""
    if options.scene not in PRESETS:
        known = ", ".join(PRESETS)
        raise ValueError(f"expected a scene of {known}, got '{options.scene}'")
    network_config(options.network)  # refuses what is none before hours of policies
    task_id = str(options.task or PRESETS[options.scene].task)
    task, folder = make_task(task_id), options.out / options.scene
    policy, explorer = options.policy, options.explorer
    if task_id in PPO_CONFIGS and options.policy_frames:
        where = (task_id, "mujoco")
        sizes = options.policy_frames
        for_tests, for_data = (
            folder / f"{x}_{sizes}" for x in ("measured", "explorer")
        )
        policy = policy or learned_policy(for_tests, *where, 0, sizes)
        explorer = explorer or learned_policy(for_data, *where, 1, sizes)
    actor = make_actor(load_policy(explorer, task)) if explorer else None
    known = strategies(task.scene, task, actor)
    for name in options.only or known:
        if name not in known:
            raise ValueError(f"expected a strategy of {', '.join(known)}, got '{name}'")
    explored = explorer and sha256((explorer / WEIGHTS).read_bytes()).hexdigest()
    study = Study(options, folder, task_id, policy, explored)
    for name in options.only or known:
        for seed in options.seeds:
            path = folder / name / str(seed) / "results.json"
            settings = _settings(replace(options, policy=policy, explorer=explorer))
            if not path.exists() or read_json(path)["settings"] != settings:
                model = study.model(name, known[name], seed)
                results = study.measure(model, name, seed)
                write_json(path, results | {"settings": settings})
            yield {k: v for k, v in read_json(path).items() if k != "settings"}


def _settings(options: Options) -> dict[str, Any]:
    """What results depend on, as JSON knows it."""
    aside = ("only", "seeds", "threads", "out", "json")
    found = {k: v for k, v in asdict(options).items() if k not in aside}
    return {k: str(v) if isinstance(v, Path) else v for k, v in found.items()}


def table(rows: list[dict[str, Any]]) -> str:
    """Markdown: one line for each model, ``mean / final / p95`` of each quantity."""
    tests = [(t, q) for t in ("passive", "random") for q in rows[0][t]]
    heads = [f"{t}, {q}, {rows[0][t][q]['unit']}" for t, q in tests]
    heads = [
        "strategy",
        "seed",
        *heads,
        "return difference",
        "learned there, true return",
    ]
    lines = [" | ".join(heads), " | ".join(["---"] * len(heads))]
    for row in rows:
        cells = [row["strategy"], str(row["seed"])]
        for test, quantity in tests:
            errors = (row[test][quantity][key] for key in ("mean", "final", "p95"))
            cells.append(" / ".join(_number(error) for error in errors))
        found, own = row.get("transfer"), row.get("learned_there")
        cells.append(
            f"{found['difference']:+.3%} ± {found['difference_interval']:.3%}"
            if found
            else "-"
        )
        cells.append(f"{own['mujoco_mean']:.0f}" if own else "not measured")
        lines.append(" | ".join(cells))
    return "\n".join(f"| {line} |" for line in lines)


def _number(error: float | None) -> str:
    return "not finite" if error is None else f"{error:.4f}"


def main(options: Options) -> None:
    """Print a table and write the results."""
    if options.threads:
        torch.set_num_threads(options.threads)
    rows = []
    for results in run(options):
        rows.append(results)
        if options.json is not None:
            results = {"options": _settings(options), "models": rows}
            write_results(options.json, results, list(options.seeds))
    print(table(rows))


if __name__ == "__main__":
    try:
        main(tyro.cli(Options))
    except ValueError as error:
        sys.exit(f"sampling_study: {error}")
