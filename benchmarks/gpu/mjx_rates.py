"""Stage c: the same robots in MJX on the same GPU, and its error at fewer substeps."""

import copy
import os
import time
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from importlib.util import find_spec
from typing import Any

import mujoco
import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from gpu.rates import states
from gpu.stages import Item, Setup, rate
from torchrl_nerd import load_scene, make_env
from torchrl_nerd.dynamics import Dynamics, MujocoDynamics
from torchrl_nerd.dynamics.mujoco_warp import is_warp_installed
from torchrl_nerd.evaluation.rollout_error import passive_errors
from torchrl_nerd.keys import QPOS, QVEL
from torchrl_nerd.robots import source_of
from torchrl_nerd.scenes import Scene

SCENES = ("ant", "cartpole", "anymal", "franka")
SIZES = (4096, 16384, 512, 65536)
os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")  # torch is there too


def is_installed() -> bool:
    """Whether JAX and MJX can be imported."""
    return find_spec("jax") is not None and find_spec("mujoco.mjx") is not None


def items(setup: Setup) -> dict[str, Item]:
    """Rates at the scene's substeps, then errors and rates at fewer ones."""
    names, sizes = setup.pick((SCENES, SIZES), (("cartpole",), (4,)))
    found: dict[str, Item] = {"compile": lambda: compile_all(names, sizes[:1])}
    for size in sizes[:2]:
        for name in names:
            found[f"MJX {name}, {size}"] = lambda n=name, s=size: mjx_rate(n, s, setup)
    for name in setup.pick(("ant", "cartpole"), names):
        full = load_scene(name).substeps
        for substeps in [k for k in (1, 2, 4, 8) if k < full]:
            found[f"MJX {name}, {substeps} substeps"] = lambda n=name, k=substeps: (
                mjx_front(n, k, sizes[0], setup)
            )
    for size in sizes[2:]:
        for name in names:
            found[f"MJX {name}, {size}"] = lambda n=name, s=size: mjx_rate(n, s, setup)
    if is_warp_installed() and setup.is_gpu:
        found["MuJoCo Warp ant, 4096"] = lambda: warp_rate("ant/run", 4096, setup)
    return found


def compile_all(names: tuple[str, ...], sizes: tuple[int, ...]) -> dict[str, float]:
    """Seconds to compile each robot and size; side by side, as they need the host alone."""
    given = [(name, size) for size in sizes for name in names]
    with ThreadPoolExecutor(len(given)) as pool:
        seconds = pool.map(lambda x: _compiled(load_scene(x[0]), x[1])[1], given)
    return {
        f"{name}, {size}": s for (name, size), s in zip(given, seconds, strict=True)
    }


class MjxDynamics(Dynamics):
    """MJX as dynamics, float32 as on its GPUs; states pass through the host.

    Args:
        scene: the robot.

    Raises:
        ValueError: naming what MJX cannot simulate.
    """

    kind = "ground truth"

    def __init__(self, scene: Scene) -> None:
        if scene.terrain is not None and scene.terrain.is_per_env:
            raise ValueError(f"MJX: no ground per env, which '{scene.name}' has")
        super().__init__(scene)
        self.advance = _advance(scene)

    def step(
        self,
        state: TensorDictBase,
        joint_torque: Tensor,
        terrain: Tensor | None = None,
        ctrl: Tensor | None = None,
    ) -> TensorDictBase:
        """See `Dynamics.step`."""
        given = (state[QPOS], state[QVEL], joint_torque)
        found = self.advance(*(np.asarray(x.cpu().float()) for x in given))
        qpos, qvel = (torch.tensor(np.asarray(x)) for x in found)
        after = {QPOS: qpos, QVEL: qvel}
        return TensorDict(after, state.batch_size).to(state[QPOS].device).double()


@cache
def _advance(scene: Scene) -> Any:
    """One control step of a batch, jitted: ``qpos, qvel, torque -> qpos, qvel``."""
    import jax
    from mujoco import mjx

    robot = copy.copy(scene.model)
    if (
        scene.terrain is None
    ):  # MJX 3.17 fails at elliptic cones where nothing can touch
        robot.opt.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
    try:
        model = mjx.put_model(robot)
    except NotImplementedError as error:
        raise ValueError(f"MJX cannot simulate '{scene.name}': {error}") from None
    start = mjx.make_data(model)
    dofs = np.array(scene.actuated, int)

    def one(qpos: Any, qvel: Any, torque: Any) -> Any:
        force = start.qfrc_applied.at[dofs].set(torque)
        data = start.replace(qpos=qpos, qvel=qvel, qfrc_applied=force)
        data, _ = jax.lax.scan(
            lambda d, _: (mjx.step(model, d), None), data, None, scene.substeps
        )
        return data.qpos, data.qvel

    return jax.jit(jax.vmap(one))


@cache
def _compiled(scene: Scene, size: int) -> tuple[Any, float]:
    """`_advance` for so many envs, and the seconds that compiling it took."""
    import jax

    layout = scene.layout
    widths = layout.nq, layout.nv, len(scene.actuated)
    given = [jax.ShapeDtypeStruct((size, width), "float32") for width in widths]
    began = time.perf_counter()
    advance = MjxDynamics(scene).advance.lower(*given).compile()
    return advance, time.perf_counter() - began


def mjx_rate(
    name: str, size: int, setup: Setup, substeps: int | None = None
) -> dict[str, Any]:
    """Control steps per second; the time to compile counts apart."""
    import jax

    scene = load_scene(name)
    scene = scene if substeps is None else scene.with_substeps(substeps)
    advance, seconds = _compiled(scene, size)
    state = states(load_scene(name), size, setup).cpu()
    given = [jax.numpy.asarray(state[k].numpy(), "float32") for k in (QPOS, QVEL)]
    torque = jax.numpy.zeros((size, len(scene.actuated)), "float32")
    last = {"now": jax.block_until_ready(advance(*given, torque))}

    def step() -> None:
        last["now"] = jax.block_until_ready(advance(*last["now"], torque))

    found = rate(step, setup, warmup=1)
    return {
        "steps_per_s": size * found["per_s"],
        "spread": found["spread"],
        "substeps": scene.substeps,
        "compile_s": seconds,
        "platform": jax.devices()[0].platform,
    }


def mjx_front(name: str, substeps: int, size: int, setup: Setup) -> dict[str, Any]:
    """Rate and error at so many substeps, against MuJoCo at the scene's own."""
    scene, horizon = load_scene(name), setup.pick(100, 2)
    given = MjxDynamics(scene.with_substeps(substeps)), MujocoDynamics(scene)
    count = setup.pick(256, 4)
    errors = passive_errors(source_of(scene), *given, [horizon], count, setup.seed)
    error = {f"error_{k}": x.mean for k, x in errors[horizon].items()}
    return mjx_rate(name, size, setup, substeps) | error | {"horizon": horizon}


def warp_rate(task: str, size: int, setup: Setup) -> dict[str, Any]:
    """Control steps per second of MuJoCo Warp."""
    env = make_env(task, "mujoco_warp", size, setup.seed, setup.device)
    state = env.reset().select(QPOS, QVEL)
    torque = torch.zeros(size, len(env.scene.actuated)).to(state[QPOS])
    found = rate(lambda: env.dynamics.step(state, torque), setup)
    return {"steps_per_s": size * found["per_s"], "spread": found["spread"]}
