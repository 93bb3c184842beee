"""Step time of MuJoCo and of a learned step against batch, contacts and freedoms.

    python benchmarks/scaling.py
    python benchmarks/scaling.py --scenes ant cartpole --batches 512 --compile

Every registered scene and dm_control's humanoid. MuJoCo makes the scene's own substeps; the
network is untrained and of the scene's sizes, since its speed does not depend on weights:
**how far it would err is another question**. Both step the same states, again and again,
taken at random moments of passive motion from the scene's sampling ranges. All take turns,
on one thread each; the processor's time counts, which other work disturbs little.
"""

import time
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import fmean, median
from typing import Any, cast

import mujoco
import torch
import tyro
from step_cost import memory_bytes
from tensordict import TensorDict

from torchrl_nerd.configs import NO_PREDICTIONS
from torchrl_nerd.dynamics import MujocoDynamics, NeRDDynamics
from torchrl_nerd.evaluation.bench.rates import Runner, mid_states, stepper
from torchrl_nerd.evaluation.results import write_results
from torchrl_nerd.keys import QPOS, TERRAIN
from torchrl_nerd.modules.nerd import NeRD
from torchrl_nerd.modules.networks import NETWORKS, network_config
from torchrl_nerd.robots import SCENES, load_scene
from torchrl_nerd.scenes import Scene
from torchrl_nerd.settings import expect_at_least

HEAVY = "dm_control/humanoid-run"
LOOKED_AT = 64  # envs whose contacts are counted


@dataclass
class Options:
    """What to time, and how often."""

    scenes: tuple[str, ...] = (*SCENES, HEAVY)
    batches: tuple[int, ...] = (1, 16, 64, 512, 4096)
    network: str = "mlp-4x128"
    compile: bool = False
    """Compile the learned step: minutes for each scene with contact."""
    rounds: int = 5
    seed: int = 0
    json: Path | None = None
    """Write the results to this file."""


@dataclass(frozen=True)
class Point:
    """One scene and batch.

    | field | meaning |
    |---|---|
    | ``scene``, ``rows`` | what was stepped, how many together |
    | ``dofs``, ``substeps`` | of the scene |
    | ``points`` | contact points that the network is told of |
    | ``contacts`` | mean number that MuJoCo found in the states that were stepped |
    | ``mujoco_us``, ``learned_us`` | processor time of one env's control step, median |
    | ``ratio`` | learned rate over MuJoCo's, median over rounds |
    | ``state_bytes`` | of an env |
    """

    scene: str
    rows: int
    dofs: int
    substeps: int
    points: int
    contacts: float
    mujoco_us: float
    learned_us: float
    ratio: float
    state_bytes: int


def mean_contacts(scene: Scene, state: TensorDict) -> float:
    """Contacts that MuJoCo finds, mean over the first envs."""
    data, counts = mujoco.MjData(scene.model), []
    for env in cast(TensorDict, state[:LOOKED_AT]).unbind(0):
        data.qpos[:] = env[QPOS].numpy()
        if TERRAIN in env.keys() and scene.terrain is not None:
            pose = scene.terrain.mocap_pose(env[TERRAIN][None])[0].numpy()
            data.mocap_pos[:] = pose[: data.mocap_pos.size].reshape(-1, 3)
            data.mocap_quat[:] = pose[data.mocap_pos.size :].reshape(-1, 4)
        mujoco.mj_fwdPosition(scene.model, data)
        counts.append(data.ncon)
    return fmean(counts)


def two_in_turn(one: Runner, other: Runner, rounds: int) -> tuple[float, float, float]:
    """Steps per second of both, and of the first to the second: medians over rounds."""
    samples = [(one.steps_per_s(), other.steps_per_s()) for _ in range(rounds)]
    first, second = (median(rates) for rates in zip(*samples, strict=True))
    return first, second, median(a / b for a, b in samples)


def measure(scene: Scene, batch: int, options: Options) -> Point:
    """One point of the curves."""
    state = mid_states(scene, batch, options.seed)
    model = NeRD(scene, NO_PREDICTIONS, network_config(options.network))
    learned = NeRDDynamics(model, compile=options.compile)
    true = MujocoDynamics(scene, num_threads=1)
    one, other = (Runner(stepper(x, state), time.process_time) for x in (learned, true))
    learned_rate, true_rate, ratio = two_in_turn(one, other, options.rounds)
    return Point(
        scene=scene.name,
        rows=batch,
        dofs=scene.model.nv,
        substeps=scene.substeps,
        points=len(scene.contacts),
        contacts=mean_contacts(scene, state),
        mujoco_us=1e6 / (batch * true_rate),
        learned_us=1e6 / (batch * learned_rate),
        ratio=ratio,
        state_bytes=8 * (scene.model.nq + scene.model.nv),
    )


def memory_table() -> dict[str, int]:
    """Bytes of history that one env adds, by preset: the same in every scene."""
    scene = load_scene("cartpole")
    networks = {
        name: NeRDDynamics(NeRD(scene, NO_PREDICTIONS, config)).network
        for name, config in NETWORKS.items()
    }
    return {name: memory_bytes(network) for name, network in networks.items()}


def main(options: Options) -> list[Point]:
    """Print and return all points.

    Raises:
        ValueError: a setting out of range, an unknown network or scene.
    """
    expect_at_least(
        1, rounds=options.rounds, **{f"batch {b}": b for b in options.batches}
    )
    torch.set_num_threads(1)
    print(
        f"{'scene':<26}{'rows':>6}{'dofs':>6}{'substeps':>10}{'points':>8}"
        f"{'contacts':>10}{'MuJoCo, us':>12}{f'{options.network}, us':>15}{'ratio':>7}"
    )
    points = []
    for name in options.scenes:
        for batch in options.batches:
            p = measure(load_scene(name), batch, options)
            points.append(p)
            sizes = f"{p.dofs:>6}{p.substeps:>10}{p.points:>8}{p.contacts:>10.1f}"
            times = f"{p.mujoco_us:>12.2f}{p.learned_us:>15.2f}{p.ratio:>7.2f}"
            print(f"{p.scene:<26}{p.rows:>6}{sizes}{times}", flush=True)
    memory = memory_table()
    print(
        "history of an env, bytes: " + ", ".join(f"{k} {v}" for k, v in memory.items())
    )
    if options.json is not None:
        results: dict[str, Any] = {"points": [asdict(p) for p in points]}
        asked = {"network": options.network, "compiled": options.compile}
        asked |= {"threads": 1, "memory_bytes": memory}
        write_results(options.json, asked | results, options.seed)
    return points


if __name__ == "__main__":
    main(tyro.cli(Options))
