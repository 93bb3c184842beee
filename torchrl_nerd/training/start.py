"""The model that a training begins with: fresh, or another one's weights."""

import hashlib
from collections.abc import Mapping
from dataclasses import replace

from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import nn

from torchrl_nerd.analytic import STEPS, make_step
from torchrl_nerd.configs import TrainConfig
from torchrl_nerd.dynamics.base import as_numpy
from torchrl_nerd.keys import NEXT_QVEL, QPOS
from torchrl_nerd.modules.equivariant import EquivariantNetwork
from torchrl_nerd.modules.hybrid import HybridNeRD
from torchrl_nerd.modules.nerd import NeRD
from torchrl_nerd.modules.networks import NETWORKS, network_config
from torchrl_nerd.scenes import Scene
from torchrl_nerd.settings import look_up
from torchrl_nerd.training.symmetry import Symmetry
from torchrl_nerd.transforms import Stats


def make_model(
    scene: Scene,
    config: TrainConfig,
    stats: Mapping[NestedKey, Stats] | None = None,
    symmetry: Symmetry | None = None,
) -> NeRD:
    """The model that a configuration describes, with random weights.

    ``symmetry``: that of the robot, whose copies the network is to know.

    Raises:
        ValueError: no such network or step, a scene that the step cannot move, or a robot
            without so many symmetric copies.
    """
    network, features = network_config(config.network), config.features
    network = replace(network, copies=config.copies)
    if config.step is None:
        return _with_group(NeRD(scene, features, network, stats), symmetry)
    step = make_step(scene, look_up("analytic step", config.step, STEPS))
    return HybridNeRD(scene, step, features, network, stats)


def begin_from(
    start: NeRD, scene: Scene, config: TrainConfig, symmetry: Symmetry | None = None
) -> NeRD:
    """A model with weights and statistics of another one, which is left as it is.

    It may average over more or fewer symmetric copies. What the network's inputs mean,
    their statistics, is part of what it learned, and so is a hybrid's gate. The training
    range is left to be fitted.

    Raises:
        ValueError: in one sentence, a configuration of another network, kind or step,
            inputs of another width, or statistics that symmetric copies do not share.
    """
    known = replace(start.config, copies=1)
    if known != network_config(config.network):
        names = [name for name, network in NETWORKS.items() if network == known]
        name = " or ".join(names) or known
        raise ValueError(
            f"expected the network of the model to start from, {name}, "
            f"got {config.network}"
        )
    model = make_model(scene, config, symmetry=symmetry)
    if type(model) is not type(start):
        raise ValueError(
            f"expected a {model.kind} model to start from, got a {start.kind} one"
        )
    widths, found = ((m.token_size, m.state_delta.size) for m in (model, start))
    if widths != found:
        raise ValueError(
            f"expected a model to start from with {widths[0]} inputs and {widths[1]} "
            f"outputs as scene '{scene.name}' has, got {found[0]} and {found[1]}"
        )
    if isinstance(model, HybridNeRD) and isinstance(start, HybridNeRD):
        model.is_gated = start.is_gated
    single, learned = (_single(x.network) for x in (model, start))
    single.load_state_dict(learned.state_dict())
    model.normalize.load_state_dict(start.normalize.state_dict())
    if symmetry is not None:
        _expect_shared(symmetry, model)
    return model


def with_copies(model: NeRD, count: int) -> NeRD:
    """The same weights, averaged over so many symmetric copies of the robot.

    A group of symmetries has such a size: 2, 4 or 8 of the Ant. The network then takes
    ``count`` times as long; see `EquivariantNetwork`.

    Raises:
        ValueError: a robot without such symmetries, a hybrid, or a model that was trained
            without ``use_symmetry``.
    """
    if model.kind != "learned":
        raise ValueError(f"expected a learned model for copies, got a {model.kind} one")
    features = model.scene_features.config
    symmetry = Symmetry(model.scene, features)
    _expect_shared(symmetry, model)
    twin = NeRD(model.scene, features, replace(model.config, copies=count))
    _single(twin.network).load_state_dict(_single(model.network).state_dict())
    for name in ("normalize", "training_range", "ood", "sleep"):
        getattr(twin, name).load_state_dict(getattr(model, name).state_dict())
    twin.reference_ratio = model.reference_ratio
    return _with_group(twin, symmetry).to(model.device).train(model.training)


def _with_group(model: NeRD, symmetry: Symmetry | None) -> NeRD:
    """The model, whose network knows its symmetric copies; see `Symmetry.group`."""
    if symmetry is not None and isinstance(model.network, EquivariantNetwork):
        model.network.set_copies(*symmetry.group(model.network.copies))
    return model


def _expect_shared(symmetry: Symmetry, model: NeRD) -> None:
    """Refuse a model whose statistics symmetric copies of its samples do not share."""
    if not symmetry.keeps(model.normalize):
        raise ValueError(
            "expected a model to start from that was trained with use_symmetry, got one "
            "whose statistics they change: train without use_symmetry and copies"
        )


def find_symmetry(scene: Scene, config: TrainConfig) -> Symmetry | None:
    """The robot's symmetries, where data or network are to have them; see `Symmetry`."""
    if not config.use_symmetry and config.copies == 1:
        return None
    return Symmetry(scene, config.features)


def _single(network: nn.Module) -> nn.Module:
    """The network that sees one symmetric copy at a time."""
    return network.network if isinstance(network, EquivariantNetwork) else network


def fingerprint(model: NeRD) -> str:
    """Hash of weights, statistics and range, by which a run knows its start."""
    digest = hashlib.sha256()
    for key, value in sorted(model.state_dict().items()):
        digest.update(key.encode() + value.cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()[:16]


def data_fingerprint(data: TensorDictBase) -> str:
    """Hash of how trajectories ``[n, T]`` begin and end: a run knows its data by it."""
    digest = hashlib.sha256(str(list(data.batch_size)).encode())
    for values in (data[QPOS][:, 0], data[NEXT_QVEL][:, -1]):
        digest.update(as_numpy(values).tobytes())
    return digest.hexdigest()[:16]
