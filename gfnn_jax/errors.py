"""Errors and the warning of the package, each a message of one line."""

from __future__ import annotations


class InputError(ValueError):
    """Error of usage or input. The message names what was expected and what came."""

    def __init__(self, message: str):
        super().__init__(" ".join(message.split()))


class WorkError(RuntimeError):
    """Failure during the work, such as a full disk. Files that existed before are unchanged."""

    def __init__(self, message: str):
        super().__init__(" ".join(message.split()))


class FitError(ValueError):
    """Error of data or of a request that can give no map: what was expected and what came."""

    def __init__(self, message: str):
        super().__init__(" ".join(message.split()))


class OutOfTime(Exception):
    """The budget of a fit is spent; what was found so far stands."""


class FitWarning(UserWarning):
    """Warning about a fit that continued: what was found and what it means for the result."""
