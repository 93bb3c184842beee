"""Specs of an env: what TorchRL may expect of its states, actions and flags."""

from collections.abc import Iterator, Mapping

import torch
from torchrl.data import Bounded, Categorical, Composite, TensorSpec, Unbounded

from torchrl_nerd.envs.faults import REASONS
from torchrl_nerd.envs.transition import FLAGS, drive_sizes
from torchrl_nerd.keys import FAULT, OBSERVATION, TRUST
from torchrl_nerd.tasks import Task


def make_specs(
    task: Task,
    state_sizes: Mapping[str, int],
    batch_size: torch.Size,
    device: torch.device,
    is_guarded: bool,
    state_dtype: torch.dtype,
) -> Iterator[tuple[str, TensorSpec]]:
    """Name and value of every spec of an env of that task and ``batch_size``.

    ``state_sizes`` are the widths of the state's keys, whose type, and that of torques, is
    ``state_dtype``; steps of guarded dynamics have a ``trust``.
    """

    def shape(width: int) -> torch.Size:
        return torch.Size((*batch_size, width))

    def column(num_values: int, dtype: torch.dtype) -> TensorSpec:
        return Categorical(num_values, shape(1), device, dtype)

    sizes = {**state_sizes, **drive_sizes(task)}
    state: dict[str, TensorSpec] = {
        key: Unbounded(shape(size), device, state_dtype) for key, size in sizes.items()
    }
    if is_guarded:
        state[TRUST] = Bounded(0.0, 1.0, shape(1), device, torch.float32)
    # what `reset` takes with ``set_state``: transforms hand on nothing else
    given = {key: state[key].clone() for key in state_sizes}
    yield "state_spec", Composite(given, shape=batch_size, device=device)
    state[FAULT] = column(len(REASONS), torch.int64)
    observed = shape(task.observation_size)
    state[OBSERVATION] = Unbounded(observed, device, torch.float32)
    yield "observation_spec", Composite(state, shape=batch_size, device=device)
    actions = shape(task.controller.num_actions)
    yield "action_spec", Bounded(-1.0, 1.0, actions, device, torch.float32)
    yield "reward_spec", Unbounded(shape(1), device, torch.float32)
    flags = {key: column(2, torch.bool) for key in FLAGS}
    yield "full_done_spec", Composite(flags, shape=batch_size, device=device)
