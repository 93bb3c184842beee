"""Networks by name: kind, then depth x width."""

from torchrl_nerd.modules.gru import GRUConfig
from torchrl_nerd.modules.mlp import MLPConfig
from torchrl_nerd.modules.transformer import PRESETS, TransformerConfig
from torchrl_nerd.settings import SettingError

NetworkConfig = TransformerConfig | MLPConfig | GRUConfig

NETWORKS: dict[str, NetworkConfig] = {
    **PRESETS,
    "mlp-1x16": MLPConfig(depth=1, width=16),
    "mlp-1x32": MLPConfig(depth=1, width=32),
    "mlp-2x32": MLPConfig(depth=2, width=32),
    "mlp-2x64": MLPConfig(depth=2, width=64),
    "mlp-4x64": MLPConfig(),
    "mlp-4x120": MLPConfig(depth=4, width=120),
    "mlp-4x128": MLPConfig(depth=4, width=128),
    "mlp-4x160": MLPConfig(depth=4, width=160),
    "gru": GRUConfig(),
}


def network_config(name: str) -> NetworkConfig:
    """The network of that name in `NETWORKS`.

    Raises:
        SettingError: no such network.
    """
    if name not in NETWORKS:
        raise SettingError(
            f"unknown network '{name}', expected one of {', '.join(NETWORKS)}"
        )
    return NETWORKS[name]
