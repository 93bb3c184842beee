"""A network that learns a third-party robot, beside MuJoCo at few substeps: error and rate.

    python experiments/open_loop.py gymnasium/Hopper-v5 --policy FOLDER --json FILE

1. Random trajectories of the robot in MuJoCo, as `nerd data` makes them, and trajectories
   along a policy, such as `python examples/ppo.py --dynamics mujoco --out FOLDER` learns.
2. A network that learns from them: updates on single steps, then on rollouts.
3. Its error on test starts, passive, under random actions and under the policy's, against
   MuJoCo with the robot's own integrator and substeps; MuJoCo with other ones is measured
   by the same. The policy's actions are those it took in the ground truth.
4. Control steps per second of all of them, in turns on one thread.

A run that is stopped goes on where it was.
"""

import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, cast

import torch
import tyro
from network_off import without_network
from policies_in_the_model import SEGMENT, pieces_along
from tensordict import TensorDict
from tyro.conf import Positional

from torchrl_nerd.checkpoint import load_checkpoint
from torchrl_nerd.configs import TrainConfig
from torchrl_nerd.data.simulate import is_sound, simulate
from torchrl_nerd.dynamics import MujocoDynamics, NeRDDynamics
from torchrl_nerd.evaluation.bench.candidates import (
    Candidate,
    models,
    mujoco_name,
    simulators,
)
from torchrl_nerd.evaluation.bench.errors import (
    GROUND_TRUTH,
    ErrorRow,
    EvaluationSet,
    cases_of,
    error_rows,
    evaluation_set,
    measure,
)
from torchrl_nerd.evaluation.bench.rates import rate_rows
from torchrl_nerd.evaluation.bench.report import pareto_front
from torchrl_nerd.evaluation.policy import load_policy, make_actor, policy_task
from torchrl_nerd.evaluation.results import write_results
from torchrl_nerd.evaluation.rollout_error import open_loop
from torchrl_nerd.files import folder_name
from torchrl_nerd.keys import CTRL, JOINT_TORQUE, QPOS, QVEL
from torchrl_nerd.modules.nerd import NeRD
from torchrl_nerd.robots import load_scene, protocol_of
from torchrl_nerd.scenes import Scene
from torchrl_nerd.seeds import fold_in
from torchrl_nerd.training.trainer import Trainer

STEPS = SEGMENT  # control steps of a training trajectory
LENGTH = 1000  # control steps along a policy
ALONG = "along a policy"  # the case
HORIZONS = (20, 100)  # of the errors, control steps
ZEROED = "learned, its last layer zero"
BF16 = "learned, bf16"
Errors = dict[str, dict[str, dict[str, float]]]
"""Name -> case, horizon and unit -> mean, final and 95th percentile of the error."""


@dataclass(frozen=True)
class Config:
    """What to learn, and what to measure."""

    robot: Positional[str]  # gymnasium/ID, dm_control/DOMAIN-TASK or an MJCF file
    trajectories: int = 5000  # random ones of 100 control steps
    network: str = "mlp-4x128-products"
    updates: int = 5000  # on 1,024 single steps
    rollout_updates: int = 500  # on 128 rollouts of 8 steps
    symmetries: int = 1  # of the robot, that the network has
    near_symmetry: bool = False  # those that it has but nearly, as well
    policy: Path | None = None  # of a task of this robot; None: random motion alone
    along: int = 200  # trajectories along it for the data, of up to 1,000 control steps
    noise: float = 0.3  # of actions there, largest standard deviation
    seed: int = 0  # of data and weights
    test_seed: int = 500  # of the starts and actions of the report
    test_trajectories: int = 256  # of each case
    batch: int = 512  # stepped together, for the rates
    rounds: int = 5  # of the rates
    out: Path = Path("runs/open_loop")
    json: Path | None = None
    """Write the results to this file."""

    @property
    def folder(self) -> Path:
        """Of the model."""
        return self.out / folder_name(self.robot)


def along_policy(
    scene: Scene, cfg: Config, rows: int, seed: int, noise: float
) -> TensorDict:
    """Pieces ``[n, STEPS]`` of trajectories along the policy, see `pieces_along`."""
    assert cfg.policy is not None
    task = policy_task(cfg.policy)
    if task.scene.hash != scene.hash:
        raise SystemExit(
            f"{cfg.policy} acts in {task.scene.name}, expected {scene.name}"
        )
    actor = make_actor(load_policy(cfg.policy, task))
    return pieces_along(task, actor, rows, LENGTH, fold_in(seed, 1), noise, STEPS)


def train(scene: Scene, cfg: Config) -> Path:
    """Where the model is that has learned from all trajectories."""
    data = simulate(scene, cfg.trajectories, STEPS, fold_in(cfg.seed, 0))
    data = cast(TensorDict, data[is_sound(data)])
    if cfg.policy is not None:
        along = along_policy(scene, cfg, cfg.along, cfg.seed, cfg.noise)
        data = cast(TensorDict, TensorDict.cat((data, along)))
    how = TrainConfig(
        network=cfg.network,
        steps=cfg.updates,
        rollout_steps=cfg.rollout_updates,
        single_step_fraction=1.0,
        loss_eps=0.02,
        symmetries=cfg.symmetries,
        near_symmetry=cfg.near_symmetry,
        validate_every=cfg.updates + cfg.rollout_updates,  # at the end alone
        save_every=500,
        seed=cfg.seed,
    )
    Trainer(scene, data, scene, how, cfg.folder, horizons=HORIZONS, logger="csv").run()
    return cfg.folder / "last"


def policy_set(scene: Scene, cfg: Config) -> EvaluationSet:
    """The case along the policy: states that it reaches, and what it does from there."""
    pieces = along_policy(scene, cfg, cfg.test_trajectories, cfg.test_seed, noise=0.0)
    chosen = torch.randperm(len(pieces), generator=fold_in(cfg.test_seed, 2))
    pieces = cast(TensorDict, pieces[chosen[: cfg.test_trajectories]])
    command = pieces[JOINT_TORQUE] if scene.servos is None else pieces[CTRL]
    start = cast(TensorDict, pieces.select(QPOS, QVEL)[:, 0])
    path = open_loop(MujocoDynamics(scene), start, STEPS, command)
    return EvaluationSet(ALONG, scene, start, command, mujoco_name(scene), path)


def errors_of(
    scene: Scene, candidates: Sequence[Candidate], cfg: Config
) -> list[ErrorRow]:
    """Of all candidates, in every case and over every horizon."""
    rows, about = [], (cfg.test_trajectories, max(HORIZONS), cfg.test_seed)
    sets = [
        evaluation_set(*case, MujocoDynamics, *about)
        for case in cases_of(protocol_of(scene))
    ]
    if cfg.policy is not None:
        sets.append(policy_set(scene, cfg))
    for chosen in sets:
        errors = measure([chosen], candidates)
        for horizon in HORIZONS:
            rows += error_rows(scene, chosen.case, horizon, errors, {})
    return rows


def by_unit(rows: Sequence[ErrorRow]) -> Errors:
    """Means over the quantities of one unit, such as all joints."""
    parts: dict[str, dict[str, list[ErrorRow]]] = {}
    for row in rows:
        where = f"{row.case}, {row.steps} steps, {row.unit}"
        parts.setdefault(row.name, {}).setdefault(where, []).append(row)
    numbers = "mean", "interval", "final", "p95"
    return {
        name: {
            where: {n: sum(getattr(r, n) for r in same) / len(same) for n in numbers}
            for where, same in found.items()
        }
        for name, found in parts.items()
    }


def compare(scene: Scene, model: Path, cfg: Config) -> dict[str, Any]:
    """Errors, rates, and where nothing is both faster and more exact than the model.

    In float32, and with the matrices of its blocks in bfloat16.
    """
    engines = simulators(scene, threads=1)
    found = models(scene, [str(model)], variants=("compiled", "bf16"))
    learned = [c for c in found if c.kind == "learned"]
    zeroed = without_network(cast(NeRD, load_checkpoint(model, scene)))
    off = Candidate(ZEROED, "learned", lambda _: NeRDDynamics(zeroed))
    # eager and compiled in float32, then in bfloat16
    full, full_compiled, half, half_compiled = learned
    rows = errors_of(scene, [*engines, full, half, off], cfg)
    moving = [c for c in (*engines, *learned) if c.kind != "baseline"]
    about = scene, cfg.batch, cfg.rounds, cfg.test_seed
    rates = {row.name: row.steps_per_s for row in rate_rows(moving, *about)}
    errors = by_unit(rows)
    shown = {full.name: "learned", half.name: BF16}
    compiled = {
        "learned": rates.pop(full_compiled.name),
        BF16: rates.pop(half_compiled.name),
    }
    errors = {shown.get(k, k): v for k, v in errors.items()}
    rates = {shown.get(k, k): v for k, v in rates.items()}
    theirs = {k: rates[k] for k in rates if k not in compiled}
    front: dict[str, dict[str, bool]] = {}
    for name, own in compiled.items():
        speeds = theirs | {name: max(own, rates[name])}
        for where in errors[name]:
            points = {
                k: (errors[k][where]["mean"], speed) for k, speed in speeds.items()
            }
            front.setdefault(name, {})[where] = name in pareto_front(points)
    return {
        "ground_truth": next(r.name for r in rows if r.kind == GROUND_TRUTH),
        "errors": errors,
        "rates": rates
        | {"compiled": compiled["learned"], "compiled bf16": compiled[BF16]},
        "on_the_front": front["learned"],
        "on_the_front_in_bf16": front[BF16],
    }


def main(cfg: Config) -> None:
    """Data, training and the report of one robot."""
    torch.set_num_threads(1)
    os.environ["NERD_THREADS"] = "1"
    scene = load_scene(cfg.robot)
    model = train(scene, cfg)
    with torch.no_grad():
        results = compare(scene, model, cfg)
    for name, found in results["errors"].items():
        means = ", ".join(f"{x['mean']:.3g}" for x in found.values())
        print(f"{name}: {means}; {results['rates'].get(name, 0.0):,.0f} steps/s")
    print({k: f"{results['rates'][k]:,.0f}" for k in ("compiled", "compiled bf16")})
    print({k: v for k, v in results.items() if k.startswith("on_the_front")})
    if cfg.json is not None:
        how = asdict(replace(cfg, json=None)) | {"out": str(cfg.out)}
        how["policy"] = None if cfg.policy is None else cfg.policy.name
        results = {"robot": cfg.robot, "configuration": how} | results
        write_results(cfg.json, results, cfg.test_seed)


if __name__ == "__main__":
    main(tyro.cli(Config))
