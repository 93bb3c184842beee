"""A survey as one HTML page that needs nothing else: histograms are inline SVG."""

from collections.abc import Mapping
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_nerd.evaluation.data_report.survey import Column, Survey
from torchrl_nerd.evaluation.plots import COLORS
from torchrl_nerd.files import write_atomically

WIDTH, HEIGHT = 260, 44  # of a histogram, pixels
STYLE = """
:root { color-scheme: light; }
body { font: 15px/1.5 system-ui, sans-serif; color: #222; max-width: 1000px;
  margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.6rem; margin-bottom: 0; } h2 { font-size: 1.15rem; margin-top: 2rem; }
p.note { color: #666; margin-top: 0.2rem; }
table { border-collapse: collapse; width: 100%; }
th, td { text-align: right; padding: 0.25rem 0.6rem; border-bottom: 1px solid #e4e4e4;
  font-variant-numeric: tabular-nums; white-space: nowrap; }
th { font-weight: 600; color: #555; } th:first-child, td:first-child { text-align: left; }
.tiles { display: flex; flex-wrap: wrap; gap: 0.8rem; margin: 1.2rem 0; }
.tile { border: 1px solid #e4e4e4; border-radius: 8px; padding: 0.6rem 1rem; }
.tile b { display: block; font-size: 1.35rem; } .tile span { color: #666; }
svg { display: block; } .few { color: #b45309; font-weight: 600; }
"""
TITLES = {
    "qpos": "Positions",
    "qvel": "Velocities",
    "joint_torque": "Joint torques (N, N m)",
}


def write_page(survey: Survey, card: Mapping[str, Any], path: Path) -> None:
    """Write the page.

    Args:
        survey: of the data set.
        card: of the data set, its ``data.json``.
        path: of the HTML file.
    """
    text = page(survey, card)
    write_atomically(path, lambda aside: aside.write_text(text, encoding="utf-8"))


def page(survey: Survey, card: Mapping[str, Any]) -> str:
    """The HTML."""
    scene = escape(str(card.get("scene", "")))
    seed = card.get("config", {}).get("seed", "-")
    looked = (
        ""
        if survey.looked_at == survey.trajectories
        else (f", {survey.looked_at:,} of the trajectories looked at")
    )
    parts = [
        f"<h1>{scene}</h1>",
        f'<p class="note">data of true dynamics, seed {escape(str(seed))}{looked}</p>',
        _tiles(survey, card),
    ]
    for kind, title in TITLES.items():
        columns = [column for column in survey.columns if column.kind == kind]
        if columns:
            parts += [f"<h2>{title}</h2>", _columns(columns)]
    if survey.gaps is not None:
        parts += ["<h2>Contact</h2>", _contact(survey)]
    parts += ["<h2>Outliers</h2>", _outliers(survey)]
    body = "\n".join(parts)
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        f"<title>{scene} data</title><style>{STYLE}</style></head>"
        f"<body>\n{body}\n</body></html>\n"
    )


def _tiles(survey: Survey, card: Mapping[str, Any]) -> str:
    tiles = {
        "trajectories": f"{survey.trajectories:,}",
        "steps each": f"{survey.steps:,}",
        "dropped": f"{card.get('dropped', 0):,}",
        "not finite": f"{survey.not_finite:,}",
    }
    if survey.zero_torque_fraction is not None:
        tiles["without torque"] = f"{survey.zero_torque_fraction:.1%}"
    if survey.contact_share is not None:
        tiles["states in contact"] = f"{survey.contact_share:.1%}"
    inner = "".join(
        f'<div class="tile"><b>{value}</b><span>{name}</span></div>'
        for name, value in tiles.items()
    )
    return f'<div class="tiles">{inner}</div>'


def _columns(columns: list[Column]) -> str:
    has_limits = any(column.limits for column in columns)
    ends = ("limits", "covered") if has_limits else ()
    heads = ("", "least", "5%", "median", "95%", "largest", *ends, "")
    rows = []
    for column in columns:
        limits, covered = "-", "-"
        if column.limits is not None:
            limits = f"{column.limits[0]:.3g} to {column.limits[1]:.3g}"
        if column.coverage is not None:
            few = ' class="few"' if column.coverage < 1.0 else ""
            covered = f"<span{few}>{column.coverage:.0%}</span>"
        cells = [escape(column.name), *(f"{q:.3g}" for q in column.quantiles)]
        cells += [limits, covered] if has_limits else []
        rows.append([*cells, histogram(column.counts, column.edges)])
    return _table(heads, rows)


def _contact(survey: Survey) -> str:
    assert survey.gaps is not None and survey.near_share is not None
    points = [
        [escape(name), f"{share:.1%}"] for name, share in survey.point_shares.items()
    ]
    counts, edges = survey.gaps
    return (
        f"<p>Within the margin, where contact has features: {survey.near_share:.1%} of "
        "states. Smallest gap to the ground, m, up to its 99th percentile (negative: "
        f"penetration):</p>{histogram(counts, edges, 2 * WIDTH)}"
        + _table(("contact point", "touches"), points)
    )


def _outliers(survey: Survey) -> str:
    note = (
        '<p class="note">Largest departures from the median, in robust standard '
        "deviations (1.4826 median absolute deviations).</p>"
    )
    heads = ("trajectory", "step", "of", "value", "departure")
    rows = [
        [str(o.trajectory), str(o.step), escape(o.name), f"{o.value:.4g}"]
        + [f"{o.sigmas:.1f}"]
        for o in survey.outliers
    ]
    return note + _table(heads, rows)


def _table(heads: tuple[str, ...], rows: list[list[str]]) -> str:
    head = "".join(f"<th>{name}</th>" for name in heads)
    body = "".join(
        "<tr>" + "".join(f"<td>{cell}</td>" for cell in row) + "</tr>" for row in rows
    )
    return f"<table><tr>{head}</tr>{body}</table>"


def histogram(counts: np.ndarray, edges: np.ndarray, width: int = WIDTH) -> str:
    """Bars as SVG, the ends of the axis written below."""
    most, step = max(int(counts.max()), 1), width / len(counts)
    bars = "".join(
        f'<rect x="{i * step:.1f}" y="{HEIGHT - h:.1f}" width="{step - 0.6:.1f}" '
        f'height="{h:.1f}"/>'
        for i, h in enumerate(HEIGHT * counts / most)
        if h > 0
    )
    label = f'y="{HEIGHT + 12}" font-size="10" fill="#777"'
    return (
        f'<svg width="{width}" height="{HEIGHT + 16}" role="img">'
        f'<g fill="{COLORS[0]}">{bars}</g>'
        f'<line x1="0" x2="{width}" y1="{HEIGHT}" y2="{HEIGHT}" stroke="#999"/>'
        f'<text x="0" {label}>{edges[0]:.3g}</text>'
        f'<text x="{width}" text-anchor="end" {label}>{edges[-1]:.3g}</text></svg>'
    )
