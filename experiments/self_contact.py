"""Features of a robot's contacts with itself: what they bring.

    python experiments/self_contact.py --json results/self_contact.json

The same network is trained on the same data from the same seeds, with and without
`SelfContactFeatures`. Errors are of held-out trajectories, apart for those in which the
robot touches itself and for the others: of one step, mean over the dofs of ``qvel``; of
twenty steps, mean of the positions over time, in m and rad.
"""

import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import torch
import tyro
from tensordict import TensorDict
from torch import Generator, Tensor

from torchrl_nerd.configs import TrainConfig
from torchrl_nerd.data.simulate import is_sound, simulate
from torchrl_nerd.dynamics import NeRDDynamics
from torchrl_nerd.evaluation.position_error import position_errors, unit_of
from torchrl_nerd.evaluation.results import write_results
from torchrl_nerd.evaluation.rollout_error import open_loop
from torchrl_nerd.keys import CTRL, JOINT_TORQUE, NEXT_QPOS, NEXT_QVEL, QPOS, QVEL
from torchrl_nerd.robots import load_scene
from torchrl_nerd.scenes import Scene
from torchrl_nerd.scenes.contact_points import own_contacts
from torchrl_nerd.scenes.penetration import touching_bodies
from torchrl_nerd.training.trainer import Trainer

DATA_SEED, TEST_SEED = 1, 77
STEPS, HORIZON = (
    50,
    20,
)  # control steps of a trajectory, and of those that are predicted


@dataclass
class Options:
    """What to train."""

    scenes: tuple[str, ...] = ("dm_control/hopper-hop", "gymnasium/Humanoid-v5")
    network: str = "mlp-4x128"
    seeds: tuple[int, ...] = (0,)
    trajectories: int = 4000
    tests: int = 300
    updates: int = 1500
    """Of 1,024 states each."""
    json: Path | None = None
    """Write the results to this file."""


def draw(scene: Scene, rows: int, seed: int) -> TensorDict:
    """Sound random trajectories of a seed, ``[rows, STEPS]``."""
    data = simulate(scene, rows, STEPS, Generator().manual_seed(seed))
    return cast(TensorDict, data[is_sound(data)])


def touches_itself(scene: Scene, data: TensorDict) -> Tensor:
    """Whether own bodies touch before or after each step, ``[rows, STEPS]``, bool."""
    bodies = scene.model.geom_bodyid[own_contacts(scene.model)]
    own = {tuple(sorted(pair)) for pair in bodies.tolist()}
    before, after = (
        torch.tensor(
            [not own.isdisjoint(x) for x in touching_bodies(scene.model, states)]
        )
        for states in (data[key].flatten(0, 1) for key in (QPOS, NEXT_QPOS))
    )
    return (before | after).unflatten(0, data.batch_size)


def train(scene: Scene, data: TensorDict, config: TrainConfig) -> NeRDDynamics:
    """A network trained on the data."""
    with tempfile.TemporaryDirectory() as folder:
        where = Path(folder)
        how = {"horizons": (2,), "logger": "csv", "quiet": True}
        return NeRDDynamics(Trainer(scene, data, scene, config, where, **how).run())


def errors(
    dynamics: NeRDDynamics, test: TensorDict, touches: Tensor
) -> dict[str, float]:
    """Errors of one step and of twenty, of trajectories that touch and that do not."""
    scene, found = dynamics.scene, {}
    flat, is_touching = cast(TensorDict, test.flatten(0, 1)), touches.flatten()
    state = cast(TensorDict, flat.select(QPOS, QVEL))
    dynamics.reset(state)
    after = dynamics.step(state, flat[JOINT_TORQUE], ctrl=flat.get(CTRL, None))
    one_step = (after[QVEL] - flat[NEXT_QVEL]).abs().mean(-1)
    start = cast(TensorDict, test.select(QPOS, QVEL)[:, 0])
    command = cast(Tensor, test.get(CTRL, test[JOINT_TORQUE]))[:, :HORIZON]
    path = open_loop(dynamics, start, HORIZON, command)
    far = position_errors(scene, test[NEXT_QPOS][:, :HORIZON], path)
    rows = touches[:, :HORIZON].any(1)
    for name, steps, paths in (
        ("touching", is_touching, rows),
        ("other", ~is_touching, ~rows),
    ):
        found[f"qvel_1_{name}"] = float(one_step[steps].mean())
        for unit in ("m", "rad"):
            alike = [
                e[paths].mean() for k, e in far.items() if unit_of(scene, k) == unit
            ]
            if alike:
                found[f"{unit}_{HORIZON}_{name}"] = float(torch.stack(alike).mean())
    return found


def main() -> None:
    """Train with the features and without, on every scene and from every seed."""
    options = tyro.cli(Options)
    torch.set_num_threads(1)
    results: list[dict[str, Any]] = []
    for name in options.scenes:
        scene = load_scene(name)
        data = draw(scene, options.trajectories, DATA_SEED)
        test = draw(scene, options.tests, TEST_SEED)
        touches = touches_itself(scene, test)
        for seed, has_features in (
            (s, f) for s in options.seeds for f in (False, True)
        ):
            config = TrainConfig(
                network=options.network,
                self_contact=has_features,
                steps=options.updates,
                rollout_steps=0,
                single_step_fraction=1.0,
                loss_eps=0.02,
                seed=seed,
                save_every=10**6,
                validate_every=10**6,
            )
            began = time.process_time()
            dynamics = train(scene, data, config)
            results.append(
                {
                    "scene": name,
                    "self_contact": has_features,
                    "seed": seed,
                    "features": dynamics.model.scene_features.size,
                    "touching_share": round(float(touches.double().mean()), 4),
                    "train_seconds": round(time.process_time() - began, 1),
                    **errors(dynamics, test, touches),
                }
            )
            print(results[-1], flush=True)
    if options.json is not None:
        write_results(options.json, results, list(options.seeds))


if __name__ == "__main__":
    main()
