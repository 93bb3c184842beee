"""``map`` over the workers of a Ray cluster, where a lost worker costs only time."""

import logging
import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from importlib.util import find_spec
from typing import Any, TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")

RETRIES = 10  # of one call, each on another worker


def ray_map(
    function: Callable[[Item], Result], items: Iterable[Item], address: str = "local"
) -> Iterator[Result]:
    """What ``map`` gives, in its order; each call runs on one processor of the cluster.

    A call whose worker or node is lost is made again elsewhere: its result is the same if
    it depends on its item alone. At most one call more than the cluster has processors is
    under way or waits to be taken, so that memory stays bounded.

    Args:
        function: what travels to the workers, by cloudpickle.
        items: its arguments, one a call.
        address: ``HOST:PORT`` of a cluster, ``auto`` to find it, or ``local`` for a new one
            on this machine. A connection that is open already is used as it is.

    Raises:
        ModuleNotFoundError: no Ray.
        ConnectionError: no cluster at that address.
        RuntimeError: a call lost every worker that tried it.
    """
    if find_spec("ray") is None:
        raise ModuleNotFoundError(
            "this needs the package ray, which is not installed: "
            "pip install 'torchrl-nerd[ray]'"
        )
    import ray

    is_new = not ray.is_initialized()
    if is_new:
        ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
    try:
        yield from _results(ray, function, items)
    finally:
        if is_new:
            ray.shutdown()


def _results(
    ray: Any, function: Callable[[Item], Result], items: Iterable[Item]
) -> Iterator[Result]:
    call = ray.remote(num_cpus=1, max_retries=RETRIES)(_call)
    sent = ray.put(function)
    pending: deque[Any] = deque()
    for item in items:
        pending.append(call.remote(sent, item))
        if len(pending) > ray.cluster_resources().get("CPU", 1):
            yield _take(ray, pending.popleft())
    while pending:
        yield _take(ray, pending.popleft())


def _call(function: Callable[[Item], Result], item: Item) -> Result:
    os.environ.setdefault("NERD_THREADS", "1")  # the other processors have other calls
    return function(item)


def _take(ray: Any, reference: Any) -> Any:
    try:
        return ray.get(reference)
    except ray.exceptions.RayTaskError as error:
        raise error.cause from None
    except ray.exceptions.RayError as error:
        raise RuntimeError(
            f"Ray lost every worker that tried, {RETRIES + 1} in all: "
            f"{type(error).__name__}; what was drawn before is kept"
        ) from None
