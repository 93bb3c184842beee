"""The package's transforms on a plain TorchRL env, and a model learned from their outputs.

    python examples/transforms.py                    # a cheetah under random actions
    python examples/transforms.py --name hopper-hop

No dynamics of this package takes part: TorchRL's `DMControlEnv` is stepped, one small
transform adds MuJoCo's own state, and a replay buffer turns transitions into what NeRD
sees and predicts. A plain network then learns the change of state from that, once with the
contacts and once without: of the change's variance 11.2% and 13.1% are not explained.
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, cast

import torch
import tyro
from dm_control.mujoco import Physics
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torch.optim import Adam
from torchrl.data import (
    Composite,
    LazyTensorStorage,
    ReplayBuffer,
    TensorSpec,
    Unbounded,
)
from torchrl.envs import Compose, DMControlEnv, EnvBase, Transform, TransformedEnv
from torchrl.modules import MLP
from tqdm import trange

from torchrl_nerd import Scene, load_scene
from torchrl_nerd.keys import JOINT_TORQUE, NEXT_QPOS, NEXT_QVEL, STATE_DELTA
from torchrl_nerd.transforms import (
    ContactFeatures,
    Normalize,
    RobotCentric,
    StateDelta,
    Stats,
)

logging.getLogger("torchrl").setLevel(logging.ERROR)

RAW = ("qpos", "qvel", NEXT_QPOS, NEXT_QVEL, JOINT_TORQUE)


@dataclass(frozen=True)
class Config:
    """The defaults are for a minute or two on one core."""

    name: str = "cheetah-run"  # DOMAIN-TASK of the dm_control suite
    frames: int = 4_000  # transitions to learn from; a quarter as many to test
    updates: int = 500  # gradient steps of each network
    batch_size: int = 256
    seed: int = 0


class PhysicsState(Transform):
    """``qpos``, ``qvel`` and ``joint_torque``, which a `DMControlEnv` keeps to itself."""

    def __init__(self, scene: Scene, physics: Physics) -> None:
        super().__init__(in_keys=[], out_keys=["qpos", "qvel", "joint_torque"])
        self.physics, self.controller = physics, scene.controller
        self.sizes = (scene.model.nq, scene.model.nv, len(scene.actuated))

    def _read(self, tensordict: TensorDictBase, torque: Tensor) -> TensorDictBase:
        data = self.physics.data  # copied: MuJoCo goes on writing into its own
        qpos, qvel = torch.tensor(data.qpos), torch.tensor(data.qvel)
        return tensordict.update({"qpos": qpos, "qvel": qvel, "joint_torque": torque})

    def _step(
        self, tensordict: TensorDictBase, next_tensordict: TensorDictBase
    ) -> TensorDictBase:
        state = (tensordict[key] for key in ("action", "qpos", "qvel"))
        return self._read(next_tensordict, self.controller(*state))

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return self._read(tensordict_reset, torch.zeros(self.sizes[-1]).double())

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Add the three."""
        spec = cast(Composite, observation_spec.clone())
        for key, size in zip(self.out_keys, self.sizes, strict=True):
            spec[key] = Unbounded(torch.Size((size,)), dtype=torch.float64)
        return spec


def make_features(scene: Scene) -> list[Transform]:
    """State and torque in the robot's frame, its contacts, the change of its state."""
    return [RobotCentric(scene), ContactFeatures(scene), StateDelta(scene)]


def make_suite_env(cfg: Config, scene: Scene) -> EnvBase:
    """The suite's env with its state, and beside the suite's observation our features."""
    base = DMControlEnv(*cfg.name.split("-", 1))
    physics = cast(Any, base._env).physics
    parts = PhysicsState(scene, physics), *make_features(scene)
    env = TransformedEnv(base, Compose(*parts))  # pyright: ignore[reportArgumentType]
    env.set_seed(cfg.seed)
    return env


def make_buffer(
    data: TensorDictBase, transform: Transform, cfg: Config
) -> ReplayBuffer:
    """Raw transitions in store, features out of it."""
    buffer = ReplayBuffer(
        storage=LazyTensorStorage(len(data)), batch_size=cfg.batch_size
    )
    buffer.extend(data.select(*RAW))
    buffer.append_transform(transform)
    return buffer


def fit(buffer: ReplayBuffer, keys: Sequence[NestedKey], cfg: Config) -> nn.Module:
    """A network from the features of those keys to the change of the state."""
    batch = buffer.sample()
    size = sum(batch[key].shape[-1] for key in keys)
    network = MLP(size, batch[STATE_DELTA].shape[-1], num_cells=[128, 128])
    optimizer = Adam(network.parameters(), lr=1e-3)
    for _ in trange(cfg.updates, unit="update"):
        error = unexplained(network, buffer.sample(), keys)
        optimizer.zero_grad()
        error.backward()
        optimizer.step()
    return network


def unexplained(
    network: nn.Module, batch: TensorDictBase, keys: Sequence[NestedKey]
) -> Tensor:
    """Squared error of the normalised change: the share of its variance not explained."""
    inputs = torch.cat([batch[key] for key in keys], -1).float()
    return (network(inputs) - batch[STATE_DELTA].float()).square().mean()


def main(cfg: Config) -> dict[str, float]:
    """Collect, normalise, learn; errors on another rollout, without contacts and with."""
    torch.manual_seed(cfg.seed)
    scene = load_scene(f"dm_control/{cfg.name}")
    env = make_suite_env(cfg, scene)
    data = env.rollout(cfg.frames, break_when_any_done=False)
    other = env.rollout(cfg.frames // 4, break_when_any_done=False)

    parts = make_features(scene)
    features = Compose(*parts)  # pyright: ignore[reportArgumentType]
    seen = features(data.select(*RAW).clone())
    robot, contacts = ("robot_state", "robot_torque"), parts[1].out_keys
    keys = (*robot, *contacts, STATE_DELTA)
    features.append(Normalize({key: Stats.of(seen[key]) for key in keys}))
    test = features(other.select(*RAW))
    buffer = make_buffer(data, features, cfg)
    errors = {}
    for name, inputs in (("robot", robot), ("robot and contacts", (*robot, *contacts))):
        network = fit(buffer, inputs, cfg)
        with torch.no_grad():
            errors[name] = float(unexplained(network, test, inputs))
        print(f"{name:<20} {errors[name]:.1%} of the change not explained")
    return errors


if __name__ == "__main__":
    main(tyro.cli(Config))
