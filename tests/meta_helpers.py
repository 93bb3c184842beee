"""The device ``meta``, which computes nothing and so has nothing to tell the host.

What reads a number of a tensor there raises: ``.item()``, ``.cpu()``, ``nonzero``, boolean
indices, ``bool(tensor)``. `device_alone` refuses copies from the host besides, which an
accelerator would wait for, and which no CUDA graph can hold.
"""

import copy
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import pytest
import torch
from dynamics_helpers import inference_of, model_of_kind
from torch import Generator, Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from torchrl_nerd import NeRDEnv
from torchrl_nerd.dynamics import NeRDDynamics
from torchrl_nerd.envs.base import SceneEnv
from torchrl_nerd.robots import make_task

META = torch.device("meta")
COPIES = ("aten::_to_copy", "aten::copy_")
MAKERS = ("new_tensor", "tensor", "as_tensor", "from_numpy")


class _NoHostTensors(TorchDispatchMode):
    """Refuses operations that mix tensors of ``meta`` and of the host.

    Numbers without a dimension may be the host's: an accelerator takes them as arguments.
    """

    def __torch_dispatch__(
        self, func: Any, types: Any, args: Any = (), kwargs: Mapping | None = None
    ) -> Any:
        result = func(*args, **(kwargs or {}))
        leaves = tree_leaves((args, kwargs, result))
        tensors = [x for x in leaves if isinstance(x, Tensor)]
        is_copy = func.name().startswith(COPIES)
        hosts = [x for x in tensors if x.device != META and (x.ndim or is_copy)]
        if hosts and len(hosts) < len(tensors):
            shapes = [tuple(x.shape) for x in hosts]
            raise AssertionError(f"{func.name()} takes {shapes} from the host")
        return result


class _NoHostLists(TorchFunctionMode):
    """Refuses tensors made of Python's numbers, and lists as indices."""

    def __torch_function__(
        self, func: Any, types: Any, args: Any = (), kwargs: Mapping | None = None
    ) -> Any:
        name = getattr(func, "__name__", "")
        if name in MAKERS:
            raise AssertionError(f"{name} copies {args[-1]} from the host")
        if name in ("__getitem__", "__setitem__"):
            index = args[1] if isinstance(args[1], tuple) else (args[1],)
            if any(isinstance(x, tuple | list) for x in index):
                raise AssertionError(f"{name} copies the index {index} from the host")
        return func(*args, **(kwargs or {}))


@contextmanager
def device_alone() -> Iterator[None]:
    """What is computed here takes nothing from the host."""
    with _NoHostLists(), _NoHostTensors():
        yield


@pytest.fixture
def meta(monkeypatch: pytest.MonkeyPatch) -> torch.device:
    """The device, which autocast does not know."""
    monkeypatch.setattr(torch, "is_autocast_enabled", lambda device=None: False)
    return META


def meta_env(
    task_id: str,
    kind: str,
    num_envs: int,
    generator: Generator,
    state_dtype: torch.dtype = torch.float64,
) -> SceneEnv:
    """An env whose model and state are on ``meta``; its specs stay where they are.

    Envs refuse that device by name, and TorchRL's specs read their bounds. Task, scene and
    model are copies: constants of a scene move to the device of the state that they see.
    """
    task = make_task(task_id)
    model = model_of_kind(kind, task.scene, generator)
    task, model = copy.deepcopy((task, model))
    how = {"inference": inference_of(kind), "state_dtype": state_dtype}
    env = NeRDEnv(task, model, num_envs, seed=0, **how)
    inner = env._torch_dynamics
    assert inner is not None
    model = inner.model if isinstance(inner, NeRDDynamics) else inner.analytic_step
    model.to(META)
    if isinstance(inner, NeRDDynamics):
        inner.network.to(META)  # pyright: ignore
    inner.device = META
    for name, buffer in env._buffers.items():
        assert buffer is not None
        env._buffers[name] = buffer.to(META)
    vars(env)["_device"] = META
    return env
