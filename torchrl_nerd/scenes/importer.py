"""Third-party robots: MJCF files, the dm_control suite, Gymnasium's MuJoCo environments.

All give a compiled model and a control step; the controller and the ranges of training
follow from the model, see `scenes.ranges`.
"""

import ast
import os
import warnings
from importlib.util import find_spec
from math import isfinite
from numbers import Real
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from torchrl_nerd.scenes.contact_points import terrain_geoms
from torchrl_nerd.scenes.support import silence_mujoco

if TYPE_CHECKING:
    from dm_control.rl.control import Environment

CONTROL_STEP = 0.02  # s, where nobody says
CONTACT_FIELDS = (
    *("conaffinity", "condim", "contype", "friction", "gap", "margin", "pos"),
    *("priority", "quat", "solimp", "solmix", "solref"),
)
"""Of a plane that is added: where it lies and how it touches."""


def read_mjcf(
    path: Path, control_step: float | None, terrain: str | None = None
) -> tuple[mujoco.MjModel, int]:
    """Model and substeps of an MJCF file, at a control step or the one nearest to 0.02 s.

    With terrain ``"plane"`` level ground is added to it.

    Raises:
        ValueError: in one sentence, no file, MuJoCo's complaint, numbers that are not
            finite, a control step of no whole number of timesteps, or ground that cannot
            be added.
    """
    if not path.is_file():
        raise ValueError(f"expected an MJCF file, found none at {path}")
    if terrain not in (None, "plane"):
        raise ValueError(f"expected terrain 'plane' or None, got {terrain!r}")
    try:
        with silence_mujoco() as warned:
            model = mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        complaint = " ".join(str(error).split())
        raise ValueError(f"MuJoCo cannot compile {path}: {complaint}") from None
    if any("NaN" in warning for warning in warned):
        raise ValueError(f"expected finite numbers in {path}, got NaN")
    if odd := _not_finite(model):
        raise ValueError(
            f"expected finite numbers of a possible size in {path}, whose compiled "
            f"{', '.join(odd)} are not finite"
        )
    if terrain is not None:
        if terrain_geoms(model):
            raise ValueError(f"expected no ground beside a plane in {path}, got some")
        spec = mujoco.MjSpec.from_file(str(path))
        plane = mujoco.mjtGeom.mjGEOM_PLANE
        usual = mujoco.MjSpec().worldbody.add_geom()  # whatever the file's default is
        about = {name: getattr(usual, name) for name in CONTACT_FIELDS}
        added = spec.worldbody.add_geom(type=plane, size=(0.0, 0.0, 1.0), **about)
        added.alt.type = usual.alt.type  # orientations besides quat
        added.fromto, added.meshname, added.hfieldname = usual.fromto, "", ""
        model = spec.compile()
        if not terrain_geoms(model):
            raise ValueError(
                f"expected shapes that can touch a plane in {path}, got none"
            )
    timestep = model.opt.timestep
    if control_step is None:
        return model, max(1, round(CONTROL_STEP / timestep))
    is_number = isinstance(control_step, Real) and isfinite(control_step)
    substeps = round(control_step / timestep) if is_number else 0
    if substeps < 1 or abs(substeps * timestep - control_step) > 1e-9:
        raise ValueError(
            f"expected a control step of whole timesteps of {timestep} s, "
            f"got {control_step!r} s"
        )
    return model, substeps


def _not_finite(model: mujoco.MjModel) -> list[str]:
    """Names of the numbers of a compiled model that are not finite."""
    return [
        name
        for owner in (model, model.opt)
        for name in dir(owner)
        if not name.startswith("_")
        and (value := np.asarray(getattr(owner, name))).dtype.kind == "f"
        and not np.isfinite(value).all()
    ]


def suite_name(name: str) -> tuple[str, str, int]:
    """Domain and task of ``dm_control/DOMAIN-TASK``, and 1 or what ``/HOLD`` adds.

    Raises:
        ValueError: a HOLD that is no whole number from 1 on.
    """
    robot, slash, hold = name.removeprefix("dm_control/").partition("/")
    domain, _, task = robot.partition("-")
    if slash and not (hold.isdecimal() and int(hold) > 0):
        raise ValueError(
            f"expected dm_control/DOMAIN-TASK/HOLD with a HOLD from 1 on, got '{name}'"
        )
    return domain, task, int(hold or 1)


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
            f"unknown {'task' if tasks else 'domain'} in "
            f"'dm_control/{domain}{'-' if task else ''}{task}', "
            f"expected one of {', '.join(known)}"
        )
    return suite.load(domain, task, task_kwargs={"random": 0})


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
    settings, source = _constructor_defaults(str(spec.entry_point))
    settings |= spec.kwargs
    if not isinstance(settings.get("xml_file"), str) or "frame_skip" not in settings:
        wanted = "an environment of Gymnasium with an xml_file and a frame_skip"
        raise ValueError(
            f"expected {wanted}, as those of version 5 have, got '{env_id}'"
        )
    file = os.path.expanduser(settings["xml_file"])
    return source.parent / "assets" / file, int(settings["frame_skip"])


def _constructor_defaults(entry_point: str) -> tuple[dict[str, Any], Path]:
    """Plain default arguments of the class at ``module:Class``, and its source file."""
    module, _, name = entry_point.partition(":")
    package, *rest = module.split(".")
    found = find_spec(package)
    folders = found.submodule_search_locations if found else None
    source = Path(folders[0], *rest).with_suffix(".py") if folders else Path()
    tree = ast.parse(source.read_text(encoding="utf-8") if source.is_file() else "")
    classes = (node for node in ast.walk(tree) if isinstance(node, ast.ClassDef))
    for part in (part for node in classes if node.name == name for part in node.body):
        if isinstance(part, ast.FunctionDef) and part.name == "__init__":
            names, values = part.args.args, part.args.defaults
            pairs = zip(names[len(names) - len(values) :], values, strict=True)
            plain = ((n.arg, v) for n, v in pairs if isinstance(v, ast.Constant))
            return {n: v.value for n, v in plain}, source
    return {}, source
