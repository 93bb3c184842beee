"""Train a plain NeRD on recorded tosses, from scratch or after simulated ones.

    python experiments/measured_cube/from_scratch.py --data cube_tosses.npz --out runs/a
    python experiments/measured_cube/from_scratch.py --pretrain --out runs/b
    nerd finetune cube --from cube_tosses.npz --model runs/b --update all

Without ``--pretrain`` the tosses are the recorded ones. With it they are simulated: many
cubes in MuJoCo whose friction, stiffness, damping, size, inertia and gravity differ, so
that what is learned holds for a cube that nobody has measured.
"""

import argparse
from pathlib import Path

import torch
from mujoco_cube import PUBLISHED, cube_with
from tensordict import TensorDict
from torch import Generator

from torchrl_nerd import load_scene
from torchrl_nerd.checkpoint import make_card, save_checkpoint
from torchrl_nerd.configs import NO_PREDICTIONS, FinetuneConfig
from torchrl_nerd.data.log_files import load_recording
from torchrl_nerd.data.recorded import Recording
from torchrl_nerd.dynamics import MujocoDynamics
from torchrl_nerd.evaluation.results import write_results
from torchrl_nerd.modules.nerd import NeRD
from torchrl_nerd.modules.networks import network_config
from torchrl_nerd.scenes import Scene
from torchrl_nerd.training.finetune import FineTuner
from torchrl_nerd.training.samples import cover, data_stats

SCRATCH = FinetuneConfig(update="all", epochs=40, patience=16)
CUBES, TOSSES, STATES, CHECKED = 50, 20, 100, 50
SPREAD = {
    "gravity": 0.03,
    "size": 0.03,
    "inertia": 0.2,
    "friction": 0.3,
    "stiffness": 0.5,
    "damping": 0.5,
    "slip": 0.5,
}
"""Half ranges of the logarithms of `mujoco_cube.PUBLISHED`."""


def fresh_model(scene: Scene, tosses: Recording, network: str, seed: int = 0) -> NeRD:
    """Fresh weights, and statistics of the tosses."""
    torch.manual_seed(seed)
    data = tosses.transitions()[:, None]
    model = NeRD(
        scene, NO_PREDICTIONS, network_config(network), data_stats(scene, data)
    )
    cover(model, data)
    return model


def simulate_tosses(
    scene: Scene, cubes: int, tosses: int, states: int, seed: int = 0
) -> Recording:
    """Tosses in MuJoCo from the scene's training ranges.

    Args:
        scene: of the published cube.
        cubes: how many different ones.
        tosses: of each.
        states: of each toss.
        seed: of cubes and initial states.
    """
    generator = Generator().manual_seed(seed)
    qpos, qvel = [], []
    for _ in range(cubes):
        draw = 2.0 * torch.rand(len(SPREAD), generator=generator).double() - 1.0
        factors = (draw * torch.tensor(list(SPREAD.values())).double()).exp().tolist()
        drawn = dict(zip(SPREAD, factors, strict=True))
        scaled = {key: PUBLISHED[key] * factor for key, factor in drawn.items()}
        cube = cube_with(scene, {**PUBLISHED, **scaled})
        start = TensorDict(cube.sample_initial(tosses, generator)[0], [tosses])
        dynamics = MujocoDynamics(cube, num_threads=1)
        dynamics.reset(start)
        idle = torch.zeros(tosses, states - 1, 0, dtype=torch.float64)
        path = dynamics.rollout(start, idle)
        for parts, key in ((qpos, "qpos"), (qvel, "qvel")):
            parts.append(torch.cat((start[key][:, None], path[key]), 1))
    offsets = states * torch.arange(cubes * tosses + 1)
    q, v = (torch.cat(parts).flatten(0, 1) for parts in (qpos, qvel))
    return Recording(q, v, q[:, :0], offsets, scene.control_step)


def main() -> None:
    """Train and write the best model on the validation tosses."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, help="recorded tosses")
    parser.add_argument("--pretrain", action="store_true", help="on simulated tosses")
    parser.add_argument("--network", default="mlp-4x128")
    parser.add_argument("--epochs", type=float, default=SCRATCH.epochs)
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    scene = load_scene("cube_real")
    if args.pretrain:
        tosses = simulate_tosses(scene, CUBES, TOSSES, STATES)
        number = torch.arange(len(tosses))
        train, validation = number[CHECKED:], number[:CHECKED]
    elif args.data:
        tosses, split = load_recording(args.data, scene)
        train, validation = split["train"], split["validation"]
    else:
        parser.error("expected --data FILE or --pretrain, got neither")
    model = fresh_model(scene, tosses.select(train), args.network)
    config = FinetuneConfig(update="all", epochs=args.epochs, patience=SCRATCH.patience)
    tuner = FineTuner(model, tosses, train, validation, config)
    best = tuner.run()
    save_checkpoint(best, args.out, make_card(best, tuner.card()))
    write_results(args.out / "curve.json", {"curve": tuner.curve})
    print(tuner.card()["finetuning"])


if __name__ == "__main__":
    main()
