"""Every hard case, by name; a new one is a function with ``@hard_case`` in a file here."""

from torchrl_nerd.evaluation.stability import case
from torchrl_nerd.evaluation.stability.cases import (  # noqa: F401
    conservation,
    contact,
    invariance,
    numerics,
    ood,
)

CASES = dict(sorted(case.CASES.items()))
