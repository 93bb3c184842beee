"""A scene, a task and a dynamics joined into a batched TorchRL env."""

import secrets
from collections.abc import Mapping
from numbers import Integral
from pathlib import Path
from typing import Any, cast

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torchrl_nerd.compat import tensordict_of
from torchrl_nerd.compiled import Compiled, unaffected
from torchrl_nerd.dynamics import Dynamics, GuardedDynamics
from torchrl_nerd.dynamics.models import TorchDynamics
from torchrl_nerd.envs.faults import FaultRecorder
from torchrl_nerd.envs.given_state import given_state
from torchrl_nerd.envs.pixels import RenderedEnv
from torchrl_nerd.envs.rendering import Renderer
from torchrl_nerd.envs.specs import make_specs
from torchrl_nerd.envs.streams import env_keys, stream_offsets, uniforms
from torchrl_nerd.envs.transition import FLAGS, Transition, drive_sizes
from torchrl_nerd.keys import ACTION, FAULT, OBSERVATION, PARAMETERS, QPOS, QVEL, TRUST
from torchrl_nerd.robots import task_id
from torchrl_nerd.settings import expect_count, expect_device
from torchrl_nerd.tasks import Task

MAX_SEED = 2**63
SEED_BITS = 32  # of a seed that is drawn


class SceneEnv(RenderedEnv):
    """A task in any dynamics: everything around the solver, written once.

    Per env: ``qpos``, ``qvel`` (float64), ``observation`` (float32), the task's
    parameters such as ``terrain``, and ``joint_torque``, the controller's over the last
    control step, and of servos ``ctrl`` (zero after a reset). Random numbers are each
    env's own, however many there are. ``reset(td, set_state=True)`` starts from ``td``.

    An env whose action or next state is not finite, or that runs away, keeps its last state
    and ends as ``terminated``; no other env notices. ``fault`` says why, see
    `envs.faults`. With `GuardedDynamics` ``trust`` says how far a step may be believed.

    Args:
        task: reset distribution, observation, reward, end.
        dynamics: what steps the state.
        num_envs: how many envs step together.
        seed: of the resets; drawn where not given, so that envs of workers differ.
        device: where states, observations and rewards live.
        dump_dir: where the first fault of each kind leaves a dump of its last steps.
        state_dtype: of states and torques; engines compute in their own.

    Raises:
        ValueError: no envs, no such device, a dynamics of another scene, or a folder that
            cannot be written.
    """

    _supports_set_state = True
    _episode: Tensor
    _age: Tensor
    _keys: Tensor
    _offsets: Tensor
    _seed: Tensor

    @torch.inference_mode(False)
    def __init__(
        self,
        task: Task,
        dynamics: Dynamics,
        num_envs: int = 1,
        seed: int | None = None,
        device: torch.device | str = "cpu",
        dump_dir: Path | str | None = None,
        state_dtype: torch.dtype = torch.float64,
    ) -> None:
        expect_count(1, num_envs=num_envs)
        if state_dtype not in (torch.float32, torch.float64):
            raise ValueError(
                f"expected state_dtype torch.float32 or torch.float64, got {state_dtype!r}"
            )
        place = expect_device(str(device), state_dtype)
        super().__init__(device=place, batch_size=torch.Size([num_envs]))
        self.scene, self.task, self.dynamics = task.scene, task, dynamics
        self.model_name: str | None = None
        self._renderer = Renderer(task)
        self.guard = dynamics.guard if isinstance(dynamics, GuardedDynamics) else None
        self._transition = Transition(task, dynamics)
        inner = self._torch_dynamics
        self._is_differentiable = inner is not None and inner.differentiable
        about = {"scene": self.scene.name, "dynamics": type(dynamics).__name__}
        self.recorder = None if dump_dir is None else FaultRecorder(dump_dir, about)
        of = task, self._state_sizes, self.batch_size, self.device
        for name, spec in make_specs(*of, self.guard is not None, state_dtype):
            setattr(self, name, spec)
        zeros = torch.zeros(num_envs, dtype=state_dtype, device=self.device)
        self.register_buffer("_episode", zeros.long())
        self.register_buffer("_age", zeros.long())
        for key, size in self._state_sizes.items():  # (num_envs, size) each
            unset = zeros[:, None].repeat(1, size) * torch.nan  # until the first reset
            self.register_buffer(f"_state_{key}", unset)
        drawn = task.num_uniforms + self._state_sizes.get(PARAMETERS, 0)
        offsets = stream_offsets(drawn, self.device)
        self.register_buffer("_offsets", offsets, persistent=False)
        self.register_buffer("_keys", zeros.long(), persistent=False)
        self.register_buffer("_seed", zeros[0].long())
        self._shown: dict[str, Tensor] = {}  # what was handed out beside the state
        self._set_seed(seed)
        self.eager()

    def __repr__(self) -> str:
        model = "" if self.model_name is None else f", model={self.model_name!r}"
        return (
            f"{type(self).__name__}(task={task_id(self.task)!r}, "
            f"dynamics={type(self.dynamics).__name__}, kind={self.dynamics.kind!r}"
            f"{model}, num_envs={self.batch_size.numel()}, device={str(self.device)!r})"
        )

    def compile(self, *, warmup: int | None = None, **kwargs: Any) -> "SceneEnv":
        """Compile a step and a reset; returns the env itself.

        TorchRL calls it for ``compile=``. Without a compiler, eager with one warning.
        ``warmup`` eager steps come first, 1 where not given. ``kwargs`` are those of
        `torch.compile`; without mode, backend or options, those that suit the model.
        """
        suits: Mapping[str, Any] = {}
        if (inner := self._torch_dynamics) is not None:
            is_chosen = not kwargs.keys().isdisjoint(("mode", "backend", "options"))
            suits = {} if is_chosen else inner.compile_options
            # in parts on threads a model compiles its own step, the env what is round it
            inner.compile = not kwargs and inner.parts(self.batch_size.numel()) > 1
            self._transition.is_round = inner.compile
        options = {"warmup": 1 if warmup is None else warmup, **suits, **kwargs}
        is_whole = self.device.type != "cpu"  # as a graph of an accelerator has to be
        self._transit = self._transition.compile(is_whole, **options)
        self._restart = Compiled(self._transition.restart, what="a reset", **options)
        return self

    def eager(self) -> "SceneEnv":
        """Step without a compiler; returns the env itself."""
        if (inner := self._torch_dynamics) is not None:
            inner.compile = False
        self._transition.eager()
        self._transit = self._transition.step
        self._restart = self._transition.restart
        return self

    @property
    def _torch_dynamics(self) -> TorchDynamics | None:
        """The model that steps, guarded or not; None for an engine."""
        dynamics = self.dynamics
        dynamics = getattr(dynamics, "learned", dynamics)
        return dynamics if isinstance(dynamics, TorchDynamics) else None

    @property
    def _state_sizes(self) -> dict[str, int]:
        model, varied = self.scene.model, self.scene.variation
        own = {} if varied is None else {PARAMETERS: varied.size}
        return {QPOS: model.nq, QVEL: model.nv, **self.task.parameters, **own}

    def _input_td_has_state(self, tensordict: TensorDictBase | None) -> bool:
        return False  # a state is set only where ``set_state=True`` says so

    @property
    def seed(self) -> int:
        """Of the resets."""
        return int(self._seed)

    @unaffected
    def _set_seed(self, seed: int | None) -> None:
        """Begin each env's stream anew; without a seed one is drawn."""
        seed = secrets.randbits(SEED_BITS) if seed is None else seed
        if not isinstance(seed, Integral) or not 0 <= seed < MAX_SEED:
            raise ValueError(f"expected a seed from 0 to {MAX_SEED - 1}, got {seed!r}")
        self._seed = torch.full_like(self._seed, seed)
        self._keys = env_keys(seed, len(self._episode), self.device)
        self._episode = torch.zeros_like(self._episode)

    @unaffected
    def _load_from_state_dict(
        self, state_dict: Any, prefix: str, *args: Any, **kwargs: Any
    ) -> None:
        """Restore states, seed and episode counts; the history of every env starts empty.

        An empty one, which TorchRL's collectors keep of an env, changes nothing.
        """
        if not (state_dict or prefix):
            return
        # torch writes into these, which a state or a graph of gradients may share
        for name, value in self._buffers.items():
            self._buffers[name] = cast(Tensor, value).detach().clone()
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)
        self._shown = {}
        self._keys = env_keys(self.seed, len(self._episode), self.device)
        self.dynamics.reset(self.state)

    @property
    def state(self) -> TensorDict:
        """Current ``qpos``, ``qvel`` and task parameters; a copy."""
        return TensorDict(self._state(), self.batch_size, self.device).clone()

    def _state(self) -> dict[str, Tensor]:
        kept = cast(dict[str, Tensor], self._buffers)
        return {key: kept[f"_state_{key}"] for key in self._state_sizes}

    def _begin(
        self, state: dict[str, Tensor], is_reset: Tensor, given: dict[str, Tensor]
    ) -> dict[str, Tensor]:
        drawn = uniforms(self._keys, self._episode, self._offsets, state[QPOS].dtype)
        with self._gradients():
            return self._restart(state, is_reset, drawn, given)

    def _gradients(self) -> torch.set_grad_enabled:
        """None where the dynamics has none: compiled code is one, however called."""
        recorded = self._is_differentiable and torch.is_grad_enabled()
        return torch.set_grad_enabled(recorded)

    def _expect_begun(self, wanted: str) -> None:
        if not self._shown and self._state()[QPOS].isnan().any():
            raise RuntimeError(f"expected {wanted}, got envs without a state")

    @unaffected
    def _reset(
        self,
        tensordict: TensorDictBase | None = None,
        set_state: bool = False,
        **kwargs: object,
    ) -> TensorDict:
        every = torch.ones(self.batch_size, dtype=torch.bool, device=self.device)
        is_reset = every if tensordict is None else tensordict.get("_reset", every)
        if is_reset is not every and not (self._shown or is_reset.all()):
            self._expect_begun("all envs in the first reset")
        is_reset = is_reset.reshape(self.batch_size)  # (num_envs, 1) -> (num_envs,)
        old, given = self._state(), {}
        if set_state:
            sizes, dtype = self._state_sizes, old[QPOS].dtype
            given = given_state(self.scene, tensordict, is_reset, sizes, dtype)
        # nothing of the past is left: no gradients of it either
        if self._is_differentiable and is_reset.all():
            old, self._shown = {key: value.detach() for key, value in old.items()}, {}
        found = self._begin(old, is_reset, given)
        episode, age = self._episode + is_reset, self._age.masked_fill(is_reset, 0)
        column = is_reset[:, None]  # other envs were shown what they were
        found |= {k: torch.where(column, found[k], x) for k, x in self._shown.items()}
        result = self._hand_out(found, {"_episode": episode, "_age": age})
        self.dynamics.reset(result, is_reset)
        return self._seen(result)

    @unaffected
    def warm_up(self, history: TensorDictBase) -> None:
        """Show the dynamics a recorded past, see `Transition.warm_up`."""
        self._transition.warm_up(history, self.batch_size.numel())

    @unaffected
    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        state, moves = self._state(), tensordict.get("_step", None)
        self._expect_begun("reset() before the first step")
        action, expected = tensordict[ACTION], tuple(self.action_spec.shape)
        if (got := tuple(action.shape)) != expected:
            raise ValueError(f"expected an action of shape {expected}, got {got}")
        held = None if moves is None else ~moves.reshape(self.batch_size)
        past = None if held is None else self.dynamics.history()
        with self._gradients():
            found, age = self._transit(state, action, self._age), self._age + 1
        if held is not None:
            self.dynamics.restore(past, held)
            found = self._hold(found, held, tensordict)
            age = torch.where(held, self._age, age)
        if self.recorder is not None:
            self.recorder.record(state, action, found, self._age)
        return self._seen(self._hand_out(found, {"_age": age}))

    def _hold(
        self, found: dict[str, Tensor], is_held: Tensor, tensordict: TensorDictBase
    ) -> dict[str, Tensor]:
        """``found``, but held envs are as they were before the step and earn nothing.

        Flags are those of ``tensordict``; what else it holds a transform may have changed.
        """
        state, held = self._state(), is_held[:, None]
        shown = {**state, **(self._shown or self._begin(state, is_held & False, {}))}
        shown |= {flag: tensordict.get(flag, held & False) for flag in FLAGS}
        return {k: torch.where(held, shown.get(k, 0.0), v) for k, v in found.items()}

    def _hand_out(
        self, found: dict[str, Tensor], counts: dict[str, Tensor]
    ) -> TensorDict:
        """Keep the state and hand out all, in a tensordict that shares no memory."""
        kept = self._buffers  # setting a module's attributes costs more than sums
        kept.update(counts)
        for key in self._state_sizes:
            # compiled code that got another layout in memory would be compiled again
            kept[f"_state_{key}"] = own = found[key].contiguous()
            found[key] = own.clone()
        if not self.guard:
            found.pop(TRUST, None)
        beside = OBSERVATION, *drive_sizes(self.task), FAULT, TRUST
        self._shown = {key: found[key] for key in beside if key in found}
        found |= {key: x.clone() for key, x in self._shown.items()}
        return tensordict_of(found, self.batch_size, self.device)
