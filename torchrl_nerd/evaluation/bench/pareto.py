"""Which rows are worth having, and which to ship for a budget of error."""

from collections.abc import Mapping, Sequence


def pareto_front(points: Mapping[str, tuple[float, float]]) -> list[str]:
    """Names for which no other is both as exact and faster, or as fast and more exact.

    Args:
        points: name -> (error, steps per second); points that are not finite never win.
    """
    front: list[str] = []
    fastest = 0.0
    finite = {name: p for name, p in points.items() if p[0] < float("inf")}
    for name, (_, rate) in sorted(finite.items(), key=lambda x: (x[1][0], -x[1][1])):
        if rate > fastest:
            front.append(name)
            fastest = rate
    return front


def best_within(
    errors: Mapping[str, Sequence[float]],
    rates: Mapping[str, float],
    budget: Sequence[float],
) -> str | None:
    """The fastest row with all errors within the budget, or None.

    Args:
        errors: name -> mean error of every quantity.
        rates: name -> steps per second.
        budget: largest error of every quantity, in the same order.

    Raises:
        ValueError: a budget for another number of quantities.
    """
    for found in errors.values():
        if len(found) != len(budget):
            raise ValueError(
                f"expected a budget of {len(found)} numbers, got {len(budget)}"
            )
    fit = [
        name
        for name, found in errors.items()
        if all(e <= b for e, b in zip(found, budget, strict=True))
    ]
    return max(fit, key=lambda name: rates[name], default=None)
