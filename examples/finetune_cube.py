"""Fine-tune on a recorded log, and measure before and after on trajectories held out.

    python examples/finetune_cube.py --log cube_tosses.npz

Without ``--model`` twelve physical parameters of an analytic step are fitted. With it
(a name or folder) a network's weights follow the gradient of its rollouts. ``--scene``
is any robot; docs/howto/logs.md says what a log holds.
"""

import argparse
from pathlib import Path

from torchrl_nerd.configs import FinetuneConfig
from torchrl_nerd.data.log_files import load_recording
from torchrl_nerd.dynamics import dynamics_of
from torchrl_nerd.evaluation.recorded_error import STATES, compare, errors_as_text
from torchrl_nerd.robots import load_scene
from torchrl_nerd.training.finetune import FineTuner, start_model


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--log", type=Path, required=True, help="npz or CSV")
    parser.add_argument("--scene", default="cube_real", help="the recorded robot")
    parser.add_argument("--model", help="where to start: a shipped model or a folder")
    parser.add_argument("--evaluations", type=int, default=90, help="of parameters")
    parser.add_argument("--epochs", type=float, default=2.0, help="of weights")
    args = parser.parse_args()
    scene = load_scene(args.scene)
    recording, split = load_recording(args.log, scene)
    start = start_model(scene, args.model)
    config = FinetuneConfig(evaluations=args.evaluations, epochs=args.epochs)
    tuner = FineTuner(start, recording, split["train"], split["validation"], config)
    best = tuner.run()
    models = {"before": dynamics_of(start), "after": dynamics_of(best)}
    starts = recording.starts(STATES, split["test"])
    print(errors_as_text(compare(models, scene, recording, starts), {}))


if __name__ == "__main__":
    main()
