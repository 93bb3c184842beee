"""A function through `torch.compile`, and without a compiler as it is."""

import warnings
from collections.abc import Callable
from typing import Any, Generic, ParamSpec, TypeVar

import torch

from torchrl_nerd.compat import COMPILER_ERRORS, compile_options

Given = ParamSpec("Given")
Result = TypeVar("Result")
Function = TypeVar("Function", bound=Callable[..., Any])


def uncompiled(function: Function) -> Function:
    """Keep what a simulator or NumPy does out of compiled code, which runs up to it."""
    return torch.compiler.disable(function)  # pyright: ignore


class Compiled(Generic[Given, Result]):
    """Compiled after a first call; eager for good, with one warning, where that fails.

    Code does not travel: a copy, or one in another process, compiles its own. Inside what
    is being compiled it is a part of that.

    Args:
        function: what to compile.
        warmup: eager calls at first, in which it works out what it keeps.
        options: of `torch.compile`.

    | attribute | meaning |
    |---|---|
    | ``is_eager`` | the compiler failed, and ``function`` runs as it is |
    """

    def __init__(
        self, function: Callable[Given, Result], warmup: int = 1, **options: Any
    ) -> None:
        self.function, self.options = function, options
        self.is_eager = False
        self._calls_to_go = warmup
        self._run: Callable[Given, Result] | None = None

    def __call__(self, *args: Given.args, **kwargs: Given.kwargs) -> Result:
        """What ``function`` gives."""
        if self.is_eager or torch.compiler.is_compiling():
            return self.function(*args, **kwargs)
        if self._calls_to_go > 0:
            self._calls_to_go -= 1
            return self.function(*args, **kwargs)
        if self._run is None:
            self._run = torch.compile(self.function, **compile_options(self.options))
        try:
            return self._run(*args, **kwargs)
        except COMPILER_ERRORS as error:
            reason = " ".join(str(error).strip().splitlines()[:2])
            warnings.warn(f"cannot compile, running eagerly: {reason}", stacklevel=3)
            self.is_eager, self._run = True, None
            return self.function(*args, **kwargs)

    def __getstate__(self) -> dict:
        """Without the code."""
        return {**self.__dict__, "_run": None}
