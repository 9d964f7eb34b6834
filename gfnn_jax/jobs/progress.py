"""Progress messages of a job, and their display on standard error."""

import contextlib
import re
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


_PART = re.compile(r"(.*) \((\d+) of (\d+)\)$")  # a message about the k-th of n equal parts
_ABOUT = re.compile(r"\(about (\d+) s\)$")  # one that foretells how long its work takes


class _Left:
    """Estimate of the time left of work in equal parts, by the messages that begin them."""

    def __init__(self):
        self._what, self._began, self._first = "", 0.0, 1

    def of(self, message: str, now: float) -> str:
        """Words for behind a message, "" where nothing is known."""
        found = _PART.match(message)
        if found is None:
            return ""
        what, part, count = found[1], int(found[2]), int(found[3])
        if what != self._what:
            self._what, self._began, self._first = what, now, part
        done = part - self._first
        left = (now - self._began) / done * (count - part + 1) if done else 0.0
        return f", about {left:.0f} s left" if left >= 1 else ""


def _so_far(message: str, seconds: float) -> str:
    """A message shown again after so many seconds, with those left where it foretells them."""
    found = _ABOUT.search(message)
    left = int(found[1]) - seconds if found else 0.0
    return f"{message} … {seconds:.0f} s so far" + (f", about {left:.0f} s left" * (left >= 1))


class _Lines:
    """Writer of lines with the seconds since the start; a thread repeats the last status, or the
    last line of a job that gives none, with the seconds that it has taken."""

    def __init__(self):
        self._started = time.perf_counter()
        self._last = self._started - BETWEEN  # the first line comes at once
        self._message, self._has_status = "starting", False
        self._since, self._left = self._started, _Left()
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
            self._print(message + self._left.of(message, time.perf_counter()))

    def meanwhile(self, message: str) -> None:
        """Show what is compiled while the work waits, until a message of "" goes back to that."""
        with self._lock:
            if message:
                self._waits = self._message, self._has_status, self._since
                self._take(message, True)
            else:
                self._message, self._has_status, self._since = self._waits

    def _take(self, message: str, has_status: bool) -> None:
        now = time.perf_counter()
        shown = message + self._left.of(message, now)
        self._since = self._since if shown == self._message else now
        self._message, self._has_status = shown, has_status

    def stop(self) -> None:
        self._stopped.set()
        self._thread.join()

    def _repeat(self) -> None:
        while not self._stopped.wait(LONGEST_SILENCE / 10):
            with self._lock:
                now = time.perf_counter()
                if now >= self._last + 0.8 * LONGEST_SILENCE:
                    self._print(_so_far(self._message, now - self._since))

    def _print(self, message: str) -> None:
        self._last = time.perf_counter()
        print(f"[{self._last - self._started:6.1f} s] {message}", file=sys.stderr, flush=True)
