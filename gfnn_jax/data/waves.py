"""Inputs that are functions of time alone, which no column needs: cos(1.37*t), sin(1.37*t)."""

from __future__ import annotations

import re

import numpy as np

_WAVE = re.compile(r"(cos|sin)\((\d[\d.]*(?:e[-+]?\d+)?)\*t\)")
_OF = {"cos": np.cos, "sin": np.sin}


def wave_names(omega: float) -> tuple[str, str]:
    """The names of the two waves of an angular frequency, in rad/s."""
    return f"cos({omega:.10g}*t)", f"sin({omega:.10g}*t)"


def wave(name: str, t: np.ndarray) -> np.ndarray | None:
    """The wave (n,) of this name at times t (n,) in seconds; None for the name of a column.

    >>> wave("cos(2*t)", np.zeros(2))
    array([1., 1.])
    """
    found = _WAVE.fullmatch(name)
    return None if found is None else _OF[found[1]](float(found[2]) * t)


def is_wave(name: str) -> bool:
    """Return whether a name is one of a wave."""
    return _WAVE.fullmatch(name) is not None
