"""The process of a command: JAX and its devices, signals, warnings."""

from __future__ import annotations

import atexit
import contextlib
import gc
import os
import signal
import sys
import warnings
from collections.abc import Iterator

from gfnn_jax.compiling import enable_compile_cache
from gfnn_jax.storage.outputs import signals_handled


class Terminated(KeyboardInterrupt):
    """Stop by SIGTERM, as clean as one by Ctrl-C."""


def collect_garbage_seldom() -> None:
    """Let 20,000 new objects, not 700, start a search for reference cycles, and none at the exit.

    Imports and traces make millions of objects that live on: searches among them take half a second
    of the five of ``gfnn run two-body --quick``.
    """
    gc.set_threshold(20_000, 20)
    atexit.register(gc.freeze)


def set_up_jax(devices: int | str | None = None) -> None:
    """Switch on float64, and keep compiled programs in the user's cache folder.

    devices: number of devices that a CPU shall have, or "all" its cores; by default it has one.
    """
    import jax

    jax.config.update("jax_enable_x64", True)
    is_set = "xla_force_host_platform_device_count" in os.environ.get("XLA_FLAGS", "")
    if devices is not None and not is_set:
        with contextlib.suppress(RuntimeError):  # in a session that has its devices already
            most = _cores() if isinstance(devices, str) else min(devices, _cores())
            jax.config.update("jax_num_cpu_devices", most)
    enable_compile_cache()


def _cores() -> int:
    """Number of processor cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@contextlib.contextmanager
def stopped_by_sigterm() -> Iterator[None]:
    """Let SIGTERM stop the work as Ctrl-C does. Nothing is done outside the main thread."""

    def stop(*_):
        raise Terminated

    with signals_handled((signal.SIGTERM,), stop):
        yield


@contextlib.contextmanager
def warnings_in_one_line() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.simplefilter("default", UserWarning)

        def show(message, category, filename, lineno, file=None, line=None):
            print(f"gfnn: warning: {message}", file=sys.stderr)

        warnings.showwarning = show
        yield
