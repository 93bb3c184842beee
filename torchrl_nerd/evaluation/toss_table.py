"""Models beside each other on recorded tosses, and beside the paper's figures."""

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from torch import Tensor

from torchrl_nerd.data.cube_tosses import Tosses
from torchrl_nerd.dynamics import MujocoDynamics
from torchrl_nerd.dynamics.base import Dynamics
from torchrl_nerd.evaluation.system_identification import (
    FITTED,
    FITTED_CENTRE,
    PUBLISHED,
    cube_with,
)
from torchrl_nerd.evaluation.toss_error import (
    PUBLISHED as PAPER,
)
from torchrl_nerd.evaluation.toss_error import (
    STATES,
    TossError,
    no_motion,
    paired_interval,
    summarize_both,
    toss_errors,
)
from torchrl_nerd.scenes import Scene

BASELINES = {
    "MuJoCo, published": PUBLISHED,
    "MuJoCo, fitted": FITTED,
    "MuJoCo, fitted with centre": FITTED_CENTRE,
}
"""Parameters of MuJoCo."""
NAMES = ("position_error_m", "orientation_error_rad")


def mujoco_baselines(scene: Scene) -> dict[str, Dynamics]:
    """MuJoCo with published parameters, and with those fitted to training tosses.

    The last has, beyond the numbers of the published model, the centre of mass that the
    tosses show.
    """
    return {
        name: MujocoDynamics(cube_with(scene, parameters))
        for name, parameters in BASELINES.items()
    }


def compare(
    models: Mapping[str, Dynamics], tosses: Tosses, starts: Tensor
) -> dict[str, dict[str, Any]]:
    """Figures of every model, of no motion, and against MuJoCo where it is among them.

    ``against`` holds, for each of `BASELINES`, 95% intervals over tosses of the model's
    errors less MuJoCo's, m and rad: ahead of it if they are below 0.

    Args:
        models: by name.
        tosses: recorded.
        starts: rows of the first states.
    """
    errors = {"no motion": no_motion(tosses, starts)}
    errors |= {name: toss_errors(x, tosses, starts) for name, x in models.items()}
    toss, table = tosses.toss_of(starts), {}
    for name, both in errors.items():
        figures: dict[str, Any] = {
            key: asdict(value)
            for key, value in summarize_both(both, tosses, starts).items()
        }
        against = {
            other: {
                unit: paired_interval(mine, its, toss)
                for unit, mine, its in zip(
                    ("m", "rad"), both, errors[other], strict=True
                )
            }
            for other in BASELINES
            if other in errors and other != name
        }
        if against:
            figures["against"] = against
        table[name] = figures
    return table


def toss_table(table: Mapping[str, Mapping[str, Any]]) -> str:
    """The same as text, the paper's figures last."""
    columns = ("mean", "interval", "median", "final", "p95", "first")
    head = f"{f'{STATES} states':<34}{'quantity':<11}"
    lines = [head + "".join(f"{'+-' if c == 'interval' else c:>9}" for c in columns)]
    for name, figures in table.items():
        for key, quantity in zip(NAMES, ("centre m", "angle rad"), strict=True):
            error = TossError(**figures[key])
            numbers = "".join(f"{getattr(error, c):>9.4f}" for c in columns)
            lines.append(f"{name:<34}{quantity:<11}{numbers}")
    for name, (position, angle) in PAPER.items():
        lines.append(f"{name:<34}{'centre m':<11}{position:>9.4f}")
        lines.append(f"{name:<34}{'angle rad':<11}{angle:>9.4f}")
    return "\n".join(lines)
