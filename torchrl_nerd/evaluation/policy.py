"""A policy that TorchRL can train and that two plain files can hold."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.envs import EnvBase
from torchrl.modules import ProbabilisticActor, TanhNormal

from torchrl_nerd.files import read_json, writable_folder, write_json
from torchrl_nerd.keys import ACTION, OBSERVATION
from torchrl_nerd.robots import make_task, registry
from torchrl_nerd.tasks import Task
from torchrl_nerd.tensor_files import expect_fit, read_tensors, write_tensors

POLICIES = Path(__file__).parents[1] / "policies"
"""Policies that come with the package, learned in shipped models: ``make policies``."""
WEIGHTS, CARD = "policy.safetensors", "policy.json"
MOST_LAYERS, LARGEST_SIZE = 2**7, 2**14
MIN_STD = 1e-3  # of an observation: a constant one is not blown up
FURTHEST = 10.0  # standard deviations from the mean that a network is shown


def mlp(sizes: Sequence[int], last_gain: float = 1.0) -> nn.Sequential:
    """Linear layers with tanh between, orthogonal weights, zero biases.

    ``last_gain``: scale of the last layer's weights; small for a cautious start.
    """
    linears = [nn.Linear(*pair) for pair in zip(sizes[:-1], sizes[1:], strict=True)]
    for linear in linears:
        gain = last_gain if linear is linears[-1] else nn.init.calculate_gain("tanh")
        nn.init.orthogonal_(linear.weight, gain)
        nn.init.zeros_(linear.bias)
    layers = [layer for linear in linears for layer in (linear, nn.Tanh())]
    return nn.Sequential(*layers[:-1])


class Standardize(nn.Module):
    """(x - mean) / std, with constants that are saved with the weights.

    Of ``frame_stack`` observations side by side, ``size`` numbers together, x is the last
    one and the changes that led to it. These have a mean and a spread of their own, so that
    velocities are not lost beside positions.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, size: int, frame_stack: int = 1) -> None:
        super().__init__()
        self.frame_stack, self.count = frame_stack, 0
        self.register_buffer("mean", torch.zeros(size))
        self.register_buffer("std", torch.ones(size))

    @torch.no_grad()
    def fit(self, observations: Tensor) -> "Standardize":
        """Mean and deviation of all that were ever given, these ``(*batch, size)`` too.

        One that was loaded from a file begins anew: its file has no count of them.
        """
        samples = self._last_and_changes(observations.flatten(0, -2).double())
        self.count += len(samples)
        share = len(samples) / self.count
        gap = samples.mean(0) - self.mean  # (size,)
        within = samples.var(0, correction=0)
        between = share * (1.0 - share) * gap.square()
        variance = (1.0 - share) * self.std.square() + share * within + between
        self.mean.add_(share * gap)
        self.std.copy_(variance.sqrt().clamp_min(MIN_STD))
        return self

    def forward(self, observations: Tensor) -> Tensor:
        """Of ``(*batch, size)``, to within `FURTHEST`."""
        x = (self._last_and_changes(observations) - self.mean) / self.std
        return x.clamp(-FURTHEST, FURTHEST)

    def _last_and_changes(self, observations: Tensor) -> Tensor:
        if self.frame_stack == 1:
            return observations
        each = observations.unflatten(-1, (self.frame_stack, -1))  # (*batch, frames, D)
        return torch.cat((each[..., -1:, :], each.diff(dim=-2)), -2).flatten(-2)


class Policy(nn.Module):
    """Observation ``(*batch, D)`` -> mean and standard deviation ``(*batch, A)``.

    A tanh network gives the mean; the standard deviation is learned and the same in every
    state (paper, appendix B). Both are before the squashing that `make_actor` adds.

    Args:
        sizes: D, the widths of the hidden layers, A.
        std: at the start.
        frame_stack: how many observations D holds, see `stack_frames`.
    """

    def __init__(
        self, sizes: Sequence[int], std: float = 1.0, frame_stack: int = 1
    ) -> None:
        super().__init__()
        self.sizes, self.frame_stack = tuple(sizes), frame_stack
        self.standardize = Standardize(self.sizes[0], frame_stack)
        self.mlp = mlp(self.sizes, last_gain=0.01)
        self.log_std = nn.Parameter(torch.full((self.sizes[-1],), math.log(std)))

    @classmethod
    @torch.no_grad()
    def for_env(
        cls,
        env: EnvBase,
        steps: int,
        widths: Sequence[int],
        std: float = 1.0,
        frame_stack: int = 1,
    ) -> "Policy":
        """A fresh one, standardised by what so many random ``steps`` of the env show.

        The env shows ``frame_stack`` observations side by side, see `stack_frames`.
        ``widths`` are of the hidden layers.
        """
        seen = env.rollout(steps, break_when_any_done=False)[OBSERVATION]
        sizes = (seen.shape[-1], *widths, env.action_spec.shape[-1])
        policy = cls(sizes, std, frame_stack).to(seen.device)
        policy.standardize.fit(seen)
        return policy

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation of the action before squashing, ``(*batch, A)``."""
        mean = self.mlp(self.standardize(observation))
        return mean, self.log_std.exp().expand_as(mean)


def make_actor(policy: Policy) -> ProbabilisticActor:
    """The policy as TorchRL knows it: ``observation`` -> ``action`` in [-1, 1].

    Its ``frame_stack`` says how many observations it is to be shown, see `frame_stack_of`.
    """
    actor = ProbabilisticActor(
        TensorDictModule(policy, [OBSERVATION], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        out_keys=[ACTION],
        distribution_class=TanhNormal,
        return_log_prob=True,
    )
    vars(actor)["frame_stack"] = policy.frame_stack
    return actor


def save_policy(
    policy: Policy, folder: Path | str, card: dict[str, Any] | None = None
) -> Path:
    """Write weights, then card, each whole or not at all; nothing is pickled.

    ``card``: what else to say: task, dynamics it was trained in, configuration.
    """
    folder = writable_folder(Path(folder))
    write_tensors(folder / WEIGHTS, policy.state_dict())
    shape = {"sizes": list(policy.sizes), "frame_stack": policy.frame_stack}
    write_json(folder / CARD, {"format": 1, **shape, **(card or {})})
    return folder


def load_policy(folder: Path | str, task: Task | None = None) -> Policy:
    """A policy from a folder that `save_policy` wrote; it must fit the task, if given.

    Raises:
        ValueError: in one sentence, what is missing, broken or of another shape.
    """
    folder = Path(folder)
    card = _read_card(folder)
    found, frame_stack = card.get("sizes"), card.get("frame_stack", 1)
    sizes = found if isinstance(found, list) else []
    is_whole = all(type(size) is int and 0 < size <= LARGEST_SIZE for size in sizes)
    if not (is_whole and 2 <= len(sizes) <= MOST_LAYERS):
        raise ValueError(f"expected the layer sizes in {folder / CARD}, got {found!r}")
    if type(frame_stack) is not int or frame_stack < 1 or sizes[0] % frame_stack:
        raise ValueError(
            f"expected how many observations make {sizes[0]} inputs as frame_stack in "
            f"{folder / CARD}, got {frame_stack!r}"
        )
    if task is not None:
        expected = (frame_stack * task.observation_size, task.controller.num_actions)
        if (sizes[0], sizes[-1]) != expected:
            raise ValueError(
                f"the policy in {folder} has {sizes[0]} observations and {sizes[-1]} "
                f"actions, the task has {expected[0]} and {expected[1]}"
            )
    tensors = read_tensors(folder / WEIGHTS)
    with torch.device("meta"):  # shapes alone, whatever memory the sizes would take
        expected = Policy(sizes, frame_stack=frame_stack).state_dict()
    expect_fit(tensors, expected, f"weights in {folder}", f"layers of {sizes}")
    policy = Policy(sizes, frame_stack=frame_stack)
    policy.load_state_dict(tensors)
    return policy.eval()


def policy_task(folder: Path) -> Task:
    """The task that a policy was learned for, which its card names.

    Raises:
        ValueError: no policy there, or a card that names no task.
    """
    name = _read_card(folder).get("task")
    if not isinstance(name, str):
        raise ValueError(f"expected the task's id in {folder / CARD}, got {name!r}")
    return make_task(name)


def shipped_policies() -> dict[str, Path]:
    """Task id -> folder of its policy, see `load_policy`; robots of users included."""
    folders = sorted(card.parent for card in POLICIES.glob(f"*/{CARD}"))
    shipped = {read_json(folder / CARD)["task"]: folder for folder in folders}
    own = {task: Path(folder) for task, folder in registry.POLICIES.items()}
    return shipped | {k: v for k, v in own.items() if (v / CARD).is_file()}


def shipped_policy(task: str) -> Path:
    """The folder of a task's policy.

    Raises:
        ValueError: none is shipped for that task.
    """
    policies = shipped_policies()
    if task not in policies:
        names = ", ".join(policies)
        raise ValueError(
            f"no policy of '{task}' is shipped, only of {names}: expected a folder that "
            "examples/ppo.py wrote"
        )
    return policies[task]


def _read_card(folder: Path) -> dict[str, Any]:
    if not (folder / CARD).is_file() or not (folder / WEIGHTS).is_file():
        raise ValueError(f"expected {WEIGHTS} and {CARD} in {folder}, found no policy")
    return read_json(folder / CARD)
