"""A hybrid without its network: what the network is worth."""

import copy

from torch import nn

from torchrl_nerd.modules.hybrid import HybridNeRD


def without_network(model: HybridNeRD) -> HybridNeRD:
    """A copy whose network's last layer is zero: its analytic step alone.

    Args:
        model: left as it is.
    """
    copied = copy.deepcopy(model)
    last = [m for m in copied.network.head.modules() if isinstance(m, nn.Linear)][-1]
    for weight in last.parameters():
        nn.init.zeros_(weight)
    return copied
