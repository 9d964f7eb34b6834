"""Errors and the warning of the package, each a message of one line."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from typing import Any


class InputError(ValueError):
    """Error of usage or input. The message names what was expected and what came."""

    def __init__(self, message: str):
        super().__init__(" ".join(message.split()))


class WorkError(RuntimeError):
    """Failure during the work, such as a full disk. Files that existed before are unchanged."""

    def __init__(self, message: str):
        super().__init__(" ".join(message.split()))


class FitError(ValueError):
    """Error of data or of a request that can give no map: what was expected and what came.

    verdict: what the data tell, ``no law`` or ``not mechanical`` with a reason, where the search
    has come to one; "" where the data or the request were refused. fit: the fit behind a verdict,
    where there is one.
    """

    def __init__(self, message: str, verdict: str = "", fit: Any = None):
        super().__init__(" ".join(message.split()))
        self.verdict, self.fit = verdict, fit


class OutOfTime(Exception):
    """The budget of a fit is spent; what was found so far stands."""


class FitWarning(UserWarning):
    """Warning about a fit that continued: what was found and what it means for the result."""


def unexpected(owner: str, name: str, names: Sequence[str]) -> str:
    """Message about a keyword that ``owner`` has not, with the nearest one that it has."""
    near = difflib.get_close_matches(name, names, n=1)
    hint = f"did you mean {near[0]}?" if near else f"expected {', '.join(names)}"
    return f"{owner}: unexpected keyword argument '{name}', {hint}"
