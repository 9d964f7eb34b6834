"""One job in several processes, on one host or many, by JAX's own runtime (``jax.distributed``).

Every process has the same request and does its own share of it. Those of a rollout say nothing to
each other while they work, and wait for each other once, at the end. Those of a fit are a `Group`:
the first tells the others what to do, and their answers become one up a binary tree.
"""

from __future__ import annotations

import atexit
import contextlib
import io
import itertools
import os
import signal
import sys
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from gfnn_jax.errors import InputError, WorkError

# Seconds: a process that is silent for so long is taken for dead, and the others end; how long the
# first to finish waits for the last.
_HEARTBEAT, _PATIENCE = 10, 14 * 24 * 3600
LOST = (
    "this process or another one of the job was lost: what they had done is kept, --resume goes on "
    "with it, in any number of processes"
)


class Share(NamedTuple):
    """Which of how many equal shares of a job this process does."""

    index: int
    count: int

    def of(self, number: int, block: int) -> slice:
        """Those of so many things that are its own: whole blocks, the last one but for its end."""
        blocks = -(-number // block)
        ends = (i * blocks // self.count * block for i in (self.index, self.index + 1))
        return slice(*(min(end, number) for end in ends))


WHOLE = Share(0, 1)


class Group:
    """The processes of one job, who send each other arrays by name.

    All of them make the same calls in the same order. sent: bytes that this process has sent.
    """

    def __init__(self, share: Share = WHOLE):
        self.share, self.sent = share, 0
        self._calls = itertools.count()

    @property
    def first(self) -> bool:
        """Whether this is the process that decides."""
        return self.share.index == 0

    def told(self, arrays: dict[str, Any] | None = None) -> dict[str, Any]:
        """What the first process says; the others give nothing. It remains in the runtime's store:
        let it be small."""
        call = next(self._calls)
        if self.share.count == 1:
            assert arrays is not None
            return arrays
        if self.first:
            assert arrays is not None
            self._send(f"gfnn/{call}", arrays)
            return arrays
        return _received(f"gfnn/{call}")

    def folded(self, own: dict[str, Any], merge: Callable[[Any, Any], Any]) -> dict[str, Any]:
        """In the first process ``merge`` of what all have, neighbours first: a binary tree, at each
        level of which half of those that are left send theirs. In the others whatever they sent."""
        call, (index, count), step = next(self._calls), self.share, 1
        while step < count:
            if index % (2 * step):
                self._send(f"gfnn/{call}/{index}", own)
                return own
            if index + step < count:
                own = merge(own, _received(f"gfnn/{call}/{index + step}", delete=True))
            step *= 2
        return own

    def _send(self, key: str, arrays: dict[str, Any]) -> None:
        stream = io.BytesIO()
        np.savez(stream, **arrays)
        self.sent += stream.tell()
        with _lost_in_one_line():
            _store().key_value_set_bytes(key, stream.getvalue())


def _received(key: str, *, delete: bool = False) -> dict[str, Any]:
    """The arrays that another process sends, or has sent, under this key."""
    with _lost_in_one_line():
        content = _store().blocking_key_value_get_bytes(key, 1000 * _PATIENCE)
        if delete:
            _store().key_value_delete(key)
    with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
        return dict(arrays)


def _store() -> Any:
    """The runtime's own store of keys and values, kept by the first process. JAX has no public name
    for it. Arrays of any size go through it, nothing is compiled, and it waits for as long as the
    first process searches: Gloo, XLA's collectives on a CPU, gives up after 30 s. 2 MB take 0.02 to
    0.3 s, several times what a collective takes."""
    from jax._src import distributed

    return distributed.global_state.client


@contextlib.contextmanager
def _lost_in_one_line() -> Iterator[None]:
    import jax

    try:
        yield
    except jax.errors.JaxRuntimeError as error:
        raise WorkError(LOST) from error


def join() -> Share:
    """Become one of the processes of a job, and wait until all are there.

    How many there are, which one this is and where the first listens comes from the launcher, where
    JAX knows it (SLURM, Open MPI, Kubernetes, cloud TPUs), else from the environment:
    JAX_COORDINATOR_ADDRESS (host:port), JAX_NUM_PROCESSES, JAX_PROCESS_ID. Raises InputError where
    that is missing or wrong.
    """
    import jax  # loaded when first used: refusing bad usage needs none

    told = {}
    for name in ("num_processes", "process_id"):
        text = os.environ.get(f"JAX_{name.upper()}")
        if text is not None and not text.isdecimal():
            raise InputError(f"expected a whole number as JAX_{name.upper()}, got '{text}'")
        told[name] = None if text is None else int(text)
    try:
        jax.distributed.initialize(
            **told, heartbeat_timeout_seconds=_HEARTBEAT, shutdown_timeout_seconds=_PATIENCE
        )
        jax.local_devices()  # all processes tell each other what they have: none may leave it out
    except (ValueError, TypeError, RuntimeError) as error:
        raise InputError(
            "expected a launcher that JAX knows, as srun and mpirun, or JAX_COORDINATOR_ADDRESS, "
            f"JAX_NUM_PROCESSES and JAX_PROCESS_ID for --distributed ({error})"
        ) from error
    atexit.register(abandon, 1)  # of an exception that nobody expects
    return Share(jax.process_index(), jax.process_count())


def wait_for_all() -> None:
    """Wait until every process of the job is here, and leave it."""
    import jax

    jax.distributed.shutdown()


def abandon(status: int) -> None:
    """End a process of a job that failed, at once; nothing where it is not one of several. At the
    usual end of a program JAX would wait for the others, who would never know."""
    jax = sys.modules.get("jax")
    if jax is not None and jax.distributed.is_initialized():
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)


@contextlib.contextmanager
def watched(line: str) -> Iterator[None]:
    """``line`` on stderr if this process is aborted or killed inside the block.

    JAX's runtime aborts a process whose fellow is lost, with a page of native messages and no
    exception. Those go nowhere; Python's own go on. The line comes from a process that does nothing
    else, and does so where the system can fork.
    """
    if not hasattr(os, "fork"):
        yield
        return
    ended, alive = os.pipe()
    if os.fork() == 0:
        os.close(alive)
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, signal.SIG_IGN)  # it ends when the other one does
        if not os.read(ended, 1):
            os.write(2, f"{line}\n".encode())
        os._exit(0)
    os.close(ended)
    sys.stderr.flush()
    before, own = sys.stderr, os.dup(2)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    os.close(nowhere)
    sys.stderr = os.fdopen(own, "w", buffering=1)
    try:
        yield
    finally:
        os.dup2(sys.stderr.fileno(), 2)
        sys.stderr.close()
        sys.stderr = before
        os.write(alive, b".")
        os.close(alive)
