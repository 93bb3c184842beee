"""Would a small ensemble's spread foretell large errors better than the trust gate does?

    python experiments/ensemble_trust.py double_pendulum double_pendulum-mlp ...

The first model is the one that is judged, all of them are the ensemble: networks of other
kinds and seeds, trained on the same motion. Its spread is the deviation of their next
velocities from their mean, in the first one's units, and its price a step of each. Inputs
and errors are those of `nerd stability SCENE --cases out_of_distribution`.
"""

from dataclasses import dataclass
from typing import cast

import torch
import tyro
from scipy.stats import mannwhitneyu
from tensordict import TensorDict
from torch import Generator, Tensor
from tyro.conf import Positional

from torchrl_nerd.checkpoint import from_pretrained
from torchrl_nerd.dynamics import MujocoDynamics, NeRDDynamics
from torchrl_nerd.evaluation.stability.cases.ood import inputs
from torchrl_nerd.keys import JOINT_TORQUE, QPOS, QVEL, TERRAIN
from torchrl_nerd.modules.nerd import TARGET, NeRD
from torchrl_nerd.robots import load_scene


@dataclass
class Options:
    """Which models, over which robot."""

    scene: Positional[str]
    models: Positional[tuple[str, ...]]
    """Shipped ones or folders; the first is judged."""
    seed: int = 0


def spread(models: list[NeRD], data: TensorDict) -> Tensor:
    """Root mean square over models and directions, ``(rows,)``."""
    state, nv = data.select(QPOS, QVEL), data[QVEL].shape[-1]
    ahead = torch.stack(
        [
            NeRDDynamics(model).step(
                state, data[JOINT_TORQUE], data.get(TERRAIN, None)
            )[QVEL]
            for model in models
        ]
    )
    off = (ahead - ahead.mean(0)) / models[0].normalize.std(TARGET)[:nv]
    return off.square().mean((0, 2)).sqrt()


def scores(model: NeRD, data: TensorDict, **others: Tensor) -> dict[str, Tensor]:
    """Scores of inputs, and the normalised one-step errors that they should predict.

    Where MuJoCo loses the state the entry is left out, of ``others (n,)`` too.
    """
    data = data.to(model.device)
    terrain, torque = data.get(TERRAIN, None), data[JOINT_TORQUE]
    now = data[QPOS], data[QVEL]
    after = MujocoDynamics(model.scene).step(data, torque, terrain)
    is_valid = torch.all(after[QVEL].isfinite(), -1)
    target = model.state_delta.delta(*now, after[QPOS], after[QVEL])
    with torch.no_grad():
        features, token, base, gate = model.encode(*now, torque, terrain)
        output = model.network.step(token, model.network.empty_memory(len(token)))
    change = base + gate * output.double()
    error = change - model.normalize.normalize(TARGET, target)
    found = {
        "error": error.square().mean(-1).sqrt(),
        "distance": model.ood_score(features),
        "mahalanobis": model.ood.mahalanobis(features),
        "excess": model.training_range.excess(features),
        **others,
    }
    return {name: score[is_valid].cpu() for name, score in found.items()}


def auc(score: Tensor, is_large: Tensor) -> float:
    """Area under the ROC curve: fraction of pairs of errors that the score orders.

    A tie counts as half a pair, as in Mann and Whitney's statistic.
    """
    large, small = (score[rows].numpy() for rows in (is_large, ~is_large))
    if not len(large) or not len(small):
        return float("nan")
    return float(mannwhitneyu(large, small).statistic / (len(large) * len(small)))


def main(options: Options) -> None:
    """Print the areas under the ROC curve."""
    scene = load_scene(options.scene)
    models = [cast(NeRD, from_pretrained(name, scene)) for name in options.models]
    generator = Generator().manual_seed(options.seed)
    inside, _, outside = inputs(scene, generator)
    data = cast(TensorDict, torch.cat((inside, outside)))
    found = scores(models[0], data, spread=spread(models, data))
    likely = scores(models[0], inside)["error"]
    is_large = found["error"] > torch.quantile(likely, 0.99)
    print(
        f"{int(is_large.sum())} large errors of {len(is_large)}; area under the ROC of"
    )
    for name in ("distance", "mahalanobis", "excess", "spread"):
        print(f"  {name:<12} {auc(found[name], is_large):.3f}")


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
