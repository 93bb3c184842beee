"""Networks by name, for the command line."""

from torchrl_nerd.modules.baselines import GRUConfig, MLPConfig
from torchrl_nerd.modules.correction import FreeConfig, GroundedConfig
from torchrl_nerd.modules.transformer import PRESETS, TransformerConfig
from torchrl_nerd.settings import SettingError

NetworkConfig = TransformerConfig | MLPConfig | GRUConfig | FreeConfig | GroundedConfig

NETWORKS: dict[str, NetworkConfig] = {
    **PRESETS,
    "mlp-1x16": MLPConfig(depth=1, width=16),
    "mlp-1x32": MLPConfig(depth=1, width=32),
    "mlp-2x32": MLPConfig(depth=2, width=32),
    "mlp-4x64": MLPConfig(),
    "mlp-4x120": MLPConfig(depth=4, width=120),
    "mlp-4x128": MLPConfig(depth=4, width=128),
    "mlp-4x160": MLPConfig(depth=4, width=160),
    "gru": GRUConfig(),
}
"""Those that answer for the whole change of state."""

STEPS: dict[str, NetworkConfig] = {
    "free": FreeConfig(),
    "grounded": GroundedConfig(),
    "grounded-halves": GroundedConfig(parts=2),
    "grounded-small": GroundedConfig(depth=1, width=16, looks=1),
    "grounded-fast": GroundedConfig(looks=1, stride=2),
    "grounded-fine": GroundedConfig(looks=3),
}
"""Those that correct a step: of a `FreeNeRD`, for robots that nothing touches, and of a
`GroundedNeRD`, for robots on springs."""


def network_config(name: str) -> NetworkConfig:
    """The network of that name in `NETWORKS` or `STEPS`.

    Raises:
        SettingError: no such network.
    """
    known = NETWORKS | STEPS
    if name not in known:
        raise SettingError(
            f"unknown network '{name}', expected one of {', '.join(known)}"
        )
    return known[name]
