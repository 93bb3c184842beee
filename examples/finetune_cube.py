"""Fine-tune a model of a simulated cube on measured tosses, and look at one toss.

    python examples/finetune_cube.py --from cube_tosses.npz --out runs/cube_tosses

writes a checkpoint, the table of docs/real_data.md for the validation tosses (``--part
test`` once all choices are made) and ``toss.png``: one toss measured, in MuJoCo, as
pretrained and as fine-tuned. ``--no-train`` uses the shipped models.
"""

import argparse
from pathlib import Path

import torch

from torchrl_nerd import from_pretrained, load_scene
from torchrl_nerd.configs import FinetuneConfig
from torchrl_nerd.data.recorded import SHIPPED, load_tosses
from torchrl_nerd.dynamics import NeRDDynamics
from torchrl_nerd.dynamics.base import Dynamics
from torchrl_nerd.evaluation.rollout_error import open_loop
from torchrl_nerd.evaluation.toss_error import STATES, first_state
from torchrl_nerd.evaluation.toss_plot import plot_toss
from torchrl_nerd.evaluation.toss_table import compare, mujoco_baselines, toss_table
from torchrl_nerd.files import write_json
from torchrl_nerd.training.finetune_run import PRETRAINED_NAME, finetune


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--from", dest="recorded", type=Path, required=True)
    parser.add_argument("--out", type=Path, default=Path("runs/cube_tosses"))
    parser.add_argument("--part", default="validation", choices=("validation", "test"))
    parser.add_argument("--toss", type=int, default=0, help="of that part, to plot")
    parser.add_argument("--no-train", action="store_true", help="the shipped models")
    args = parser.parse_args()
    scene = load_scene("cube_real")
    tosses, split = load_tosses(args.recorded, scene)
    if not args.no_train:
        finetune(scene, args.recorded, args.out, FinetuneConfig())
    folder = SHIPPED if args.no_train else args.out
    models: dict[str, Dynamics] = mujoco_baselines(scene)
    models["pretrained"] = NeRDDynamics(from_pretrained(PRETRAINED_NAME))
    models["fine-tuned"] = NeRDDynamics(from_pretrained(folder))
    starts = tosses.starts(STATES, split[args.part])
    table = compare(models, tosses, starts)
    print(toss_table(table))
    write_json(args.out / f"{args.part}.json", table)
    window = tosses.windows(tosses.offsets[split[args.part][args.toss], None], STATES)
    start = first_state(window)
    paths = {
        name: torch.cat((start["qpos"], open_loop(model, start, STATES - 1)[0]))
        for name, model in models.items()
        if name != "MuJoCo, published"
    }
    plot = args.out / "toss.png"
    plot_toss(window["qpos"][0], paths, scene.control_step, plot)
    print(f"one toss in {plot}")


if __name__ == "__main__":
    main()
