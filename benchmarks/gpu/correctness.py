"""Stage a: every shipped model on the device is what it is on the CPU."""

from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.envs.utils import check_env_specs

from gpu.graphs import half
from gpu.stages import Item, Setup, farthest
from torchrl_nerd import NeRDEnv
from torchrl_nerd.checkpoint import from_pretrained, shipped_models
from torchrl_nerd.dynamics import MujocoDynamics, NeRDDynamics
from torchrl_nerd.envs.base import SceneEnv
from torchrl_nerd.evaluation.rollout_error import passive_errors
from torchrl_nerd.keys import FAULT, QPOS
from torchrl_nerd.modules.nerd import NeRD
from torchrl_nerd.modules.transformer import CausalTransformer
from torchrl_nerd.robots import TASKS, make_task, source_of

FIRST = ("ant", "ant-mlp", "cartpole", "anymal-mlp")  # in order of worth


def items(setup: Setup) -> dict[str, Item]:
    """Steps without a host, then one item for every learned or hybrid model."""
    names = [*FIRST, *(x for x in shipped_models() if x not in FIRST)]
    names = setup.pick(names, names[2:3])
    found: dict[str, Item] = {
        f"env {task}": lambda task=task: check_env(task, setup)
        for task in setup.pick(("ant/run", "cartpole/swingup"), ("cartpole/swingup",))
    }
    found |= {f"model {x}": lambda x=x: check_model(x, setup) for x in names}
    return found


def check_env(task: str, setup: Setup) -> dict[str, Any]:
    """Steps that wait for nothing, resets of some, a NaN, specs, and a collector."""
    rows, steps = setup.pick((256, 50), (4, 3))
    ours, theirs = (_env(task, rows, x, setup) for x in (setup.device, "cpu"))
    actions = [ours.action_spec.rand() for _ in range(steps)]
    difference = 0.0
    one, other = ours.reset(), theirs.reset()
    for number, action in enumerate(actions):
        one = _act(ours, one, action, number, setup.is_gpu)
        other = _act(theirs, other, action.cpu(), number, False)
        difference = max(difference, farthest(one, other))
    broken = actions[0].clone()
    broken[0] = torch.nan
    before = ours.state[QPOS][0]
    after = ours.step(one.clone().set("action", broken))["next"]
    is_kept = torch.equal(after[QPOS][0], before) and int(after[FAULT][0, 0]) == 1
    is_alone = bool((after[FAULT][1:] == 0).all()) and after[QPOS].isfinite().all()
    check_env_specs(_env(task, rows, setup.device, setup))
    frames = 4 * rows
    env = _env(task, rows, setup.device, setup)
    how = {"frames_per_batch": frames, "total_frames": frames}
    (batch,) = Collector(env, None, auto_register_policy_transforms=False, **how)
    return {
        "apart_m_or_rad": difference,
        "nan_stays_alone": bool(is_kept and is_alone),
        "specs": True,
        "collected": batch.numel(),
        "device": str(batch.device),
    }


def _env(task: str, rows: int, device: Any, setup: Setup) -> SceneEnv:
    return NeRDEnv(task, num_envs=rows, seed=setup.seed, device=device)


def _act(
    env: SceneEnv, now: TensorDict, action: Tensor, number: int, is_strict: bool
) -> TensorDict:
    """A step and a reset of some envs; with ``is_strict`` what waits for a GPU raises."""
    rows = torch.arange(len(action), device=action.device)[:, None] % 7 == number % 7
    if is_strict:
        torch.cuda.set_sync_debug_mode("error" if number > 1 else "default")
    try:
        after = env._step(now.set("action", action))
        return env._reset(after.set("_reset", rows))
    finally:
        if is_strict:
            torch.cuda.set_sync_debug_mode("default")


def check_model(name: str, setup: Setup) -> dict[str, Any]:
    """Errors against MuJoCo on CPU and device, in float32 and bf16; both ways to infer."""
    model, here = (from_pretrained(name) for _ in range(2))
    if not isinstance(model, NeRD) or not isinstance(here, NeRD):
        return {"kind": model.kind}
    scene, count = model.scene, setup.pick(64, 4)
    tasks = [x for x in TASKS if make_task(x).scene.hash == scene.hash]
    source = source_of(scene) if not tasks else make_task(tasks[0])
    here = here.to(setup.device)
    horizon = setup.pick(50, 3)

    def error(dynamics: NeRDDynamics, device: Any) -> dict[str, float]:
        given = source, dynamics, MujocoDynamics(scene), [horizon], count, setup.seed
        return {k: x.mean for k, x in passive_errors(*given, device)[horizon].items()}

    found: dict[str, Any] = {
        "kind": model.kind,
        "horizon": horizon,
        "cpu_float32": error(NeRDDynamics(model), "cpu"),
        "float32": error(NeRDDynamics(here), setup.device),
        "bf16_inside": error(half(here), setup.device),
    }
    if isinstance(here.network, CausalTransformer):
        found["streaming_apart"] = _streaming(here, setup)
    return found


@torch.no_grad()
def _streaming(model: NeRD, setup: Setup) -> float:
    """Largest relative difference of outputs token by token and of the whole sequence."""
    rows, length = setup.pick((64, 40), (2, 12))
    how = {"device": setup.device, "dtype": model.dtype}
    tokens = torch.randn(rows, length, model.token_size, **how)
    network, outputs = model.network, []
    memory = network.empty_memory(rows)  # pyright: ignore
    for t in range(length):
        outputs.append(network.step(tokens[:, t], memory))  # pyright: ignore
    whole = network(tokens)
    return float((torch.stack(outputs, 1) - whole).abs().max() / whole.abs().max())
