"""A function through `torch.compile`, in parts on threads; eager without a compiler."""

import os
import sys
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from functools import cache, wraps
from threading import Barrier, Timer
from typing import Any, Generic, ParamSpec, TypeVar, cast

import torch
from torch import Tensor

from torchrl_nerd.compat import COMPILER_ERRORS, compile_options

Given = ParamSpec("Given")
Result = TypeVar("Result")
Function = TypeVar("Function", bound=Callable[..., Any])
PATIENCE = 5.0  # s of silence
WAIT = (
    "compiling {}: up to a minute and a half on two cores, seconds once torch has it in "
    "its cache"
)
WARM = 2  # calls of one part after the other: an eager one, and one that compiles


def uncompiled(function: Function) -> Function:
    """Keep what a simulator or NumPy does out of compiled code, which runs up to it."""
    return torch.compiler.disable(function)  # pyright: ignore


def unaffected(method: Function) -> Function:
    """A method that inference mode and autocast round it leave alone; autograd does not.

    A tensor made in inference mode can never be written to or differentiated again, and
    what autocast rounds is no state. Such modes are the policy's; ``self.device`` is ours.
    """

    @wraps(method)
    def run(self: Any, *args: Any, **kwargs: Any) -> Any:
        if torch.compiler.is_compiling():  # round it, this has been done
            return method(self, *args, **kwargs)
        device, has_grad = self.device.type, torch.is_grad_enabled()
        if not (torch.is_inference_mode_enabled() or torch.is_autocast_enabled(device)):
            return method(self, *args, **kwargs)
        with torch.autocast(device, enabled=False), torch.inference_mode(False):
            with torch.set_grad_enabled(has_grad):
                return method(self, *args, **kwargs)

    return cast(Function, run)


@contextmanager
def announced(what: str) -> Iterator[None]:
    """Say on the terminal's error stream what it compiles, where that takes a while."""
    how = {"file": sys.stderr, "flush": True}
    timer = Timer(PATIENCE, print, [WAIT.format(what)], how)
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


class Compiled(Generic[Given, Result]):
    """Compiled after a first call; eager for good, with one warning, where that fails.

    Code does not travel: a copy, or one in another process, compiles its own. Inside what
    is being compiled it is a part of that. In the first ``warmup`` calls, which are eager,
    the function works out what it keeps. ``what`` is its name for people. ``options`` are
    those of `torch.compile`.
    """

    def __init__(
        self,
        function: Callable[Given, Result],
        warmup: int = 1,
        what: str = "a step",
        **options: Any,
    ) -> None:
        self.function, self.what, self.options = function, what, options
        self.is_eager = False  # True: the compiler failed, ``function`` runs as it is
        self._calls_to_go = warmup
        self._run: Callable[Given, Result] | None = None

    def __call__(self, *args: Given.args, **kwargs: Given.kwargs) -> Result:
        """What ``function`` gives."""
        if self.is_eager or torch.compiler.is_compiling():
            return self.function(*args, **kwargs)
        if self._calls_to_go > 0:
            self._calls_to_go -= 1
            return self.function(*args, **kwargs)
        run, waiting = self._run, nullcontext()
        if run is None:
            run = torch.compile(self.function, **compile_options(self.options))
            self._run, waiting = run, announced(self.what)
        try:
            with waiting:
                return run(*args, **kwargs)
        except COMPILER_ERRORS as error:
            reason = " ".join(str(error).strip().splitlines()[:2])
            warnings.warn(f"cannot compile, running eagerly: {reason}", stacklevel=2)
            self.is_eager, self._run = True, None
            return self.function(*args, **kwargs)

    def __getstate__(self) -> dict:
        """Without the code."""
        return {**self.__dict__, "_run": None}


def parts_of(rows: int, least: int) -> int:
    """As many equal parts as torch has threads, with at least so many rows in each."""
    most = min(torch.get_num_threads(), rows // least)
    return max((n for n in range(1, most + 1) if rows % n == 0), default=1)


class RowThreads(Generic[Result]):
    """A function of tensors of rows, computed in parts on threads; records no gradients.

    For functions in which rows are independent, and which release Python's lock for most
    of the time, as compiled code does that is wrapped in C++. Tensors among its positional
    arguments, and in the tuple that it returns, have the rows as their first dimension.
    What has a ``chunk`` and a ``join`` as a `History` does is cut as well; all else goes to
    every part.
    """

    def __init__(self, function: Callable[..., Result]) -> None:
        self.function = function
        self._known: dict[int, int] = {}  # calls by rows of a part

    def __call__(self, parts: int, *args: Any) -> Result:
        """What ``function`` gives, in so many parts; raises what it raises."""
        split = [x.chunk(parts) if hasattr(x, "chunk") else [x] * parts for x in args]
        pool, mode = _pool(os.getpid(), parts), torch.is_inference_mode_enabled()
        futures, rows = [], next(len(x[0]) for x in split if isinstance(x[0], Tensor))
        calls = self._known[rows] = self._known.get(rows, 0) + 1
        for part in zip(*split, strict=True):
            futures.append(pool.submit(self._work, mode, part))
            if calls <= WARM:  # what compiles does so once
                futures[-1].result()
        columns = zip(*(cast(tuple, x.result()) for x in futures), strict=True)
        for whole, pieces in zip(args, split, strict=True):
            if hasattr(whole, "join"):
                whole.join(pieces)
        joined = (torch.cat(x) if isinstance(x[0], Tensor) else x[0] for x in columns)
        return cast(Result, tuple(joined))

    def _work(self, mode: bool, args: tuple) -> Result:
        with torch.inference_mode(mode), torch.no_grad():
            return self.function(*args)


@cache
def _pool(process: int, threads: int) -> ThreadPoolExecutor:
    """Threads of a process, not those of the one it was forked from.

    In each of them torch works alone. Its number of threads is one of each thread and one
    that new threads begin with, which setting the former sets as well.
    """

    def begin() -> None:
        torch.get_num_threads()  # takes over the number that new threads begin with
        torch.set_num_threads(1)

    pool, all_here = ThreadPoolExecutor(threads, "rows", begin), Barrier(threads + 1)
    number = torch.get_num_threads()
    for _ in range(threads):
        pool.submit(all_here.wait)
    all_here.wait()
    torch.set_num_threads(number)
    return pool


# GNU's OpenMP waits in a forked process for threads that only its parent has. As in the
# workers of torch's own loaders there is one; whoever wants more sets it afterwards.
if hasattr(os, "register_at_fork"):  # not on Windows
    os.register_at_fork(after_in_child=lambda: torch.set_num_threads(1))
