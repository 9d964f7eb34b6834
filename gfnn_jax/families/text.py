"""Formulas as text: as code has them, "0.5*p1**2 - cos(q1)", and as people do, "0.5 p1² - cos(q1)".

Code is what ``--terms``, `families.expressions.parse` and sympy read.
"""

import keyword
import re
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from gfnn_jax.families.functions import known_functions

OTHER_NAMES = {"atan": "arctan", "ln": "log"}
_RAISED = "⁰¹²³⁴⁵⁶⁷⁸⁹"
_LETTERS = ("theta", "phi", "psi", "alpha", "beta", "gamma", "omega")
GREEK = dict(zip(_LETTERS, "θφψαβγω", strict=True))
_FACTORS = re.compile(r"([\w.]+|\)) +(?=(\w+|\())")


class Term(NamedTuple):
    """One term of a law, its coefficient and that one's standard error, 0 where there is none."""

    term: str
    coefficient: float
    std: float


def added(parts: Iterable[str]) -> str:
    """Write the sum of summands, "a - b" of "a" and "-b"."""
    return " + ".join(parts).replace("+ -", "- ")


def power(name: str, exponent: int) -> str:
    """Write a power of a name as code."""
    return name if exponent == 1 else f"{name}**{exponent}"


def combination(numbers: Sequence[int], names: Sequence[str]) -> str:
    """Write Σ m_i x_i of whole numbers m as code: "q1 - 2*q2"."""
    each = zip(numbers, names, strict=True)
    return added(
        ("-" if m < 0 else "") + ("" if abs(m) == 1 else f"{abs(m)}*") + x for m, x in each if m
    )


def digits(value: float, std: float, spare: int = 2) -> str:
    """Write a coefficient with the digits that its standard error leaves, and ``spare`` more."""
    if std <= 0 or not np.isfinite(std) or value == 0:
        return f"{value:.12g}"
    return f"{value:.{int(np.clip(np.ceil(np.log10(abs(value) / std)) + spare, 2, 12))}g}"


def measured(value: float, std: float) -> str:
    """Write 0.4073(3): the standard error in units of the last digit."""
    if std <= 0 or not np.isfinite(std):
        return f"{value:.6g}"
    last = int(np.floor(np.log10(std)))
    if last >= 0:
        return f"{value:.0f}({std:.0f})"
    return f"{value:.{-last}f}({round(std * 10.0**-last)})"


def superscript(number: int | str) -> str:
    """Write a whole number as an exponent: "²"."""
    return str(number).translate(str.maketrans("0123456789", _RAISED))


def shown(code: str) -> str:
    """Write code as people read it: "p1² cos(q1)" of "p1**2*cos(q1)"."""
    raised = re.sub(r"\*\*(\d+)(?![.\d])", lambda n: superscript(n[1]), code)
    return re.sub(r"(?<!\*)\*(?!\*)", " ", raised)


def plain(text: str) -> str:
    """Write a formula as people read it, "0.5 p1² − cos(q1)", as code: the inverse of `shown`.

    Text that is code already stays as it is.
    """
    lowered = str.maketrans(_RAISED, "0123456789")
    text = re.sub(f"[{_RAISED}]+", lambda found: f"**{found[0].translate(lowered)}", text)

    def times(found: re.Match) -> str:
        called = found[1] in {*known_functions(), *OTHER_NAMES} and found[2] == "("
        code = called or any(keyword.iskeyword(word) for word in found.groups())
        return found[0] if code else f"{found[1]}*"

    return _FACTORS.sub(times, text.replace("−", "-"))


def barred(text: str) -> str:
    """Write "|x|" in place of "abs(x)"."""
    return re.sub(r"abs\(((?:[^()]|\([^()]*\))*)\)", r"|\1|", text)


def in_letters(code: str) -> str:
    """Write code as `shown` does, with Greek letters, subscripts and bars: "θ₁² |ω₂−ω₁|"."""
    text = barred(shown(code)).replace(" - ", "−")

    def symbol(found: re.Match) -> str:
        lowered = found[2].translate(str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉"))
        return GREEK.get(found[1], found[1]) + lowered

    return re.sub(r"([A-Za-z]+)([0-9]*)", symbol, text)
