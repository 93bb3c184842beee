"""``map`` that is one call ahead of whoever takes its results."""

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


def ahead(
    function: Callable[[Item], Result], items: Iterable[Item]
) -> Iterator[Result]:
    """What ``map`` gives, in its order: a thread makes the next result meanwhile.

    Calls follow one another in that thread. A result waits at most until the one after it
    is made, so that memory holds two. What a call raises is raised where its result would
    have been taken.

    Examples:
        >>> list(ahead(abs, [-1, 2, -3]))
        [1, 2, 3]
    """
    with ThreadPoolExecutor(1, "ahead") as thread:
        coming: Future[Result] | None = None
        for item in items:
            taken, coming = coming, thread.submit(function, item)
            if taken is not None:
                yield taken.result()
        if coming is not None:
            yield coming.result()
