"""The model that a training begins with: fresh, or with all that another one learned."""

import hashlib

from tensordict import TensorDict

from torchrl_nerd.checkpoint import make_model
from torchrl_nerd.modules.correction import GroundedConfig
from torchrl_nerd.modules.nerd import Config, NeRD
from torchrl_nerd.modules.networks import NETWORKS, STEPS, network_config
from torchrl_nerd.scenes import Scene
from torchrl_nerd.training.sequences import Symmetry, data_stats


def fresh_model(
    scene: Scene, data: TensorDict, network: str, symmetry: Symmetry | None
) -> NeRD:
    """A model that has learned nothing, with the statistics of its data.

    Args:
        scene: the robot.
        data: transitions, ``[trajectories, steps]``.
        network: name in `NETWORKS`.
        symmetry: whose images count as data too.
    """
    config = network_config(network)
    scene = seen_by(config, scene)
    stats = data_stats(scene, data)
    if symmetry is not None:
        stats = symmetry.complete(stats)
    return make_model(scene, config, stats)


def seen_by(config: Config, scene: Scene) -> Scene:
    """The scene with the features that such a network is shown.

    What its springs push with, and where, a `GroundStep` finds out by itself.
    """
    return scene.foreseeing(False) if isinstance(config, GroundedConfig) else scene


def begin_from(
    start: NeRD, scene: Scene, network: str, symmetry: Symmetry | None = None
) -> NeRD:
    """A model with weights and statistics of another one, for the scene as it is given.

    The statistics stay as they are: what the network's inputs mean is part of what it
    learned. Features may have other values, as where forces are foreseen in another way,
    but not another width. What the data cover is left to be found.

    Args:
        start: whose weights; left as it is.
        scene: the robot.
        network: name in `NETWORKS`, which must be that of ``start``.
        symmetry: images of samples that will be shown.

    Raises:
        ValueError: in one sentence, another network, features of another width, or
            statistics that the images do not share.
    """
    config = network_config(network)
    if start.config != config:
        names = [
            name for name, known in (NETWORKS | STEPS).items() if known == start.config
        ]
        raise ValueError(
            f"expected the network of the model to start from, "
            f"{' or '.join(names) or start.config}, got {network}"
        )
    model = make_model(seen_by(config, scene), config)
    widths, found = ((m.tokens.size, m.state_delta.size) for m in (model, start))
    if widths != found:
        raise ValueError(
            f"expected a model to start from with {widths[0]} features and "
            f"{widths[1]} outputs as scene '{scene.name}' has, got {found[0]} and "
            f"{found[1]}"
        )
    model.network.load_state_dict(start.network.state_dict())
    model.normalize.load_state_dict(start.normalize.state_dict())
    if symmetry is not None and not symmetry.keeps(model.normalize):
        raise ValueError(
            "expected a model to start from that was trained on symmetry images, got "
            "one whose statistics they change: train without use_symmetry"
        )
    return model


def fingerprint(model: NeRD) -> str:
    """Hash of weights, statistics and coverage, by which a run knows its start."""
    digest = hashlib.sha256()
    for key, value in sorted(model.state_dict().items()):
        digest.update(key.encode() + value.cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()[:16]
