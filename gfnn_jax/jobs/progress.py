"""Progress messages of a job, and their display on standard error."""

from __future__ import annotations

import contextlib
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

from gfnn_jax import compiling

# Least and most seconds between lines where standard error is no terminal.
BETWEEN, LONGEST_SILENCE = 2.0, 5.0


def _nothing(message: str) -> None:
    del message


class Progress(NamedTuple):
    """Functions that show messages: ``status`` the current work, now and then; ``line`` always."""

    status: Callable[[str], Any] = _nothing
    line: Callable[[str], Any] = _nothing


SILENT = Progress()


@contextlib.contextmanager
def on_stderr() -> Iterator[Progress]:
    """Show a status line on a terminal; elsewhere a line now and then, every 5 s at least."""
    if not sys.stderr.isatty():
        lines = _Lines()
        compiling.told.append(lines.meanwhile)
        try:
            yield Progress(lines.status, lines.line)
        finally:
            compiling.told.remove(lines.meanwhile)
            lines.stop()
        return
    from rich.console import Console
    from rich.markup import escape

    console = Console(stderr=True)

    def line(message: str) -> None:
        if message:
            console.print(escape(message), highlight=False)

    with console.status("working") as status:
        compiling.told.append(line)
        try:
            yield Progress(lambda message: status.update(escape(message)), line)
        finally:
            compiling.told.remove(line)


class _Lines:
    """Writer of lines with the seconds since the start; a thread repeats the last status, or the
    last line of a job that gives none, with the seconds that it has taken."""

    def __init__(self):
        self._started = time.perf_counter()
        self._last = self._started - BETWEEN  # the first line comes at once
        self._message, self._has_status = "starting", False
        self._since = self._started
        self._waits = self._message, self._has_status, self._since
        self._lock, self._stopped = threading.Lock(), threading.Event()
        self._thread = threading.Thread(target=self._repeat, daemon=True)
        self._thread.start()

    def status(self, message: str) -> None:
        with self._lock:
            self._take(message, True)
            if time.perf_counter() >= self._last + BETWEEN:
                self._print(self._message)

    def line(self, message: str) -> None:
        with self._lock:
            if not self._has_status:
                self._take(message.strip(), False)
            self._print(message)

    def meanwhile(self, message: str) -> None:
        """Show what is compiled while the work waits, until a message of "" goes back to that."""
        with self._lock:
            if message:
                self._waits = self._message, self._has_status, self._since
                self._take(message, True)
            else:
                self._message, self._has_status, self._since = self._waits

    def _take(self, message: str, has_status: bool) -> None:
        """Note what is being done, and since when."""
        self._since = self._since if message == self._message else time.perf_counter()
        self._message, self._has_status = message, has_status

    def stop(self) -> None:
        self._stopped.set()
        self._thread.join()

    def _repeat(self) -> None:
        while not self._stopped.wait(LONGEST_SILENCE / 10):
            with self._lock:
                now = time.perf_counter()
                if now >= self._last + 0.8 * LONGEST_SILENCE:
                    self._print(f"{self._message} … {now - self._since:.0f} s so far")

    def _print(self, message: str) -> None:
        self._last = time.perf_counter()
        print(f"[{self._last - self._started:6.1f} s] {message}", file=sys.stderr, flush=True)
