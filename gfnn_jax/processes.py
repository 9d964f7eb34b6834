"""Jobs shared by several processes, on one host or many, by JAX's runtime (``jax.distributed``).

Every process has the same request and does its own share of it. The processes of a rollout do not
communicate while they work, and wait for each other once, at the end. The processes of a fit are a
`Group`: the first tells the others what to do, and their answers are merged along a binary tree.
"""

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

# Seconds. A process that is silent for _HEARTBEAT is taken for dead, and the others end. The first
# to finish waits at most _PATIENCE for the last.
_HEARTBEAT, _PATIENCE = 10, 14 * 24 * 3600
LOST = (
    "this process or another one of the job was lost: their finished work is kept, and --resume "
    "continues it with any number of processes"
)


class Share(NamedTuple):
    """Share ``index`` of ``count`` equal shares of a job, the one that this process does."""

    index: int
    count: int

    def of(self, number: int, block: int) -> slice:
        """Slice of this share among ``number`` items, in whole blocks of ``block`` items.

        Only the last block of all may be incomplete.
        """
        blocks = -(-number // block)
        ends = (i * blocks // self.count * block for i in (self.index, self.index + 1))
        return slice(*(min(end, number) for end in ends))


WHOLE = Share(0, 1)


class Group:
    """Processes of one job, which send each other arrays by name.

    All of them make the same calls in the same order. sent: bytes that this process has sent.
    """

    def __init__(self, share: Share = WHOLE):
        self.share, self.sent = share, 0
        self._calls = itertools.count()

    @property
    def first(self) -> bool:
        """True in the process of index 0, which decides."""
        return self.share.index == 0

    def broadcast(self, arrays: dict[str, Any] | None = None) -> dict[str, Any]:
        """Broadcast the arrays of the first process; the others pass None and receive them.

        The arrays remain in the runtime's store, so they should be small.
        """
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
        """Reduce the arrays of all processes by ``merge`` along a binary tree, neighbours first.

        At each level half of the remaining processes send theirs. The first process returns the
        result, every other one what it sent.
        """
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
    """Receive the arrays that another process sends under this key, waiting for them."""
    with _lost_in_one_line():
        content = _store().blocking_key_value_get_bytes(key, 1000 * _PATIENCE)
        if delete:
            _store().key_value_delete(key)
    with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
        return dict(arrays)


def _store() -> Any:
    """Return the runtime's store of keys and values, which the first process keeps.

    JAX has no public name for it. It takes arrays of any size, compiles nothing, and waits for as
    long as the first process searches; Gloo, XLA's collectives on a CPU, gives up after 30 s. 2 MB
    take 0.02 to 0.3 s, several times as long as by a collective."""
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

    The number of processes, the index of this one and the address of the first come from the
    launcher where JAX knows it (SLURM, Open MPI, Kubernetes, cloud TPUs), else from the
    environment: JAX_COORDINATOR_ADDRESS (host:port), JAX_NUM_PROCESSES, JAX_PROCESS_ID. Raises
    InputError where these are missing or wrong.
    """
    import jax  # loaded when first used: refusing bad usage needs none

    given: dict[str, Any] = {}
    for name in ("num_processes", "process_id"):
        text = os.environ.get(f"JAX_{name.upper()}")
        if text is not None and not text.isdecimal():
            raise InputError(f"expected a whole number as JAX_{name.upper()}, got '{text}'")
        given[name] = None if text is None else int(text)
    try:
        jax.distributed.initialize(
            **given, heartbeat_timeout_seconds=_HEARTBEAT, shutdown_timeout_seconds=_PATIENCE
        )
        jax.local_devices()  # all processes tell each other what they have: none may leave it out
    except (ValueError, TypeError, RuntimeError) as error:
        raise InputError(
            "--distributed needs a launcher that JAX knows, such as srun or mpirun, or the "
            f"variables JAX_COORDINATOR_ADDRESS, JAX_NUM_PROCESSES and JAX_PROCESS_ID ({error})"
        ) from error
    atexit.register(abandon, 1)  # of an exception that nobody expects
    return Share(jax.process_index(), jax.process_count())


def wait_for_all() -> None:
    """Wait until every process of the job is here, and leave it."""
    import jax

    jax.distributed.shutdown()


def abandon(status: int) -> None:
    """End this process at once with the exit status ``status``, where it is one of several.

    At the usual end of a program JAX would wait for the others, which would never know of the
    failure.
    """
    jax = sys.modules.get("jax")
    if jax is not None and jax.distributed.is_initialized():
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)


@contextlib.contextmanager
def watched(line: str) -> Iterator[None]:
    """Print ``line`` on stderr if this process is aborted or killed inside the block.

    JAX's runtime aborts a process when another one is lost, with a page of native messages and no
    exception. The native messages are discarded; Python's own still appear. A forked process prints
    the line; nothing is done where the system cannot fork.
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
