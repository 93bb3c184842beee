"""Where fine-tuning on tosses starts: a pretrained model, or one that knows nothing."""

import torch
from tensordict.utils import NestedKey

from torchrl_nerd.analytic import FreeBodyPenaltyStep
from torchrl_nerd.configs import NO_PREDICTIONS, FinetuneConfig
from torchrl_nerd.data.cube_tosses import Tosses
from torchrl_nerd.evaluation.system_identification import PUBLISHED
from torchrl_nerd.keys import NEXT_QPOS, NEXT_QVEL, QPOS, QVEL
from torchrl_nerd.modules.features import SceneFeatures
from torchrl_nerd.modules.hybrid import HybridNeRD
from torchrl_nerd.modules.nerd import TARGET, TOKEN, NeRD
from torchrl_nerd.modules.networks import network_config
from torchrl_nerd.robots.cube.scene import HALF
from torchrl_nerd.scenes import Scene
from torchrl_nerd.training.finetune import FineTuner
from torchrl_nerd.training.sequences import cover
from torchrl_nerd.training.simulated_tosses import simulate_tosses
from torchrl_nerd.transforms import StateDelta, Stats

CUBES, TOSSES, STATES = 50, 20, 100  # simulated cubes, tosses of each, states of a toss
CHECKED = 50  # simulated tosses that validate
PRETRAINING = FinetuneConfig(
    update="all",
    epochs=0.4,
    sequence_length=12,
    short_history_fraction=0.0,
    physics_lr=0.0,
    validate_every=30,
    use_symmetry=True,
)


def toss_stats(scene: Scene, tosses: Tosses) -> dict[NestedKey, Stats]:
    """Statistics of tokens and targets over all transitions."""
    data = tosses.transitions()
    idle = data["next", "joint_torque"]
    tokens = SceneFeatures(scene)(data[QPOS], data[QVEL], idle, None)
    state = (data[key] for key in (QPOS, QVEL, NEXT_QPOS, NEXT_QVEL))
    return {TOKEN: Stats.of(tokens), TARGET: Stats.of(StateDelta(scene).delta(*state))}


def pretrain(
    scene: Scene,
    config: FinetuneConfig = PRETRAINING,
    quiet: bool = False,
    device: torch.device | str = "cpu",
) -> tuple[NeRD, FineTuner]:
    """A residual model that has seen tosses of many cubes in MuJoCo, and no real one.

    Its simulator has the published parameters; statistics are of the simulated tosses.

    Args:
        scene: of the cube.
        config: of the training on simulated tosses.
        quiet: no progress bar.
        device: of the model.
    """
    tosses = simulate_tosses(scene, CUBES, TOSSES, STATES, config.seed)
    torch.manual_seed(config.seed)
    model = _hybrid(scene, toss_stats(scene, tosses))
    cover(model, tosses.transitions())
    published = {**PUBLISHED, "inertia": 1.0, "size": PUBLISHED["size"] / HALF}
    model.analytic_step.set_values(published)
    number = torch.arange(len(tosses))
    parts = number[CHECKED:], number[:CHECKED]
    tuner = FineTuner(model.to(device), tosses, *parts, config, quiet)
    return tuner.run(), tuner


def from_scratch(scene: Scene, tosses: Tosses, network: str, seed: int) -> NeRD:
    """Fresh weights, and statistics of the training tosses.

    Args:
        scene: of the cube.
        tosses: to train on.
        network: ``"residual"``, or a name in `NETWORKS`: no simulator.
        seed: of the weights.
    """
    torch.manual_seed(seed)
    stats = toss_stats(scene, tosses)
    if network == "residual":
        model: NeRD = _hybrid(scene, stats)
    else:
        model = NeRD(scene, NO_PREDICTIONS, network_config(network), stats)
    cover(model, tosses.transitions())
    return model


def _hybrid(scene: Scene, stats: dict[NestedKey, Stats]) -> HybridNeRD:
    step = FreeBodyPenaltyStep(scene)
    return HybridNeRD(scene, step, NO_PREDICTIONS, network_config("mlp-2x64"), stats)
