"""Functions that a formula may contain, by name, with their first two derivatives."""

from __future__ import annotations

import re
from collections.abc import Callable


def _squared(xp, v):
    return v * v


# name -> f, f', f'' of a value v with f(v) = y: functions of (xp, v, y).
DERIVATIVES: dict[str, tuple[Callable, Callable, Callable]] = {
    "tan": (
        lambda xp, v: xp.tan(v),
        lambda xp, v, y: 1 + y * y,
        lambda xp, v, y: 2 * y * (1 + y * y),
    ),
    "exp": (lambda xp, v: xp.exp(v), lambda xp, v, y: y, lambda xp, v, y: y),
    "log": (lambda xp, v: xp.log(v), lambda xp, v, y: 1 / v, lambda xp, v, y: -1 / (v * v)),
    "sqrt": (
        lambda xp, v: xp.sqrt(v),
        lambda xp, v, y: 0.5 / y,
        lambda xp, v, y: -0.25 / (y * v),
    ),
    "sinh": (lambda xp, v: xp.sinh(v), lambda xp, v, y: xp.cosh(v), lambda xp, v, y: y),
    "cosh": (lambda xp, v: xp.cosh(v), lambda xp, v, y: xp.sinh(v), lambda xp, v, y: y),
    "tanh": (
        lambda xp, v: xp.tanh(v),
        lambda xp, v, y: 1 - y * y,
        lambda xp, v, y: -2 * y * (1 - y * y),
    ),
    "arctan": (
        lambda xp, v: xp.arctan(v),
        lambda xp, v, y: 1 / (1 + v * v),
        lambda xp, v, y: -2 * v / _squared(xp, 1 + v * v),
    ),
}
CHEBYSHEV = re.compile(r"T\d{1,2}")
CIRCULAR = ("sin", "cos")  # which share their values
FUNCTIONS = (*CIRCULAR, *DERIVATIVES)
