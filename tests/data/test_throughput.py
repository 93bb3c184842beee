"""Generating data costs little beyond the physics itself."""

import os
import statistics
import time
from pathlib import Path

import mujoco
import mujoco.rollout
import numpy as np
import pytest
from torch import Generator

from torchrl_nerd.data.generate import DataConfig, generate
from torchrl_nerd.dynamics.mujoco import CONTROL, torque_model
from torchrl_nerd.scenes import Scene
from torchrl_nerd.scenes.sampling import sample_torque

ROWS, STEPS, ROUNDS = 2048, 50, 7


def seconds_of_rollout(scene: Scene, seed: int, threads: int) -> float:
    """The same starts, grounds and torques through one bare call of MuJoCo."""
    generator = Generator().manual_seed(seed)
    start, scale = scene.sample_initial(ROWS, generator)
    model = torque_model(scene)
    data = [mujoco.MjData(model) for _ in range(threads)]
    state = np.concatenate(
        (np.zeros((ROWS, 1)), start["qpos"].numpy(), start["qvel"].numpy()), -1
    )
    torque = sample_torque(scene.sampling, scale, STEPS, generator)
    size = mujoco.mj_stateSize(model, int(CONTROL))
    control = np.zeros((ROWS, STEPS, size))
    control[:, :, scene.actuated] = torque.numpy()
    if "terrain" in start:
        pose = scene.terrain.mocap_pose(start["terrain"]).numpy()
        control[:, :, model.nv :] = pose[:, None]
    control = np.repeat(control, scene.substeps, 1)
    with mujoco.rollout.Rollout(nthread=threads) as pool:
        began = time.perf_counter()
        pool.rollout(model, data, state, control, control_spec=int(CONTROL))
        return time.perf_counter() - began


def seconds_of_generate(scene: Scene, seed: int, folder: Path) -> float:
    config = DataConfig(trajectories=ROWS, steps=STEPS, seed=seed)
    began = time.perf_counter()
    generate(scene, config, folder, quiet=True)
    return time.perf_counter() - began


@pytest.mark.slow
def test_at_least_four_fifths_of_bare_rollout(scene, tmp_path, seed):
    bare, whole = [], []
    threads = os.cpu_count() or 1
    for index in range(ROUNDS):  # in turns, so that a busy machine slows both
        bare.append(seconds_of_rollout(scene, seed + index, threads))
        whole.append(seconds_of_generate(scene, seed + index, tmp_path / str(index)))
    ratio = statistics.median(bare[1:]) / statistics.median(whole[1:])
    assert ratio >= 0.8, f"bare {bare} s, generate {whole} s"
