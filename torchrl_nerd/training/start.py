"""The model that a training begins with: fresh, or another one's weights."""

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch.nn import functional as F

from torchrl_nerd.analytic import STEPS, make_step
from torchrl_nerd.configs import TrainConfig
from torchrl_nerd.dynamics.base import as_numpy
from torchrl_nerd.keys import NEXT_QVEL, QPOS
from torchrl_nerd.modules.hybrid import HybridNeRD
from torchrl_nerd.modules.nerd import NeRD
from torchrl_nerd.modules.networks import (
    NETWORKS,
    MLPConfig,
    NetworkConfig,
    network_config,
)
from torchrl_nerd.modules.symmetric import Mirrored, Readout, set_mirrors
from torchrl_nerd.modules.transformer import TransformerConfig
from torchrl_nerd.scenes import Scene
from torchrl_nerd.scenes.variation import expect_told, ranges_of
from torchrl_nerd.settings import SettingError, look_up
from torchrl_nerd.training.symmetry import Symmetry
from torchrl_nerd.transforms import Stats

# bias of a token that is new in a longer band: its weight is e^FAR of what a bias of zero
# gives
FAR = -4.0


def make_model(
    scene: Scene,
    config: TrainConfig,
    stats: Mapping[NestedKey, Stats] | None = None,
    symmetry: Symmetry | None = None,
) -> NeRD:
    """The model that a configuration describes, with random weights.

    ``symmetry``: that of the robot, whose mirrors a symmetric network is told.

    Raises:
        ValueError: no such network or step, a scene that the step cannot move, or a robot
            without so many commuting mirrors.
    """
    network, features = configured_network(config), config.features
    if config.step is None:
        model = NeRD(scene, features, network, stats)
        if symmetry is not None and config.symmetries > 1:
            set_mirrors(model.network, *symmetry.mirrors(config.symmetries))
        return model
    step = make_step(scene, look_up("analytic step", config.step, STEPS))
    return HybridNeRD(scene, step, features, network, stats)


def configured_network(config: TrainConfig) -> NetworkConfig:
    """The network of a training, with its symmetries.

    Raises:
        SettingError: no such network, or symmetries of a GRU.
    """
    network = network_config(config.network)
    if config.symmetries == 1:
        return network
    if not isinstance(network, TransformerConfig | MLPConfig):
        raise SettingError(
            f"expected a transformer or an MLP with symmetries, got '{config.network}': "
            "train it with symmetries 1"
        )
    how = {"symmetries": config.symmetries, "asymmetry": config.near_symmetry}
    return replace(network, **how)


def begin_from(
    start: NeRD, scene: Scene, config: TrainConfig, symmetry: Symmetry | None = None
) -> NeRD:
    """A model with weights and statistics of another one, which is left as it is.

    What the network's inputs mean, their statistics, is part of what it learned, and so is
    a hybrid's gate. The training range is left to be fitted. A transformer may get a longer
    band: tokens that are new in it count for little at first, see `FAR`. A network may get
    products, which add nothing at first.

    Raises:
        ValueError: in one sentence, a configuration of another network, kind or step,
            inputs of another width or of other told parameters, statistics that symmetric
            copies do not share, or mirrors that the scene does not have.
    """
    known, asked = start.config, configured_network(config)
    if known != asked and not _is_larger(known, asked):
        raise ValueError(
            f"expected the network of the model to start from, {_named(known)}, "
            f"got {_named(asked)}"
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
    expect_told(ranges_of(start.scene_features.variation), scene.variation)
    for kind, has, wants in _of_inputs(start, model):
        if has != wants:
            raise ValueError(f"expected to start from {kind} {wants}, got {has}")
    if isinstance(model, HybridNeRD) and isinstance(start, HybridNeRD):
        model.is_gated = start.is_gated
    weights = start.network.state_dict()
    if asked != known and not any(name.startswith("products.") for name in weights):
        model.network.products.silence()
    for name, weight in model.network.state_dict().items():
        if name not in weights:  # of products
            weights[name] = weight
        elif name.endswith("offset_bias"):  # (heads, band)
            new = weight.shape[1] - weights[name].shape[1]
            weights[name] = F.pad(weights[name], (0, new), value=FAR)
    model.network.load_state_dict(weights)
    model.normalize.load_state_dict(start.normalize.state_dict())
    if symmetry is not None:
        _expect_shared(symmetry, model)
        _expect_mirrors(symmetry, model)
    return model


def _is_larger(known: NetworkConfig, asked: NetworkConfig) -> bool:
    """Whether ``asked`` is ``known``, with a longer band or with products."""
    if isinstance(known, MLPConfig) and isinstance(asked, MLPConfig):
        asked = replace(asked, products=asked.products and known.products)
    elif isinstance(known, TransformerConfig) and isinstance(asked, TransformerConfig):
        band, products = min(asked.band, known.band), asked.products and known.products
        asked = replace(asked, band=band, products=products)
    return known == asked


def _of_inputs(first: NeRD, second: NeRD) -> Iterator[tuple[str, Any, Any]]:
    """What the inputs of two models consist of, kind after kind."""
    yield "features", first.scene_features.config, second.scene_features.config
    if isinstance(first, HybridNeRD) and isinstance(second, HybridNeRD):
        yield "the step", first.analytic_step.config, second.analytic_step.config


def _named(network: NetworkConfig) -> str:
    """Names of a network in `NETWORKS`, or all that is known of it, and its symmetries."""
    plain, ending = network, ""
    if isinstance(network, TransformerConfig | MLPConfig) and network.symmetries > 1:
        plain = replace(network, symmetries=1, asymmetry=False)
        nearly = " nearly" * network.asymmetry
        ending = f" with{nearly} symmetries {network.symmetries}"
    names = [name for name, config in NETWORKS.items() if config == plain]
    if not names and isinstance(plain, TransformerConfig):
        usual = replace(plain, band=TransformerConfig.band)
        names = [f"{k}@{plain.band}" for k, v in NETWORKS.items() if v == usual]
    return (" or ".join(names) or str(plain)) + ending


def _expect_shared(symmetry: Symmetry, model: NeRD) -> None:
    """Refuse a model whose statistics symmetric copies of its samples do not share."""
    if not symmetry.keeps(model.normalize):
        raise ValueError(
            "expected a model to start from that was trained with use_symmetry, got one "
            "whose statistics they change: train without use_symmetry and symmetries"
        )


def _expect_mirrors(symmetry: Symmetry, model: NeRD) -> None:
    """Refuse mirrors in a network that are no symmetries of the scene."""
    for layer in model.network.modules():
        if isinstance(layer, Mirrored):
            known = symmetry.targets if isinstance(layer, Readout) else symmetry.tokens
            if not known.have((layer.sources, layer.entry_signs)):
                raise ValueError(
                    "expected a model to start from whose mirrors all robots of "
                    f"'{symmetry.name}' have, got others: train a new one"
                )


def find_symmetry(
    scene: Scene, config: TrainConfig, start: NeRD | None = None
) -> tuple[TrainConfig, Symmetry | None]:
    """The robot's symmetries, where data or network are to have them; see `Symmetry`.

    And the configuration with their number. Where it leaves that open, it is that of the
    model to ``start`` from, else the largest that robot and network can have, if only
    nearly.
    """
    found = None
    if config.symmetries == 0:
        config, found = _with_most(scene, config, start)
    if not config.use_symmetry and config.symmetries == 1:
        return config, None
    if found is None:
        found = Symmetry(scene, config.features, config.near_symmetry)
    return config, found


def _with_most(
    scene: Scene, config: TrainConfig, start: NeRD | None
) -> tuple[TrainConfig, Symmetry | None]:
    network = network_config(config.network) if start is None else start.config
    if (
        not isinstance(network, TransformerConfig | MLPConfig)
        or config.step is not None
    ):
        return replace(config, symmetries=1), None
    if start is not None:
        how = {"symmetries": network.symmetries, "near_symmetry": network.asymmetry}
        return replace(config, **how), None
    find = Symmetry if config.use_symmetry else Symmetry.most
    try:
        found = find(scene, config.features)
    except ValueError:  # a robot of a kind that has none
        return replace(config, symmetries=1), None
    how = {"symmetries": found.counts()[-1], "near_symmetry": found.is_near}
    return replace(config, **how), found


def fingerprint(model: NeRD) -> str:
    """Hash of weights, statistics and range, by which a run knows its start."""
    digest = hashlib.sha256()
    for key, value in sorted(model.state_dict().items()):
        bits = value.cpu().contiguous().reshape(-1).view(torch.uint8)  # of any type
        digest.update(key.encode() + bits.numpy().tobytes())
    return digest.hexdigest()[:16]


def data_fingerprint(data: TensorDictBase) -> str:
    """Hash of how trajectories ``[n, T]`` begin and end: a run knows its data by it."""
    digest = hashlib.sha256(str(list(data.batch_size)).encode())
    for values in (data[QPOS][:, 0], data[NEXT_QVEL][:, -1]):
        digest.update(as_numpy(values).tobytes())
    return digest.hexdigest()[:16]
