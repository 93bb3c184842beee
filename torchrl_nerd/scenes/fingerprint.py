"""What a fingerprint of the physics is made of.

Most models leave much of MuJoCo at its defaults. What is at its default adds nothing, so
that a new entry here changes the fingerprint of those robots alone that it concerns.
"""

import hashlib

import mujoco
import numpy as np

from torchrl_nerd.scenes.contact_points import ground_geoms

ALWAYS = (
    *("body_parentid", "body_pos", "body_quat", "body_mass", "body_inertia"),
    *("body_ipos", "body_iquat", "jnt_type", "jnt_pos", "jnt_axis", "jnt_range"),
    *("jnt_limited", "jnt_stiffness", "jnt_solref", "jnt_solimp", "dof_armature"),
    *("dof_damping", "dof_frictionloss", "geom_type", "geom_size", "geom_pos"),
    *("geom_quat", "geom_friction", "geom_solref", "geom_solimp", "geom_contype"),
    *("geom_conaffinity", "geom_condim", "geom_margin", "geom_gap", "geom_solmix"),
    *("geom_priority", "jnt_margin", "actuator_trnid", "actuator_gear", "qpos0"),
)
RARELY = {
    **dict.fromkeys(("body_gravcomp", "jnt_stiffnesspoly", "dof_dampingpoly"), 0.0),
    **dict.fromkeys(("geom_fluid", "geom_adhesion", "geom_surfacevel"), 0.0),
    **dict.fromkeys(("mesh_vert", "hfield_size", "hfield_data"), 0.0),
    **dict.fromkeys(("pair_geom1", "pair_geom2", "pair_dim", "pair_solref"), -1.0),
    **dict.fromkeys(("pair_solimp", "pair_friction", "pair_margin"), -1.0),
    **dict.fromkeys(("pair_gap", "exclude_signature"), -1.0),
    **dict.fromkeys(("tendon_stiffness", "tendon_damping", "tendon_armature"), 0.0),
    **dict.fromkeys(("tendon_stiffnesspoly", "tendon_dampingpoly"), 0.0),
    **dict.fromkeys(("tendon_frictionloss", "tendon_limited"), 0.0),
    **dict.fromkeys(("eq_obj1id", "eq_obj2id", "eq_type", "eq_objtype"), -1.0),
    **dict.fromkeys(("eq_data", "eq_active0", "eq_solref", "eq_solimp"), -1.0),
    **dict.fromkeys(("actuator_gaintype", "actuator_biastype"), 0.0),
    **dict.fromkeys(("actuator_biasprm", "actuator_ctrllimited"), 0.0),
    **dict.fromkeys(("actuator_ctrlrange", "actuator_trntype"), 0.0),
    **dict.fromkeys(("actuator_forcelimited", "actuator_forcerange"), 0.0),
    **dict.fromkeys(("actuator_cranklength", "actuator_armature"), 0.0),
    **dict.fromkeys(("actuator_damping", "actuator_dampingpoly"), 0.0),
    "pair_solreffriction": 0.0,
    **dict.fromkeys(("jnt_actfrclimited", "jnt_actfrcrange", "jnt_actgravcomp"), 0.0),
    "actuator_gainprm": (1.0, *(9 * [0.0])),
    "dof_solref": (0.02, 1.0),
    "dof_solimp": (0.9, 0.95, 0.001, 0.5, 2.0),
}
"""Arrays and the value of which each of their entries is by default."""

TENDONS = (
    *("tendon_num", "tendon_range", "tendon_lengthspring", "tendon_solref_lim"),
    *("tendon_solimp_lim", "tendon_solref_fri", "tendon_solimp_fri", "tendon_margin"),
    *("wrap_type", "wrap_objid", "wrap_prm", "site_pos", "site_quat"),
)
"""Of tendons, where one acts by itself or is bound."""
ON_SITES = tuple(
    int(getattr(mujoco.mjtTrn, f"mjTRN_{kind}")) for kind in ("SITE", "SLIDERCRANK")
)
SOLVER = ("solver", "iterations", "noslip_iterations", "enableflags")  # no tolerances
GROUND = (
    *("geom_bodyid", "body_mocapid", "geom_dataid"),
    *("hfield_nrow", "hfield_ncol", "hfield_adr"),
)
"""Of a ground that is more than one plane; a lone plane has nothing to say here."""
NUMBERED = ("mesh", "hfield", "pair", "exclude")
"""Of the ground too, or naming bodies and shapes by numbers that depend on it."""
OVERRIDES = ("o_margin", "o_solref", "o_solimp", "o_friction")


def fingerprint(model: mujoco.MjModel, substeps: int) -> str:
    """Hash of all that decides a control step: equal for equal robots and grounds."""
    digest = hashlib.sha256()
    for field in ALWAYS:
        digest.update(np.ascontiguousarray(getattr(model, field)).tobytes())
    digest.update(_stepping(model, substeps).tobytes())
    unusual, grounds = _unusual(model), ground_geoms(model)
    if len(grounds) > 1 or any(model.geom_type[grounds] != mujoco.mjtGeom.mjGEOM_PLANE):
        unusual |= {name: np.asarray(getattr(model, name)) for name in GROUND}
    for name, value in unusual.items():
        digest.update(name.encode() + np.ascontiguousarray(value).tobytes())
    return digest.hexdigest()[:16]


def robot_fingerprint(model: mujoco.MjModel, substeps: int) -> str:
    """Hash of the robot and its steps: equal over any ground.

    A fixed base counts with its place in the body that it stands on, not in the world.
    """
    moves = model.body_dofnum[model.body_weldid] > 0
    chosen = {"body": moves, "geom": moves[model.geom_bodyid]}
    digest = hashlib.sha256(_stepping(model, substeps).tobytes())
    values = {name: np.asarray(getattr(model, name)) for name in ALWAYS}
    # counted within the robot, from 1: its bodies' own numbers depend on the ground's
    values["body_parentid"] = (np.cumsum(moves) * moves)[model.body_parentid]
    others = {k: v for k, v in _unusual(model).items() if not k.startswith(NUMBERED)}
    for name, value in {**values, **others}.items():
        value = value[chosen.get(name.split("_")[0], ...)]
        if name in values or np.any(value != RARELY.get(name)):
            digest.update(name.encode() + np.ascontiguousarray(value).tobytes())
    return digest.hexdigest()[:16]


def _stepping(model: mujoco.MjModel, substeps: int) -> np.ndarray:
    """Numbers of the whole world that decide a step."""
    option = model.opt
    numbers = [option.timestep, substeps, *option.gravity, option.impratio]
    numbers += [option.density, option.viscosity, *option.wind]
    numbers += [int(option.integrator), int(option.disableflags), int(option.cone)]
    return np.array(numbers, float)


def _unusual(model: mujoco.MjModel) -> dict[str, np.ndarray]:
    """What is not at its default, by name."""
    values = {name: np.asarray(getattr(model, name)) for name in RARELY}
    unusual = {k: v for k, v in values.items() if np.any(v != RARELY[k])}
    if np.any(model.qpos_spring != model.qpos0):
        unusual["qpos_spring"] = model.qpos_spring
    pulls = np.any(model.actuator_trntype == mujoco.mjtTrn.mjTRN_TENDON)
    is_bound = model.neq or any(k.startswith("tendon") for k in unusual)
    if model.ntendon and (pulls or is_bound):
        unusual |= {name: np.asarray(getattr(model, name)) for name in TENDONS}
    if np.any(model.tendon_actfrclimited):
        names = "tendon_actfrclimited", "tendon_actfrcrange"
        unusual |= {name: np.asarray(getattr(model, name)) for name in names}
    has_sites = np.any(np.isin(model.actuator_trntype, ON_SITES))
    has_sites |= np.any(model.wrap_type == mujoco.mjtWrap.mjWRAP_SITE)
    has_sites |= np.any(model.eq_objtype == mujoco.mjtObj.mjOBJ_SITE)
    if has_sites:
        names = "site_bodyid", "site_pos", "site_quat"
        unusual |= {name: np.asarray(getattr(model, name)) for name in names}
    bodies = model.jnt_bodyid - model.jnt_bodyid[:1]  # by default a joint each
    if np.any(bodies != np.arange(model.njnt)):
        unusual["jnt_bodyid"] = bodies
    option, default = model.opt, mujoco.MjOption()
    has_override = option.enableflags & mujoco.mjtEnableBit.mjENBL_OVERRIDE
    for name in (*SOLVER, *(OVERRIDES if has_override else ())):
        value = np.asarray(getattr(option, name), float)
        if np.any(value != np.asarray(getattr(default, name), float)):
            unusual[name] = value
    return unusual
