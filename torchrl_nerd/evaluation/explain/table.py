"""The report as text for a terminal."""

from torchrl_nerd.evaluation.explain.features import (
    DEPTH,
    FORCE,
    GAPS,
    GATED,
    PRESSED,
    VELOCITY,
)
from torchrl_nerd.evaluation.explain.report import SceneReport

# kinds that the paper's input does not have
ADDED = (GAPS, GATED, VELOCITY, DEPTH, PRESSED, FORCE)


def report_table(report: SceneReport) -> str:
    """The whole report, under 100 columns but for the reasons."""
    released = f", released: {report.published}" if report.published else ""
    title = f"{report.scene}: {report.size} numbers a step; "
    title += f"the paper's full input: {report.paper_size}{released}"
    parts = [[title], _kept(report), _dropped(report), _rebuilt(report)]
    parts.append(str(report.solver).splitlines())
    if report.timing is not None:
        parts.append(_timing(report))
    return "\n\n".join("\n".join(part) for part in parts)


def _kept(report: SceneReport) -> list[str]:
    lines = [f"{'kept':<22}{'width':>6}{'adds':>6}{'step changes by':>17}  why"]
    for kind, dependence in zip(report.kinds, report.dependences, strict=True):
        line = f"{kind.name:<22}{kind.width:>6}{kind.adds:>6}"
        lines.append(f"{line}{dependence.change:>17.0e}  {kind.why}")
    lines.append(f"features of an unused kind: {', '.join(report.unused) or 'none'}")
    if report.derived:
        names = ", ".join(report.derived)
        lines.append(f"derived: {names}: functions of the kinds above them, kept since")
        lines.append("they are slow to learn (coming depth: docs/studies.md)")
    added = [kind.name for kind in report.kinds if kind.name in ADDED]
    lines.append(f"not in the paper's input: {', '.join(added) or 'none'}")
    return lines


def _dropped(report: SceneReport) -> list[str]:
    lines = [f"{'dropped or merged':<26}{'width':>6}  {'proof':<31}why"]
    for entry in report.dropped:
        line = f"{entry.what:<26}{entry.width or '':>6}"
        lines.append(f"{line}  {entry.proof:<31}{entry.why}")
    return lines


def _rebuilt(report: SceneReport) -> list[str]:
    title = "the paper's input, rebuilt"
    lines = [f"{title:<26}{'width':>6}{'lost':>6}{'largest error':>15}"]
    for piece in report.pieces:
        line = f"{piece.name:<26}{piece.width:>6}{piece.lost:>6}"
        lines.append(f"{line}{piece.error:>15.0e}")
    lines.append(
        f"from the compact token of {report.states} random states (seed {report.seed}), "
        "in float64; angles modulo 2 pi"
    )
    if any(piece.lost for piece in report.pieces):
        lines.append(
            "lost: coordinates that the step ignores; what points see that no joint moves"
        )
    return lines


def _timing(report: SceneReport) -> list[str]:
    time = report.timing
    assert time is not None
    head = f"ms, {time.rows} rows, {time.network}"
    lines = [f"{head:<26}{'encode':>9}{'network':>9}{'both':>9}"]
    rows = {
        "compact": (time.encode, time.step),
        "paper's full input": (time.paper_encode, time.paper_step),
    }
    for name, (encode, step) in rows.items():
        lines.append(f"{name:<26}{encode:>9.2f}{step:>9.2f}{encode + step:>9.2f}")
    lines.append(f"compact over full: {time.ratio:.2f}")
    return lines
