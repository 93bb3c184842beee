"""The rows of a batch in equal parts, each on a thread of its own.

For functions in which rows are independent, and which release Python's lock for most of
the time, as compiled code does that is wrapped in C++.
"""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from threading import Barrier
from typing import Any, Generic, TypeVar, cast

import torch
from torch import Tensor

Result = TypeVar("Result")


def parts_of(rows: int, least: int) -> int:
    """As many equal parts as torch has threads, with at least so many rows in each."""
    most = min(torch.get_num_threads(), rows // least)
    return max((n for n in range(1, most + 1) if rows % n == 0), default=1)


class RowThreads(Generic[Result]):
    """A function of tensors of rows, computed in parts on threads.

    The parts record no gradients.

    Args:
        function: of positional arguments. Tensors among them, and what it returns, have
            the rows as their first dimension; all else goes to every part.
    """

    def __init__(self, function: Callable[..., Result]) -> None:
        self.function = function
        self._known: dict[int, int] = {}  # calls by rows of a part

    def __call__(self, parts: int, *args: Any) -> Result:
        """What ``function`` gives, in so many parts; raises what it raises."""
        split = [x.chunk(parts) if isinstance(x, Tensor) else [x] * parts for x in args]
        pool, mode = _pool(os.getpid(), parts), torch.is_inference_mode_enabled()
        futures = []
        rows = next(len(x[0]) for x in split if isinstance(x[0], Tensor))
        calls = self._known[rows] = self._known.get(rows, 0) + 1
        for part in zip(*split, strict=True):
            futures.append(pool.submit(self._work, mode, part))
            if calls <= WARM:  # what compiles does so once
                futures[-1].result()
        found = [future.result() for future in futures]
        if isinstance(found[0], Tensor):
            return cast(Result, torch.cat(cast(list[Tensor], found)))
        columns = zip(*cast(list[tuple], found), strict=True)
        joined = (torch.cat(x) if isinstance(x[0], Tensor) else x[0] for x in columns)
        return cast(Result, tuple(joined))

    def _work(self, mode: bool, args: tuple) -> Result:
        with torch.inference_mode(mode), torch.no_grad():
            return self.function(*args)


WARM = 2  # calls of one part after the other: an eager one, and one that compiles


@cache
def _pool(process: int, threads: int) -> ThreadPoolExecutor:
    """Threads of a process, not those of the one it was forked from.

    In each of them torch works alone. Its number of threads is one of each thread and one
    that new threads begin with, which setting the former sets as well.
    """
    pool, all_here = ThreadPoolExecutor(threads, "rows"), Barrier(threads + 1)

    def begin() -> None:
        torch.get_num_threads()  # takes over the number that new threads begin with
        torch.set_num_threads(1)
        all_here.wait()

    number = torch.get_num_threads()
    started = [pool.submit(begin) for _ in range(threads)]
    all_here.wait()
    for each in started:
        each.result()
    torch.set_num_threads(number)
    return pool
