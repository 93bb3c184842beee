"""Numbers that describe a data set: ranges, coverage, contact, outliers."""

from dataclasses import asdict, dataclass, field
from typing import cast

import mujoco
import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Generator, Tensor

from torchrl_nerd.evaluation.plots import dof_names, qpos_names
from torchrl_nerd.geometry.rotations import wrap_angle
from torchrl_nerd.keys import QPOS, QVEL, TERRAIN
from torchrl_nerd.scenes import Scene

BINS = 40
MOST_STATES = 200_000  # looked at; of more, as many whole trajectories as that
OUTLIERS = 10
SIGMA = 1.4826  # of a normal distribution, in median absolute deviations
HINGE = mujoco.mjtJoint.mjJNT_HINGE


@dataclass(frozen=True, eq=False)
class Column:
    """One coordinate, velocity or torque over the whole set.

    | field | meaning |
    |---|---|
    | ``kind`` | qpos, qvel or joint_torque |
    | ``name`` | with its unit |
    | ``quantiles`` | least, 5%, median, 95%, largest |
    | ``limits`` | of the joint, else None; a free hinge's angle is wrapped to +-pi |
    | ``coverage`` | share of 40 equal parts of the limits that any state lies in |
    | ``counts``, ``edges`` | histogram over the limits or all that occurs |
    """

    kind: str
    name: str
    quantiles: tuple[float, ...]
    limits: tuple[float, float] | None
    coverage: float | None
    counts: np.ndarray
    edges: np.ndarray


@dataclass(frozen=True)
class Outlier:
    """A trajectory's largest departure: (value - median) / (1.4826 MAD) of its column."""

    trajectory: int
    step: int
    name: str
    value: float
    sigmas: float


@dataclass(frozen=True, eq=False)
class Survey:
    """What a data set holds.

    | field | meaning |
    |---|---|
    | ``trajectories``, ``steps`` | how many there are, and looked at |
    | ``not_finite`` | entries that are NaN or infinite |
    | ``contact_share`` | of states in which anything touches; None without a ground |
    | ``near_share`` | within a contact point's margin, where it has features |
    | ``point_shares`` | of states in which each contact point touches, by its name |
    | ``gaps`` | histogram of the smallest gap, m: counts and edges |
    | ``zero_torque_fraction`` | of trajectories without any torque |
    """

    trajectories: int
    looked_at: int
    steps: int
    not_finite: int
    columns: tuple[Column, ...]
    contact_share: float | None
    near_share: float | None
    point_shares: dict[str, float]
    zero_torque_fraction: float | None
    outliers: tuple[Outlier, ...] = field(default=())
    gaps: tuple[np.ndarray, np.ndarray] | None = None


def survey(scene: Scene, data: TensorDictBase, seed: int = 0) -> Survey:
    """Look at a data set.

    Args:
        scene: the robot.
        data: ``[trajectories, steps]``, see `torchrl_nerd.data.generate`.
        seed: of the choice where there is more than can be looked at.
    """
    count, steps = data.batch_size
    most = max(1, MOST_STATES // max(steps, 1))
    picks = torch.arange(count)
    if count > most:
        draw = torch.randperm(count, generator=Generator().manual_seed(seed))[:most]
        picks = draw.sort().values
    seen = cast(TensorDictBase, data[picks]).to_tensordict()
    tables = _tables(scene, seen)
    finite = [values.isfinite() for values, _, _, _ in tables]
    contact = _contact(scene, seen)
    torque = seen.get(("next", "joint_torque"), None)
    has_torque = torque is not None and torque.shape[-1] > 0
    return Survey(
        trajectories=count,
        looked_at=len(picks),
        steps=steps,
        not_finite=int(sum((~f).sum() for f in finite)),
        columns=tuple(_column(*table) for table in tables),
        zero_torque_fraction=float((torque == 0).all(-1).all(-1).double().mean())
        if has_torque
        else None,
        outliers=_outliers(tables, picks),
        **contact,
    )


def survey_figures(found: Survey) -> dict:
    """A survey without its histograms, for JSON."""
    figures = {k: v for k, v in vars(found).items() if k != "gaps"}
    figures["outliers"] = [asdict(outlier) for outlier in found.outliers]
    skipped = ("counts", "edges")
    figures["columns"] = [
        {k: v for k, v in vars(column).items() if k not in skipped}
        for column in found.columns
    ]
    return figures


Table = tuple[Tensor, str, str, tuple[float, float] | None]
"""Values ``(trajectories, steps)``, kind, name and limits of one column."""


def _tables(scene: Scene, seen: TensorDictBase) -> list[Table]:
    model, tables = scene.model, []
    limits: list[tuple[float, float] | None] = [None] * model.nq
    qpos = seen[QPOS].clone()
    for joint in range(model.njnt):
        q, is_hinge = int(model.jnt_qposadr[joint]), model.jnt_type[joint] == HINGE
        if model.jnt_limited[joint]:
            low, high = model.jnt_range[joint]
            limits[q] = (float(low), float(high))
        elif is_hinge:
            qpos[..., q] = wrap_angle(qpos[..., q])
            limits[q] = (-float(np.pi), float(np.pi))
    names = dict(zip(range(model.nq), qpos_names(scene), strict=True))
    tables += [(qpos[..., q], QPOS, names[q], limits[q]) for q in names]
    speeds = dof_names(scene)
    tables += [(seen[QVEL][..., v], QVEL, name, None) for v, name in enumerate(speeds)]
    torque = seen.get(("next", "joint_torque"), None)
    if torque is not None:
        for column, dof in enumerate(scene.actuated):
            name = speeds[dof].rsplit(" ", 2)[0]
            tables.append((torque[..., column], "joint_torque", name, None))
    return tables


def _column(
    values: Tensor, kind: str, name: str, limits: tuple[float, float] | None
) -> Column:
    found = values[values.isfinite()].numpy()
    if not len(found):
        found = np.zeros(1)
    ends = limits or (float(found.min()), float(found.max()))
    if ends[0] == ends[1]:
        ends = (ends[0] - 0.5, ends[1] + 0.5)
    counts, edges = np.histogram(found, BINS, ends)
    quantiles = np.quantile(found, (0.0, 0.05, 0.5, 0.95, 1.0))
    coverage = None if limits is None else float((counts > 0).mean())
    return Column(
        kind, name, tuple(quantiles.tolist()), limits, coverage, counts, edges
    )


def _contact(scene: Scene, seen: TensorDictBase) -> dict:
    if scene.terrain is None:
        shares = {"contact_share": None, "near_share": None}
        return {**shares, "point_shares": {}}
    parts = []
    terrain = seen.get(TERRAIN, None)
    for start in range(0, len(seen), 256):  # so that memory stays small
        part = slice(start, start + 256)
        ground = None if terrain is None else terrain[part]
        parts.append(scene.clearances(seen[QPOS][part], ground).flatten(0, 1))
    gaps = torch.cat(parts)
    reach = torch.as_tensor(scene.contacts.margins - scene.contacts.radii).to(gaps)
    least = gaps.amin(-1).numpy()
    shown = least[np.isfinite(least)]
    high = float(np.quantile(shown, 0.99)) if len(shown) else 1.0
    low = float(shown.min()) if len(shown) else 0.0
    touches = (gaps <= 0.0).double().mean(0).tolist()
    return {
        "contact_share": float((gaps <= 0.0).any(-1).double().mean()),
        "near_share": float((gaps <= reach).any(-1).double().mean()),
        "point_shares": dict(zip(_point_names(scene), touches, strict=True)),
        "gaps": np.histogram(shown, BINS, (low, max(high, low + 1e-9))),
    }


def _point_names(scene: Scene) -> list[str]:
    """Number and body of each contact point."""
    bodies = (scene.model.body(int(body)).name for body in scene.contacts.bodies)
    return [f"{number} on {name}" for number, name in enumerate(bodies)]


def _outliers(tables: list[Table], picks: Tensor) -> tuple[Outlier, ...]:
    worst: list[Outlier] = []
    for values, _, name, _ in tables:
        found = values.double()
        known = found[found.isfinite()]
        if not len(known):
            continue
        median = known.median()
        spread = SIGMA * (known - median).abs().median()
        if spread <= 0.0:
            continue
        sigmas = ((found - median) / spread).abs().nan_to_num(nan=torch.inf)
        largest, step = sigmas.max(1)
        for row in largest.topk(min(OUTLIERS, len(largest))).indices.tolist():
            at = int(step[row])
            value, size = float(found[row, at]), float(largest[row])
            worst.append(Outlier(int(picks[row]), at, name, value, size))
    return tuple(sorted(worst, key=lambda outlier: -outlier.sigmas)[:OUTLIERS])
