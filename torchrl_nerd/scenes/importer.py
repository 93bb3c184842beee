"""Third-party robots: MJCF files, the dm_control suite, Gymnasium's MuJoCo environments.

All give a compiled model and a control step; everything else is read from the model.
"""

import ast
import os
import warnings
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import mujoco

from torchrl_nerd.scenes.actuators import ActuatorController
from torchrl_nerd.scenes.controllers import Controller
from torchrl_nerd.scenes.ranges import default_sampling
from torchrl_nerd.scenes.sampling import Sampling
from torchrl_nerd.scenes.support import check_supported

if TYPE_CHECKING:
    from dm_control.rl.control import Environment

CONTROL_STEP = 0.02  # s, where nobody says


class Imported(NamedTuple):
    """The fields of a `Scene`, in its order."""

    name: str
    model: mujoco.MjModel
    substeps: int
    controller: Controller
    sampling: Sampling


def import_mjcf(
    path: str | Path, control_step: float | None = None, **ranges: Any
) -> Imported:
    """See `Scene.from_mjcf`.

    Raises:
        ValueError: a control step of no whole number of timesteps; see `read_model`.
    """
    model = compile_mjcf(Path(path))
    timestep = model.opt.timestep
    if control_step is None:
        control_step = timestep * max(1, round(CONTROL_STEP / timestep))
    substeps = round(control_step / timestep)
    if substeps < 1 or abs(substeps * timestep - control_step) > 1e-9:
        raise ValueError(
            f"expected a control step of whole timesteps of {timestep} s, "
            f"got {control_step} s"
        )
    return read_model(str(path), model, substeps, ranges)


def import_dm_control(domain: str, task: str, **ranges: Any) -> Imported:
    """See `Scene.from_dm_control`."""
    env = load_suite(domain, task)
    model = env.physics.model.ptr
    substeps = round(env.control_timestep() / model.opt.timestep)
    return read_model(f"dm_control/{domain}-{task}", model, substeps, ranges)


def load_suite(domain: str, task: str) -> "Environment":
    """The dm_control suite's own environment of a task.

    dm_control is imported here, on first use: it looks for a display and says so.

    Raises:
        ValueError: no such domain or task.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from dm_control import suite
    if (domain, task) not in suite.ALL_TASKS:
        tasks = [t for d, t in suite.ALL_TASKS if d == domain]
        known = tasks or dict.fromkeys(d for d, _ in suite.ALL_TASKS)
        raise ValueError(
            f"unknown {'task' if tasks else 'domain'} in 'dm_control/{domain}-{task}', "
            f"expected one of {', '.join(known)}"
        )
    return suite.load(domain, task, task_kwargs={"random": 0})


def import_gymnasium(env_id: str, **ranges: Any) -> Imported:
    """See `Scene.from_gymnasium`."""
    path, frame_skip = gymnasium_file(env_id)
    return read_model(f"gymnasium/{env_id}", compile_mjcf(path), frame_skip, ranges)


def read_model(
    name: str, model: mujoco.MjModel, substeps: int, ranges: dict[str, Any]
) -> Imported:
    """A scene's parts from a compiled model.

    Raises:
        ValueError: the model has something that is not supported (named).
    """
    check_supported(name, model)
    controller = ActuatorController.from_model(model)
    sampling = default_sampling(model, controller, **ranges)
    return Imported(name, model, substeps, controller, sampling)


def compile_mjcf(path: Path) -> mujoco.MjModel:
    """The model in an MJCF file.

    Raises:
        ValueError: in one sentence, no file, or MuJoCo's complaint.
    """
    if not path.is_file():
        raise ValueError(f"expected an MJCF file, found none at {path}")
    try:
        return mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        complaint = " ".join(str(error).split())
        raise ValueError(f"MuJoCo cannot compile {path}: {complaint}") from None


def gymnasium_file(env_id: str) -> tuple[Path, int]:
    """MJCF file and frame skip of a registered environment.

    Both are read from the source: importing it needs OpenGL.

    Raises:
        ValueError: no Gymnasium, no such environment, or one that names no MJCF file.
    """
    try:
        from gymnasium.envs.registration import registry
    except ImportError:
        raise ValueError(
            "expected Gymnasium to read its robots: `pip install gymnasium`"
        ) from None
    if env_id not in registry:
        raise ValueError(f"unknown environment '{env_id}' of Gymnasium")
    spec = registry[env_id]
    settings, source = _constructor_defaults(spec.entry_point)
    settings |= spec.kwargs
    if not {"xml_file", "frame_skip"} <= settings.keys():
        raise ValueError(
            f"expected an environment of Gymnasium with an xml_file and a frame_skip, "
            f"as those of version 5 have, got '{env_id}'"
        )
    file = os.path.expanduser(settings["xml_file"])
    return source.parent / "assets" / file, int(settings["frame_skip"])


def _constructor_defaults(entry_point: object) -> tuple[dict[str, Any], Path]:
    """Default arguments of the class at ``module:Class``, and its source file."""
    if not isinstance(entry_point, str):
        return {}, Path()
    module, _, name = entry_point.partition(":")
    package, *rest = module.split(".")
    found = find_spec(package)
    folders = found.submodule_search_locations if found else None
    source = Path(folders[0], *rest).with_suffix(".py") if folders else Path()
    if not source.is_file():
        return {}, source
    for node in ast.walk(ast.parse(source.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ClassDef) and node.name == name:
            for part in node.body:
                if isinstance(part, ast.FunctionDef) and part.name == "__init__":
                    return _defaults(part.args), source
    return {}, source


def _defaults(args: ast.arguments) -> dict[str, Any]:
    """Plain default values of a function's arguments."""
    names = [arg.arg for arg in args.args][len(args.args) - len(args.defaults) :]
    pairs = zip(names, args.defaults, strict=True)
    return {n: value.value for n, value in pairs if isinstance(value, ast.Constant)}
