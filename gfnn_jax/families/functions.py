"""Functions that a formula may contain, by name, with their first two derivatives."""

import keyword
import re
from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import numpy as np

from gfnn_jax.errors import InputError

# name -> f, f', f'' of a value v with f(v) = y: functions of (xp, v, y).
DERIVATIVES: dict[str, tuple[Callable, Callable, Callable]] = {
    "tan": (
        lambda xp, v: xp.tan(v),
        lambda xp, v, y: 1 + y * y,
        lambda xp, v, y: 2 * y * (1 + y * y),
    ),
    "exp": (lambda xp, v: xp.exp(v), lambda xp, v, y: y, lambda xp, v, y: y),
    "log": (lambda xp, v: xp.log(v), lambda xp, v, y: 1 / v, lambda xp, v, y: -1 / (v * v)),
    "abs": (
        lambda xp, v: xp.abs(v),
        lambda xp, v, y: v / (y + 1e-300),  # 0 at 0
        lambda xp, v, y: 0.0 * v,
    ),
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
        lambda xp, v, y: -2 * v / (1 + v * v) ** 2,
    ),
}
CHEBYSHEV = re.compile(r"T\d{1,2}")
CIRCULAR = ("sin", "cos")  # which share their values


@runtime_checkable
class Function(Protocol):
    """A user's own function of one variable: once registered, terms such as "wall(q1)" hold it."""

    @property
    def name(self) -> str: ...

    def derivatives(self, x: Any) -> tuple[Any, Any, Any]:
        """f, f' and f'' at x (...), of the array namespace of x: NumPy in a fit, JAX in a step."""
        ...


def known_functions() -> tuple[str, ...]:
    """Names of the functions that a formula may contain."""
    return (*CIRCULAR, *DERIVATIVES)


_OWN: dict[str, Function] = {}


def own_function(name: str) -> Function | None:
    """The function of a user's own of this name; None where there is none."""
    return _OWN.get(name)


def register_function(function: Function) -> Function:
    """Make a function known to formulas by its name, in terms that are given and in saved maps.

    Raises InputError where the name cannot be one, or names something else.
    """
    name = function.name
    if not name.isidentifier() or keyword.iskeyword(name) or CHEBYSHEV.fullmatch(name):
        raise InputError(f"expected letters, digits and _ as a function's name, got '{name}'")
    if name in known_functions() and _OWN.get(name) is not function:
        raise InputError(f"'{name}' names another function already: choose another name")
    _OWN[name] = function

    def derivatives(v: Any) -> tuple[Any, Any, Any]:
        if getattr(v, "dtype", None) == np.dtype(object):  # symbols of an export
            raise InputError(f"'{name}' is your own function, not C's: --to stablehlo")
        return function.derivatives(v)

    DERIVATIVES[name] = (
        lambda xp, v: derivatives(v)[0],
        lambda xp, v, y: derivatives(v)[1],
        lambda xp, v, y: derivatives(v)[2],
    )
    return function
