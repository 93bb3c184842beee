"""Every hard case, by name; a new one is a function with ``@hard_case`` in a file here."""

from torchrl_nerd.evaluation.stability import case
from torchrl_nerd.evaluation.stability.cases import numerics, ood, physics  # noqa: F401

CASES = dict(sorted(case.CASES.items()))
