"""The race as text."""

from torchrl_nerd.evaluation.bench.report import BenchReport


def bench_table(report: BenchReport) -> str:
    """A table of errors, one of rates, and whom to ship; ``*`` marks the Pareto front."""
    lines = [
        f"{report.scene}: {report.steps} steps, {report.rows} rows a case, "
        f"{report.machine['threads']} threads; error against the finest MuJoCo"
    ]
    units = next(iter(report.errors.values()))
    titles = [f"{name}, {units[name].unit}" for name in report.quantities]
    head = "".join(f"{title:>28}" for title in titles)
    lines += ["", f"{'mean / final / 95th percentile':<34}{head}"]
    for name, errors in (report.errors | report.floors).items():
        cells = ""
        for quantity in report.quantities:
            e = errors[quantity]
            cells += f"{e.mean:>10.4f}{e.final:>9.4f}{e.p95:>9.4f}"
        lines.append(f"{name:<34}{cells}")
    if report.published:
        cells = "".join(
            f"{report.published[q]:>10.4f}{'-':>9}{'-':>9}"
            if q in report.published
            else f"{'-':>28}"
            for q in report.quantities
        )
        lines.append(f"{'the paper':<34}{cells}")
    heads = "".join(f"{f'{b} rows':>13}{'in env':>11}" for b in report.rates)
    lines += ["", f"{'control steps/s':<34}{heads}{'warm-up, s':>12}"]
    fronts = {
        batch: {name for q in report.quantities for name in report.front(batch, q)}
        for batch in report.rates
    }
    for name in report.errors:
        cells = ""
        for batch, by_name in report.rates.items():
            mark = "*" if name in fronts[batch] else " "
            rate = by_name[name]
            cells += f"{rate.steps_per_s:>12,.0f}{mark}{rate.envs_per_s:>11,.0f}"
        warm = max(by_name[name].warm_up_s for by_name in report.rates.values())
        lines.append(f"{name:<34}{cells}{warm:>12.1f}")
    lines += ["", *_costs(report)]
    budget = report.paper_budget
    if budget is not None:
        lines.append("")
        for batch in report.rates:
            choice = report.choice(batch, budget) or "none"
            lines.append(f"fastest within the paper's error, {batch} rows: {choice}")
    return "\n".join(lines)


def _costs(report: BenchReport) -> list[str]:
    """Arithmetic and memory of the learned rows, and how well they use the machine."""
    measured = ", ".join(
        f"{1e-9 * rate:.1f} GFLOP/s ({batch} rows)"
        for batch, rate in report.matrix_flop_per_s.items()
    )
    heads = "".join(f"{f'{batch} rows':>13}" for batch in report.rates)
    lines = [
        f"share of the machine's matrix rate, {measured}",
        f"{'a step of one row':<34}{'FLOP':>12}{'state, B':>11}{'memory, B':>11}{heads}",
    ]
    for name, cost in report.costs.items():
        shares = (rates[name].matrix_share or 0.0 for rates in report.rates.values())
        cells = "".join(f"{share:>13.1%}" for share in shares)
        counts = f"{cost.flop:>12,.0f}{cost.state_bytes:>11,}{cost.memory_bytes:>11,}"
        lines.append(f"{name:<34}{counts}{cells}")
    return lines
