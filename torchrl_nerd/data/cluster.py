"""``map`` on the workers of a Ray cluster."""

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
    """Results of ``map`` in its order; each call runs on one processor of the cluster.

    A call whose worker or node is lost is repeated on another one, so that results must
    depend on items alone. At most one call more than the cluster has processors is running
    or finished: memory stays bounded.

    ``address`` is ``HOST:PORT`` of a cluster, ``auto`` to find it, or ``local`` for a new
    one on this machine. An open connection is used as it is.

    Raises:
        ModuleNotFoundError: no Ray.
        ConnectionError: no cluster at that address.
        RuntimeError: every worker that tried a call was lost.
    """
    if find_spec("ray") is None:
        raise ModuleNotFoundError(
            "this needs the package ray, which is not installed: "
            "in the clone, pip install -e '.[ray]'"
        )
    import ray

    def call(function: Callable[[Item], Result], item: Item) -> Result:
        os.environ.setdefault("NERD_THREADS", "1")  # other processors run other calls
        return function(item)

    def take(reference: Any) -> Result:
        try:
            return ray.get(reference)
        except ray.exceptions.RayTaskError as error:
            raise error.cause from None
        except ray.exceptions.RayError as error:
            raise RuntimeError(
                f"Ray lost all {RETRIES + 1} workers that tried a chunk "
                f"({type(error).__name__}); earlier chunks are kept"
            ) from None

    is_new = not ray.is_initialized()
    if is_new:
        ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
    try:
        remote = ray.remote(num_cpus=1, max_retries=RETRIES)(call)
        sent = ray.put(function)
        pending: deque[Any] = deque()
        for item in items:
            pending.append(remote.remote(sent, item))
            if len(pending) > ray.cluster_resources().get("CPU", 1):
                yield take(pending.popleft())
        while pending:
            yield take(pending.popleft())
    finally:
        if is_new:
            ray.shutdown()
