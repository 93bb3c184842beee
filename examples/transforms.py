"""The package's transforms on a plain TorchRL env, and a model learned from their outputs.

    python examples/transforms.py                    # a cheetah under random actions
    python examples/transforms.py --name hopper-hop

No dynamics of this package takes part: TorchRL's `DMControlEnv` is stepped, one small
transform adds MuJoCo's own state, and a replay buffer turns transitions into what NeRD
sees and predicts. A plain network then learns the change of state from that, once with the
contacts and once without.
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import torch
import tyro
from tensordict import TensorDictBase
from torch import Tensor, nn
from torch.optim import Adam
from torchrl.data import Composite, LazyTensorStorage, ReplayBuffer, Unbounded
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

    def __init__(self, scene: Scene) -> None:
        super().__init__(in_keys=[], out_keys=["qpos", "qvel", "joint_torque"])
        self.controller, self.num_torques = scene.controller, len(scene.actuated)

    def _read(self, tensordict: TensorDictBase) -> TensorDictBase:
        data = self.parent.base_env._env.physics.data
        for key in ("qpos", "qvel"):  # copies: MuJoCo goes on writing into its own
            tensordict[key] = torch.tensor(getattr(data, key))
        return tensordict

    def _step(
        self, tensordict: TensorDictBase, next_tensordict: TensorDictBase
    ) -> TensorDictBase:
        state = (tensordict[key] for key in ("action", "qpos", "qvel"))
        next_tensordict["joint_torque"] = self.controller(*state)
        return self._read(next_tensordict)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        tensordict_reset["joint_torque"] = torch.zeros(self.num_torques).double()
        return self._read(tensordict_reset)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add the three."""
        model = self.parent.base_env._env.physics.model
        sizes = (model.nq, model.nv, self.num_torques)
        spec = observation_spec.clone()
        for key, size in zip(self.out_keys, sizes, strict=True):
            spec[key] = Unbounded((size,), dtype=torch.float64)
        return spec


def make_features(scene: Scene) -> list[Transform]:
    """State and torque in the robot's frame, its contacts, the change of its state."""
    return [RobotCentric(scene), ContactFeatures(scene), StateDelta(scene)]


def make_suite_env(cfg: Config, scene: Scene) -> EnvBase:
    """The suite's env with its state, and beside the suite's observation our features."""
    env = DMControlEnv(*cfg.name.split("-", 1))
    env = TransformedEnv(env, Compose(PhysicsState(scene), *make_features(scene)))
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


def fit(buffer: ReplayBuffer, keys: Sequence[str], cfg: Config) -> nn.Module:
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
    network: nn.Module, batch: TensorDictBase, keys: Sequence[str]
) -> Tensor:
    """Squared error of the normalised change: the share of its variance not foreseen."""
    inputs = torch.cat([batch[key] for key in keys], -1).float()
    return (network(inputs) - batch[STATE_DELTA].float()).square().mean()


def main(cfg: Config) -> dict[str, float]:
    """Collect, normalise, learn; errors on another rollout, without contacts and with."""
    torch.manual_seed(cfg.seed)
    scene = load_scene(f"dm_control/{cfg.name}")
    env = make_suite_env(cfg, scene)
    data = env.rollout(cfg.frames, break_when_any_done=False)
    other = env.rollout(cfg.frames // 4, break_when_any_done=False)

    features = Compose(*make_features(scene))
    seen = features(data.select(*RAW).clone())
    robot, contacts = ("robot_state", "robot_torque"), features[1].out_keys
    keys = (*robot, *contacts, STATE_DELTA)
    features.append(Normalize({key: Stats.of(seen[key]) for key in keys}))
    test = features(other.select(*RAW))
    buffer = make_buffer(data, features, cfg)
    errors = {}
    for name, inputs in (("robot", robot), ("robot and contacts", (*robot, *contacts))):
        network = fit(buffer, inputs, cfg)
        with torch.no_grad():
            errors[name] = float(unexplained(network, test, inputs))
        print(f"{name:<20} {errors[name]:.1%} of the change not foreseen")
    return errors


if __name__ == "__main__":
    main(tyro.cli(Config))
