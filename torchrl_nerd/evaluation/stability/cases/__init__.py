"""Every hard case, by name; a new one is a file with a ``CASE``, found here."""

from importlib import import_module
from pkgutil import iter_modules

from torchrl_nerd.evaluation.stability.case import Case

CASES: dict[str, Case] = {
    module.name: import_module(f"{__name__}.{module.name}").CASE
    for module in iter_modules(__path__)
}
