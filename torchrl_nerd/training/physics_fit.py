"""Physics of recorded tosses: a simulator's numbers with the least error, no gradients."""

from collections.abc import Callable, Iterator

from torch import Tensor

from torchrl_nerd.analytic.free_body import PARAMETERS
from torchrl_nerd.evaluation.parameter_fit import fit_flight, fit_parameters
from torchrl_nerd.evaluation.toss_error import STATES
from torchrl_nerd.modules.hybrid import HybridNeRD
from torchrl_nerd.training.toss_view import TossView


def fit_physics(
    model: HybridNeRD,
    view: TossView,
    train: Tensor,
    evaluations: int,
    show: Callable[[int], object],
) -> Iterator[dict[str, float]]:
    """Give the model the best parameters found, after each stage of `fit_parameters`.

    Args:
        model: changed in place, its simulator alone.
        view: of the tosses.
        train: numbers of the tosses to fit to.
        evaluations: of each stage.
        show: called with the number of windows of every evaluation.

    Yields:
        The parameters, which the model then has.
    """

    def errors_of(values: dict[str, float], rows: Tensor) -> tuple[Tensor, Tensor]:
        model.analytic_step.set_values(values)
        show(len(rows))
        seen = slice(view.every - 1, None, view.every)
        distance, angle = view.errors(model, rows)
        return distance[:, seen], angle[:, seen]

    flight = fit_flight(model.scene, view.seen.select(train), view.every)
    first, starts = model.analytic_step.values() | flight, view.starts(STATES, train)
    for found in fit_parameters(errors_of, first, PARAMETERS, starts, evaluations):
        model.analytic_step.set_values(found)
        yield found
