"""The rows of a fit shared out among the devices of a process.

Rows are cut into parts, and the factors of the parts merged up a binary tree (TSQR: Demmel,
Grigori, Hoemmen & Langou, SIAM J. Sci. Comput. 34, 2012). Neither the parts nor the tree depend on
how many devices there are, so that a fit has the same bits on any number of them.

Each device has a thread. That of a CPU's device does the arithmetic itself, by NumPy and LAPACK,
which let other threads work beside them; that of an accelerator hands it over.
"""

import contextlib
import queue
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextvars import ContextVar
from typing import Any

from gfnn_jax.threads import one_thread

_AHEAD = 2  # parts for each device that are read before they are needed
_devices: ContextVar[tuple[Any, ...]] = ContextVar("devices", default=())


@contextlib.contextmanager
def on_devices(devices: Sequence[Any]) -> Iterator[None]:
    """Fits inside the block share their rows among these devices, JAX's; none: as without it.

    Linear algebra of the host has one thread inside: here devices share out the work.
    """
    token = _devices.set(tuple(devices))
    try:
        with one_thread():
            yield
    finally:
        _devices.reset(token)


def devices() -> tuple[Any, ...]:
    """Among which a fit shares its rows here; empty where nobody said so."""
    return _devices.get()


def each(function: Callable[[Any, Any], Any], parts: Iterable[Any]) -> list[Any]:
    """``function(part, device)`` of all parts, in their order."""
    with _workers() as submit:
        return [future.result() for future in [submit(function, part) for part in parts]]


def tree(
    leaf: Callable[[Any, Any], Any], parts: Iterable[Any], merge: Callable[[Any, Any, Any], Any]
) -> Any:
    """``leaf(part, device)`` of all parts, by ``merge(one, other, device)`` of neighbours first;
    None where there are none.

    parts: any number of them, which are read no further ahead than the devices need.
    """
    trees: list[tuple[int, Future]] = []  # with how often each was merged, falling
    begun: deque[Future] = deque()

    def together(both: tuple[Future, Future], device: Any) -> Any:
        return merge(both[0].result(), both[1].result(), device)

    with _workers() as submit:

        def merge_last() -> None:
            # What it waits for was submitted before, and is done or has a worker.
            (level, one), (_, other) = trees[-2:]
            trees[-2:] = [(level + 1, submit(together, (one, other)))]

        for part in parts:
            if len(begun) == _AHEAD * len(devices()):
                begun.popleft().result()  # raises what it raised
            begun.append(submit(leaf, part))
            trees.append((0, begun[-1]))
            while len(trees) > 1 and trees[-1][0] == trees[-2][0]:
                merge_last()
        while len(trees) > 1:
            merge_last()
        return trees[0][1].result() if trees else None


@contextlib.contextmanager
def _workers() -> Iterator[Callable[[Callable, Any], Future]]:
    """Submits ``function(part, device)`` to a thread, for the next device that is free."""
    free: queue.SimpleQueue = queue.SimpleQueue()
    for device in devices():
        free.put(device)

    def on_a_device(function: Callable, part: Any) -> Any:
        device = free.get()
        try:
            return function(part, device)
        finally:
            free.put(device)

    with ThreadPoolExecutor(len(devices()), initializer=_devices.set, initargs=((),)) as pool:
        try:
            yield lambda function, part: pool.submit(on_a_device, function, part)
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
