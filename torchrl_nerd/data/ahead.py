"""``map`` that computes the next result in a thread."""

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


def ahead(
    function: Callable[[Item], Result], items: Iterable[Item]
) -> Iterator[Result]:
    """Results of ``map`` in its order; a thread computes the next one meanwhile.

    Memory holds two results at most. What a call raises is raised where its result is
    taken.

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
