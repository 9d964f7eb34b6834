"""How a job or a fit ends early, and what it warns of, each told in one line."""

from __future__ import annotations


class InputError(ValueError):
    """Bad usage or bad input, in one line: what was expected and what came."""

    def __init__(self, message: str):
        super().__init__(" ".join(message.split()))


class WorkError(RuntimeError):
    """A failure during the work (a full disk), in one line; what was there before is as it was."""

    def __init__(self, message: str):
        super().__init__(" ".join(message.split()))


class FitError(ValueError):
    """The data or the request cannot give a map: what was expected and what came."""

    def __init__(self, message: str):
        super().__init__(" ".join(message.split()))


class OutOfTime(Exception):
    """The budget of a fit is spent; what was found so far stands."""


class FitWarning(UserWarning):
    """The fit went on, but its user should know."""
