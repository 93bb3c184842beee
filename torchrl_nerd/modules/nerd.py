"""A Neural Robot Dynamics model: features of a scene, a network, statistics."""

from collections.abc import Callable, Mapping
from typing import Any, Protocol

import torch
from tensordict.utils import NestedKey
from torch import Tensor, nn

from torchrl_nerd.modules.coverage import Coverage
from torchrl_nerd.modules.flight import Flight
from torchrl_nerd.modules.scene_tokens import SceneTokens
from torchrl_nerd.scenes.scene import Scene
from torchrl_nerd.transforms import Normalize, StateDelta, Stats

TOKEN, TARGET = "token", "target"
LARGEST = 1e6  # of what a simulator within foresees, normalised


class Memory(Protocol):
    """History of a network, one entry per row."""

    def clear(self, rows: Tensor) -> None:
        """Empty the history of ``rows`` (bool ``(num_rows,)``)."""
        ...


class Network(Protocol):
    """What every network can do; `step` takes the memory that its own kind makes."""

    def empty_memory(self, rows: int) -> Memory:
        """A history of nothing for ``rows`` rows."""
        ...

    def step(self, token: Tensor, memory: Any) -> Tensor:
        """The next token of every row, ``(rows, F) -> (rows, D)``."""
        ...


class Config(Protocol):
    """Size of a network, which it can build."""

    def build(self, num_inputs: int, num_outputs: int) -> Any:
        """A freshly initialised module that is a `Network`."""
        ...


class NeRD(nn.Module):
    """The learned solver of one robot: state, torque and ground in, change of state out.

    Args:
        scene: the robot.
        config: size and kind of the network.
        stats: statistics of raw tokens and targets, from `SceneTokens`; zero mean and
            unit variance where not given (a model whose weights are yet to be loaded).
        tokens: what it sees of a state; the scene's own features where not given.
        state_delta: what it predicts; see `StateDelta`.
    """

    has_simulator = False  # within, whose change the network is shown, see `foresee`
    has_short_loops = False  # hundreds of them, when compiled, and no history

    def __init__(
        self,
        scene: Scene,
        config: Config,
        stats: Mapping[NestedKey, Stats] | None = None,
        tokens: SceneTokens | None = None,
        state_delta: StateDelta | None = None,
    ) -> None:
        super().__init__()
        self.scene, self.config = scene, config
        self.tokens = SceneTokens(scene) if tokens is None else tokens
        self.state_delta = StateDelta(scene) if state_delta is None else state_delta
        num_inputs, num_outputs = self.tokens.size, self.state_delta.size
        self.normalize = Normalize(
            stats or {TOKEN: unit_stats(num_inputs), TARGET: unit_stats(num_outputs)}
        )
        self.coverage = Coverage(scene, num_inputs, num_outputs)
        self.flight: Flight | None = None
        self.network = config.build(num_inputs + self.num_hints, num_outputs)

    def fly(self) -> "NeRD":
        """Have rows that nothing pushes move along their free motion; returns itself.

        Raises:
            ValueError: a robot that `Flight` is not for.
        """
        self.flight = Flight(self.scene).to(self.device)
        return self

    def encode(
        self, qpos: Tensor, qvel: Tensor, joint_torque: Tensor, terrain: Tensor | None
    ) -> Tensor:
        """Normalised float32 tokens ``(*batch, F)`` of float64 states and torques.

        What lies outside the training data is taken to their border, see `Coverage`.
        """
        features = self.features(qpos, qvel, joint_torque, terrain)
        return self.assemble(features, qpos, qvel, joint_torque, terrain)

    def features(
        self, qpos: Tensor, qvel: Tensor, joint_torque: Tensor, terrain: Tensor | None
    ) -> Tensor:
        """Normalised features ``(*batch, F)`` as they are, float64."""
        raw = self.tokens(qpos, qvel, joint_torque, terrain)
        return self.normalize.normalize(TOKEN, raw)

    def assemble(
        self,
        features: Tensor,
        qpos: Tensor,
        qvel: Tensor,
        joint_torque: Tensor,
        terrain: Tensor | None = None,
    ) -> Tensor:
        """The network's token ``(*batch, token_size)``, from a state's `features`."""
        token = self.coverage.clamp_token(features).to(self.dtype)
        if not self.has_simulator:
            return token
        change = self.foresee(qpos, qvel, joint_torque, terrain)
        # torques a thousandfold overflow it; what is no number in a state is one in a token
        change = change.nan_to_num(0.0).clamp(-LARGEST, LARGEST)
        exact = torch.promote_types(self.dtype, torch.float32)
        return torch.cat((token.to(exact), change.to(exact)), -1)

    @property
    def num_hints(self) -> int:
        """H: what a simulator within tells beside its change."""
        return 0

    def foresee(
        self,
        qpos: Tensor,
        qvel: Tensor,
        joint_torque: Tensor,
        terrain: Tensor | None = None,
    ) -> Tensor:
        """What a simulator within foresees: hints, change, gate ``(*batch, H + D + 1)``."""
        raise NotImplementedError(f"{type(self).__name__} has no simulator within")

    @property
    def token_size(self) -> int:
        """Width of a token: the features, and what is foreseen."""
        foreseen = self.num_hints + self.state_delta.size + 1
        return self.tokens.size + self.has_simulator * foreseen

    def decode(
        self, qpos: Tensor, qvel: Tensor, output: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Next ``qpos`` and ``qvel`` from normalised outputs ``(*batch, D)``."""
        change = output.to(qpos.dtype)
        if self.has_simulator:  # which knows harder impacts than the data hold
            delta = self.normalize.denormalize(TARGET, change)
            delta = self.coverage.clamp_change(delta, self.scene.control_step)
        else:
            change = self.coverage.clamp_target(change)
            delta = self.normalize.denormalize(TARGET, change)
        limit = self.coverage.limit_motion
        after = self.state_delta.integrate(qpos, qvel, delta, limit)
        return self.coverage.stay((qpos, qvel), self.coverage.stop_joints(*after))

    def with_terrain(self, scene: Scene) -> "NeRD":
        """The same weights for the same robot over another ground.

        Raises:
            ValueError: another robot, or a ground that is described by other features.
        """
        if scene.robot_hash != self.scene.robot_hash:
            raise ValueError(
                f"expected the robot of scene '{self.scene.name}' over another ground, "
                f"got another robot in '{scene.name}'"
            )
        mine = self.scene
        scene = scene.foreseeing(mine.foresees_forces, mine.foresees_free_motion)
        with torch.random.fork_rng(devices=[]):  # weights are drawn, then replaced
            model = type(self)(scene, self.config)
        if self.flight is not None:
            model.fly()
        sizes, other = self.tokens.contact.sizes, model.tokens.contact.sizes
        if sizes != other:
            raise ValueError(
                f"expected a ground with the features {dict(sizes)} that the model was "
                f"trained on, got one with {dict(other)}"
            )
        model.network.to(self.dtype)
        model.load_state_dict(self.state_dict())
        return model.to(self.device).train(self.training)

    def _apply(self, fn: Callable, recurse: bool = True) -> "NeRD":
        """Move everything, but cast the network alone: constants stay float64."""
        for part in (part for part in self.children() if part is not self.network):
            for module in part.modules():
                for name, buffer in module._buffers.items():
                    if buffer is not None:
                        module._buffers[name] = buffer.to(fn(buffer).device)
                for weight in module._parameters.values():  # of a simulator
                    if weight is not None:
                        weight.data = weight.data.to(fn(weight.data).device)
        self.network._apply(fn, recurse)
        return self

    @property
    def dtype(self) -> torch.dtype:
        """What the network computes in."""
        return next(self.network.parameters()).dtype

    @property
    def device(self) -> torch.device:
        """Where it computes."""
        return next(self.network.parameters()).device


def unit_stats(size: int) -> Stats:
    """Statistics that leave ``(*, size)`` as it is."""
    return Stats(1, torch.zeros(size).double(), torch.ones(size).double())
