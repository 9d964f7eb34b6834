"""A line of a table of hard cases: digits kept, what was said, what went wrong without a word."""

from __future__ import annotations

import dataclasses
import math

# Sets float64, so it comes before all of JAX.
from harness import angles_of, fitted

# isort: split
import numpy as np

import gfnn_jax as gfnn
from gfnn_jax.coordinates import nearest_image
from gfnn_jax.solve.status import OK, STATUS_NAMES

# A case is silent where so many digits less than asked for are kept, and nothing was said.
_SHORT = 1.0
# The tolerance is for the RMS: at the rim of the data errors are so many times larger.
_RIM = 100.0
# What a fit that meets its tolerance says where some states err by more.
_OF_SOME_STATES = (
    "few states make",
    "are far from the map of the others",
    "lie at the edge of the data",
)


@dataclasses.dataclass(frozen=True)
class Case:
    """A line of a table.

    digits: −log₁₀ of what is wrong, relative to its size; None where there is no such number.
    asked: the digits that were asked for, None where the case only has to be flagged or refused.
    flagged: what was said while it went on; failed: how it was refused or stopped.
    wrong: how many things went wrong without a word, where they are counted one by one.
    """

    name: str
    digits: float | None = None
    asked: float | None = None
    flagged: str = ""
    failed: str = ""
    wrong: int = 0

    @property
    def silent(self) -> bool:
        kept = -math.inf if self.digits is None else self.digits
        short = self.asked is not None and kept < self.asked - _SHORT
        return self.wrong > 0 or (short and not self.flagged and not self.failed)


def digits_of(error: float) -> float | None:
    """Digits of a relative error."""
    return -math.log10(max(error, 1e-17)) if math.isfinite(error) else None


def counts(status) -> str:
    """Statuses but ok, in words: "12 left the domain"."""
    number_of = np.bincount(np.ravel(np.asarray(status)), minlength=len(STATUS_NAMES))
    return ", ".join(
        f"{n} {name}" for n, name in zip(number_of[1:], STATUS_NAMES[1:], strict=True) if n
    )


def tried(name: str, pairs, scene, fresh, *, tolerance: float = 1e-6, **options):
    """Fit to an absolute tolerance and judge on fresh pairs: (Case, the fit or None)."""
    spread = float(np.std(np.asarray(fresh.z1), axis=0).max())
    asked = digits_of(tolerance / spread)
    try:
        fit, measured = fitted(pairs, scene, fresh, absolute_tolerance=tolerance, **options)
    except gfnn.FitError as error:
        return Case(name, None, asked, failed=str(error)), None
    image, info = fit.map.step(fresh.z0)
    error = nearest_image(np.asarray(image) - np.asarray(fresh.z1), angles_of(scene))
    # Where nothing is said of the error, every lane called ok must be about as good as asked.
    bad = np.abs(error).max(axis=1) > _RIM * tolerance
    some = any(words in message for message in fit.messages for words in _OF_SOME_STATES)
    said_so = not fit.met or some
    wrong = 0 if said_so else int(np.sum(bad & (np.asarray(info.status) == OK)))
    said = "; ".join(brief(message) for message in fit.messages)
    flagged = "; ".join(part for part in (said, counts(info.status)) if part)
    kept = digits_of(measured["one_step_rms"] / spread)
    return Case(name, kept, asked, flagged, wrong=wrong), fit


def brief(message: str) -> str:
    """The first clause of a warning: what a table has room for."""
    return message.split(": ")[0] if len(message) > 60 else message
