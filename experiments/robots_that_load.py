"""Which third-party robots load, and whether their ground truth is MuJoCo itself.

    python experiments/robots_that_load.py --json results/robots_that_load.json

Over the third-party robots in ``shared/robots``, Gymnasium's MuJoCo environments of version
5, the robots of the dm_control suite, and MJCF files in folders that are named:

    python experiments/robots_that_load.py --folder robosuite/models/assets/robots

For each: what refuses it, or its contact points and how far its shapes reach beyond them;
the largest difference of the ground truth from plain ``mj_step`` over 50 control steps of
random controls; the share of random training trajectories of 100 control steps that leave
the bounds, and the speeds that 99% of the states of the others stay below.
"""

import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import gymnasium
import mujoco
import numpy as np
import torch
import tyro
from tensordict import TensorDict

from torchrl_nerd.data.simulate import is_sound, simulate
from torchrl_nerd.dynamics import MujocoDynamics
from torchrl_nerd.evaluation.results import write_results
from torchrl_nerd.geometry.manifold import FREE, SLIDE
from torchrl_nerd.keys import QPOS, QVEL
from torchrl_nerd.robots import load_scene
from torchrl_nerd.scenes import Scene
from torchrl_nerd.scenes.controllers import ActuatorController
from torchrl_nerd.scenes.support import silence_mujoco

SHARED = Path(__file__).parents[2] / "shared" / "robots"
ROWS, STEPS = 64, 100  # random trajectories, control steps
CHECKED, COMPARED = 4, 50  # of these, compared with plain MuJoCo


@dataclass
class Options:
    """Which robots."""

    folder: tuple[Path, ...] = ()
    """Folders with further MJCF files, searched to any depth."""
    match: str = ""
    """Only robots whose name has this in it."""
    seed: int = 0
    """Of starts and controls."""
    json: Path | None = None
    """Write the results to this file."""


def robots(folders: tuple[Path, ...]) -> Iterator[tuple[str, str]]:
    """Source and name, or path, of every robot."""
    for path in sorted(SHARED.glob("*/*.xml")):
        yield "shared", str(path)
    for name, spec in sorted(gymnasium.envs.registry.items()):
        if name.endswith("-v5") and "mujoco" in str(spec.entry_point):
            yield "gymnasium", f"gymnasium/{name}"
    from dm_control import suite

    for domain, task in suite.ALL_TASKS:
        yield "dm_control", f"dm_control/{domain}-{task}"
    for folder in folders:
        for path in sorted(folder.rglob("*.xml")):
            if is_whole(path):
                yield folder.name, str(path)


def is_whole(path: Path) -> bool:
    """Whether MuJoCo compiles a file, and something in it moves."""
    try:
        return mujoco.MjModel.from_xml_path(str(path)).njnt > 0
    except ValueError:
        return False


def difference(scene: Scene, generator: torch.Generator) -> float:
    """Largest difference of states from plain ``mj_step``, m, rad, m/s and rad/s."""
    start, _ = scene.sample_initial(CHECKED, generator)
    size = CHECKED, COMPARED, scene.controller.num_actions
    action = 2.0 * torch.rand(size, generator=generator).double() - 1.0
    ctrl = cast(ActuatorController, scene.controller).ctrl(action)
    dynamics = MujocoDynamics(scene, num_threads=1)
    state = TensorDict({key: start[key] for key in (QPOS, QVEL)}, [CHECKED])
    dynamics.reset(state)
    path, worst = dynamics.rollout(state, None, start.get("terrain"), ctrl), 0.0
    for row in range(CHECKED):
        data = mujoco.MjData(scene.model)
        data.qpos, data.qvel = start[QPOS][row], start[QVEL][row]
        for step in range(COMPARED):
            data.ctrl = ctrl[row, step]
            mujoco.mj_step(scene.model, data, scene.substeps)
            if data.warning.number.any():
                break  # MuJoCo gave up on it, here and there
            for key, want in ((QPOS, data.qpos), (QVEL, data.qvel)):
                gap = np.abs(path[key][row, step].numpy() - np.asarray(want))
                worst = max(worst, float(gap.max()))
    return worst


def speeds(scene: Scene, qvel: torch.Tensor) -> dict[str, float]:
    """99th percentile of all speeds, of linear ones (m/s) and of turning ones (rad/s)."""
    model, joints = scene.model, scene.model.dof_jntid
    is_linear = model.jnt_type[joints] == SLIDE
    at_free = np.arange(model.nv) - model.jnt_dofadr[joints] < 3
    is_linear |= (model.jnt_type[joints] == FREE) & at_free
    found = {}
    for name, chosen in (("m_per_s", is_linear), ("rad_per_s", ~is_linear)):
        if chosen.any() and len(qvel):
            some = qvel[..., torch.from_numpy(chosen)].abs().flatten()
            found[name] = float(np.quantile(some.numpy(), 0.99))
    return found


def measure(name: str, seed: int) -> dict[str, Any]:
    """Everything about one robot, or the sentence that refuses it."""
    generator = torch.Generator().manual_seed(seed)
    try:
        scene = load_scene(name)
        data = simulate(scene, ROWS, STEPS, generator)
    except ValueError as error:
        return {"loads": False, "why": str(error)}
    sound = is_sound(data)
    return {
        "loads": True,
        "joints": int(scene.model.njnt),
        "props": len(scene.base.others),
        "contact_points": len(scene.contacts),
        "contact_error_m": scene.contacts.error,
        "difference": difference(scene, generator),
        "dropped": float((~sound).double().mean()),
        "speed_p99": speeds(scene, cast(TensorDict, data[sound])["next", QVEL]),
    }


def main(options: Options) -> None:
    """Measure all robots and say so as they come."""
    rows, seen = [], set()
    for source, name in robots(options.folder):
        if options.match not in name:
            continue
        with silence_mujoco():
            row = measure(name, options.seed)
        short = Path(name)
        is_file = short.suffix == ".xml"
        label = f"{short.parent.name}/{short.stem}" if is_file else name.split("/")[1]
        robot = label.partition("-")[0], str({**row, "why": None})
        if source == "dm_control" and robot in seen:
            continue  # another task of the same robot
        seen.add(robot)
        rows.append({"source": source, "robot": label, **row})
        print(*(f"{k}={v}" for k, v in rows[-1].items()), flush=True)
    print(f"{sum(row['loads'] for row in rows)} of {len(rows)} load")
    if options.json:
        write_results(options.json, rows, options.seed)


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    main(tyro.cli(Options))
