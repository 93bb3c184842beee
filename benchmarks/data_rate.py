"""How fast training data are made, against bare `mujoco.rollout` on the same threads.

    python benchmarks/data_rate.py cartpole

The same starts, grounds and torques; both in turns, so that a busy machine slows both.
"""

import os
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from statistics import median

import mujoco
import mujoco.rollout
import numpy as np
import tyro
from tyro.conf import Positional

from torchrl_nerd.configs import DataConfig
from torchrl_nerd.data.generate import generate
from torchrl_nerd.dynamics.mujoco import engine_model
from torchrl_nerd.evaluation.results import write_results
from torchrl_nerd.robots import load_scene
from torchrl_nerd.scenes import Scene
from torchrl_nerd.scenes.sampling import sample_commands
from torchrl_nerd.seeds import fold_in
from torchrl_nerd.settings import expect_at_least

CONTROL = int(  # applied force, and where the ground is
    mujoco.mjtState.mjSTATE_QFRC_APPLIED
    | mujoco.mjtState.mjSTATE_MOCAP_POS
    | mujoco.mjtState.mjSTATE_MOCAP_QUAT
)


@dataclass
class Options:
    """What to generate, and how often."""

    scene: Positional[str] = "cartpole"
    trajectories: int = 2048
    steps: int = 50
    rounds: int = 7
    """The first is not counted."""
    seed: int = 0
    json: Path | None = None
    """Write the results to this file."""


def seconds_of_rollout(
    scene: Scene, trajectories: int, steps: int, seed: int, threads: int
) -> float:
    """One bare call of MuJoCo."""
    generator = fold_in(seed, 0)  # as the first chunk of a data set
    start, scale = scene.sample_initial(trajectories, generator)
    model = engine_model(scene, has_actuators=False)
    data = [mujoco.MjData(model) for _ in range(threads)]
    state = np.concatenate(
        (np.zeros((trajectories, 1)), start["qpos"].numpy(), start["qvel"].numpy()), -1
    )
    torque = sample_commands(scene.sampling, scale, steps, generator)
    control = np.zeros((trajectories, steps, mujoco.mj_stateSize(model, CONTROL)))
    control[:, :, scene.actuated] = torque.numpy()
    if scene.terrain is not None and "terrain" in start:
        pose = scene.terrain.mocap_pose(start["terrain"]).numpy()
        control[:, :, model.nv :] = pose[:, None]
    control = np.repeat(control, scene.substeps, 1)
    with mujoco.rollout.Rollout(nthread=threads) as pool:
        began = time.perf_counter()
        pool.rollout(model, data, state, control, control_spec=CONTROL)
        return time.perf_counter() - began


def seconds_of_generate(
    scene: Scene, trajectories: int, steps: int, seed: int
) -> float:
    """What `nerd data` does, on disk."""
    config = DataConfig(trajectories=trajectories, steps=steps, seed=seed)
    with tempfile.TemporaryDirectory() as folder:
        began = time.perf_counter()
        generate(scene, config, Path(folder), quiet=True)
        return time.perf_counter() - began


def main(options: Options) -> float:
    """Print both rates and return their ratio, the median over rounds."""
    expect_at_least(2, rounds=options.rounds)  # the first one does not count
    scene, threads = load_scene(options.scene), os.cpu_count() or 1
    bare, whole = [], []
    for index in range(options.rounds):
        draw = options.trajectories, options.steps, options.seed + index
        bare.append(seconds_of_rollout(scene, *draw, threads))
        whole.append(seconds_of_generate(scene, *draw))
    count = options.trajectories * options.steps
    rates = [count / median(seconds[1:]) for seconds in (bare, whole)]
    ratio = rates[1] / rates[0]
    print(
        f"{scene.name}, {threads} threads, transitions/s: mujoco.rollout {rates[0]:.0f}, "
        f"nerd data {rates[1]:.0f}, {ratio:.0%}"
    )
    if options.json is not None:
        names = ("rollout_per_s", "data_per_s", "ratio")
        results = dict(zip(names, (*rates, ratio), strict=True))
        results |= {"scene": scene.name, "threads": threads}
        write_results(options.json, results, options.seed)
    return ratio


if __name__ == "__main__":
    main(tyro.cli(Options))
