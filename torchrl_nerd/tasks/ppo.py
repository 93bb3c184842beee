"""Settings of policy learning for every task that has a goal.

As in the paper's reference code (rl_games), but for what does not carry over: its step
size follows the policy's KL divergence, here it falls linearly; its Franka policy has an
LSTM before the hidden layers, here it sees the last three observations and is updated four
times as often. Cartpole's are this package's own.
"""

from dataclasses import dataclass, replace


@dataclass(frozen=True)
class PPOConfig:
    """Proximal policy optimisation: Schulman et al., https://arxiv.org/abs/1707.06347."""

    total_frames: int = 3_000_000  # actions to learn from
    num_envs: int = 1024  # rows stepped together
    horizon: int = 32  # actions of every row between two updates
    epochs: int = 5  # passes over those actions
    minibatch: int = 2048  # actions per gradient
    lr: float = 3e-3  # Adam's step size at the start; falls linearly to zero
    gamma: float = 0.99  # discount per action
    lmbda: float = 0.95  # advantage estimation: 0 trusts the critic, 1 the rewards
    clip: float = 0.2  # how far an action's probability ratio counts
    std: float = 1.0  # of actions at the start, before they are squashed
    memory: int = 1  # last observations that policy and critic see
    widths: tuple[int, ...] = (64, 64)  # hidden layers of policy and critic


_ANT = PPOConfig(
    total_frames=32_800_000,
    num_envs=2048,
    minibatch=16_384,
    lr=3e-4,
    widths=(128, 64, 32),
)
_ANYMAL = replace(_ANT, total_frames=65_500_000)
_FRANKA = PPOConfig(
    total_frames=26_200_000,
    num_envs=1024,
    epochs=8,
    minibatch=4096,
    lr=2e-3,
    std=0.7,
    memory=3,  # its observation has no velocities, and the policy must brake
)

PPO_CONFIGS: dict[str, PPOConfig] = {
    "cartpole/swingup": PPOConfig(),
    "ant/run": _ANT,
    "ant/spin": _ANT,
    # to keep to a rate takes a wider policy
    "ant/spin_track": replace(_ANT, widths=(256, 128, 64)),
    "franka/reach": _FRANKA,
    # std: of the torque that it can give; to brake in time by torque takes a wider policy
    "franka/reach_torque": replace(_FRANKA, std=0.3, widths=(128, 128)),
    "anymal/forward": _ANYMAL,
    "anymal/sideways": _ANYMAL,
}
"""Task id -> settings."""
