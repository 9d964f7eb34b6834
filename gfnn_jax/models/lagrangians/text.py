"""A law as text: its terms by the names of columns, for people, parsers, sympy and LaTeX."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from gfnn_jax.exports.symbolic import as_sympy
from gfnn_jax.families.lagrangian import (
    DRY,
    LINEAR,
    QUADRATIC,
    UNIFORM,
    Friction,
    Powers,
    Terms,
)
from gfnn_jax.models.lagrangians.friction_choice import DECIDED, FrictionChoice
from gfnn_jax.models.lagrangians.libraries import FRICTIONS, KINDS, losses
from gfnn_jax.models.lagrangians.structure import powers_of

_GREEK = {
    "theta": "θ",
    "phi": "φ",
    "psi": "ψ",
    "alpha": "α",
    "beta": "β",
    "gamma": "γ",
    "omega": "ω",
}
_SUBSCRIPTS = str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉")
_SUPERSCRIPTS = str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")


class Term(NamedTuple):
    """One term, its coefficient and that one's standard error (0 where the gauge gives it)."""

    term: str
    coefficient: float
    std: float


@dataclasses.dataclass(frozen=True)
class Expression:
    """A sum of terms in the positions and velocities, by their names."""

    terms: tuple[Term, ...]

    @property
    def formula(self) -> str:
        """Formula as Python writes it, which ``--terms`` and sympy read."""
        return _sum(f"{_digits(c, s)}*{t}" for t, c, s in self.terms) or "0"

    def __str__(self) -> str:
        """Formula as a person writes it: the last digits' standard errors in brackets."""
        return _sum(f"{measured(c, s)} {_pretty(t)}" for t, c, s in self.terms) or "0"

    def sympy(self) -> Any:
        """Formula as a sympy expression."""
        return as_sympy(self.formula)

    def latex(self) -> str:
        return _sum(f"{_digits(c, s)} {_latex(t)}" for t, c, s in self.terms) or "0"


def terms_of(
    terms: Terms,
    coefficients: np.ndarray,
    std: np.ndarray,
    names: Sequence[str],
    speeds: Sequence[str],
) -> Expression:
    """Terms of Σ θ_j ℓ_j; a phase other than that of a cosine or a sine stays in the argument."""
    listed = []
    for (k, n, m, phase), c, s in zip(terms.rows(), coefficients, std, strict=True):
        factors = [_power(v, e) for v, e in zip(speeds, k, strict=True) if e]
        factors += [_power(q, e) for q, e in zip(names, n, strict=True) if e]
        if any(m):
            factors.append(_wave(m, phase, names))
        listed.append(Term("*".join(factors) or "1", float(c), float(s)))
    return Expression(tuple(listed))


def friction_of(
    friction: Friction, losses: np.ndarray, std: np.ndarray, speeds: Sequence[str]
) -> Expression:
    """Rayleigh's R; uniform friction, a row without a direction, is γ T."""
    listed = []
    for (c, kind, width), rho, s in zip(friction.rows(), losses, std, strict=True):
        if kind == UNIFORM:
            listed.append(Term("T", float(rho), float(s)))
            continue
        parts = zip(reversed(c), reversed(list(speeds)), strict=True)
        speed = _sum(("-" if e < 0 else "") + _times(abs(e), v) for e, v in parts if e)
        if kind == QUADRATIC:
            listed.append(Term(f"abs({speed})**3", rho / 3, s / 3))
            continue
        if kind == DRY and width == 0:
            listed.append(Term(f"abs({speed})", float(rho), float(s)))
            continue
        speed = f"({speed})" if sum(map(bool, c)) > 1 else speed
        if kind == LINEAR:
            listed.append(Term(f"{speed}**2", rho / 2, s / 2))
        else:
            listed.append(Term(f"sqrt({speed}**2 + {width**2:.4g})", float(rho), float(s)))
    return Expression(tuple(listed))


def of_systems(found: Expression, powers: Powers, parameters: Sequence[str]) -> Expression:
    """The expression with each term multiplied by its powers (m, k) of the parameters: cos(q)/l."""
    return Expression(
        tuple(
            term._replace(term=_with_powers(term.term, row, parameters))
            for term, row in zip(found.terms, powers, strict=True)
        )
    )


def _with_powers(term: str, powers: Sequence[int], parameters: Sequence[str]) -> str:
    for name, n in zip(parameters, powers, strict=True):
        if n:
            term = ("" if term == "1" and n > 0 else f"{term}{'*' if n > 0 else '/'}") + _power(
                name, abs(n)
            )
    return term


def word_of(
    key: tuple[Any, ...],
    names: Sequence[str],
    speeds: Sequence[str],
    parameters: Sequence[str] = (),
) -> str:
    """A coefficient of a structure, by its term."""
    kind, *rest = key
    one, none = np.ones(1), np.zeros(1)
    if kind in ("term", "loss"):
        found = (
            terms_of(Terms.of(rest, len(names)), one, none, names, speeds)
            if kind == "term"
            else friction_of(Friction.of(rest, len(names)), one, none, speeds)
        )
        powers = (powers_of(rest[0], len(parameters)),)
        (term,) = of_systems(found, powers, parameters).terms
        return term.term if kind == "term" else f"R: {term.term}"
    return f"{'gain' if kind == 'gain' else 'zero'} of {names[rest[0]]}"


@dataclasses.dataclass(frozen=True)
class WhichFriction:
    """The kinds of friction that a record shows. odds: that they forecast better than other kinds
    ("none", "quadratic", "linear+dry", …). limits: of terms of R of kinds that were not seen, the
    largest coefficients that the record allows (two standard errors)."""

    kinds: tuple[str, ...]
    odds: dict[str, float]
    limits: dict[str, float]

    def __str__(self) -> str:
        text = "+".join(self.kinds) or "none"
        if self.odds:
            rival = min(self.odds, key=lambda name: self.odds[name])
            text += f", on held-out arcs odds of {odds_text(self.odds[rival])} against {rival}"
            if self.odds[rival] < 1:
                text += f"; of sets within odds of {DECIDED:.0f} : 1 that of fewest kinds is kept"
        below = [f"of {_pretty(term)} below {limit:.2g}" for term, limit in self.limits.items()]
        return text + (f"; not seen, coefficients in R (2 σ): {', '.join(below)}" if below else "")


def which_friction_line(
    choice: FrictionChoice, scale: float, dim: int, speeds: Sequence[str]
) -> WhichFriction:
    """The choice in the recording's words; ``scale`` is that of L."""

    def named(kinds: tuple[int, ...]) -> str:
        return "+".join(FRICTIONS[KINDS.index(k)] for k in kinds) or "none"

    plain = {direction for direction, _, _ in losses(dim, KINDS, 0.0)}
    rows = [r for r in choice.limits if r[1] not in choice.kinds and r[0] in plain and len(r) == 3]
    largest = scale * np.array([choice.limits[row] for row in rows])
    terms = friction_of(Friction.of(rows, dim), largest, 0 * largest, speeds).terms
    return WhichFriction(
        tuple(FRICTIONS[KINDS.index(k)] for k in choice.kinds),
        {named(kinds): odds for kinds, odds in choice.odds.items()},
        {t.term: t.coefficient for t in terms},
    )


def speed_names(positions: Sequence[str], velocities: Sequence[str]) -> tuple[str, ...]:
    """Names of the velocities: of their columns, or omega1 of theta1 and v1 of x1; q_dot of q, and
    of all where one is named otherwise."""
    if len(velocities) == len(positions):
        return tuple(velocities)
    found = [re.fullmatch(r"(theta|x)(\w*)", name) for name in positions]
    named = [{"theta": "omega", "x": "v"}[one[1]] + one[2] for one in found if one]
    if len(named) < len(positions) or set(named) & set(positions):
        return tuple(f"{name}_dot" for name in positions)
    return tuple(named)


def _wave(m: Sequence[int], phase: float, names: Sequence[str]) -> str:
    """cos or sin of m·q + φ, whichever has the smaller |φ|."""
    sine = abs(phase + np.pi / 2) < np.pi / 4
    rest = phase + np.pi / 2 if sine else phase
    parts = zip(m, names, strict=True)
    inside = _sum(("-" if e < 0 else "") + _times(abs(e), q) for e, q in parts if e)
    if abs(rest) > 1e-12:
        inside = _sum([inside, f"{rest:.5g}"])
    return f"{'sin' if sine else 'cos'}({inside})"


def _times(number: int, name: str) -> str:
    return name if number == 1 else f"{number}*{name}"


def _power(name: str, exponent: int) -> str:
    return name if exponent == 1 else f"{name}**{exponent}"


def _sum(parts: Any) -> str:
    text = ""
    for part in parts:
        if not text:
            text = part
        else:
            text += f" - {part[1:]}" if part.startswith("-") else f" + {part}"
    return text


def odds_text(odds: float) -> str:
    """12 : 1, 1 : 3; those above a million are not told apart."""
    if odds >= 1e6:
        return "> 10⁶ : 1"
    return f"{odds:,.2g} : 1" if odds >= 1 else f"1 : {1 / odds:,.2g}"


def _digits(value: float, std: float) -> str:
    """The coefficient with the digits that its standard error leaves, and one more."""
    if std <= 0 or not np.isfinite(std) or value == 0:
        return f"{value:.12g}"
    return f"{value:.{int(np.clip(np.ceil(np.log10(abs(value) / std)) + 2, 2, 15))}g}"


def measured(value: float, std: float) -> str:
    """0.4073(3): the standard error in units of the last digit."""
    if std <= 0 or not np.isfinite(std):
        return f"{value:.6g}"
    last = int(np.floor(np.log10(std)))
    if last >= 0:
        return f"{value:.0f}({std:.0f})"
    return f"{value:.{-last}f}({round(std * 10.0**-last)})"


def _pretty(term: str) -> str:
    text = re.sub(r"\*\*(\d+)", lambda m: m[1].translate(_SUPERSCRIPTS), term).replace("*", " ")
    text = re.sub(r"abs\(((?:[^()]|\([^()]*\))*)\)", r"|\1|", text).replace(" - ", "−")
    return re.sub(r"[A-Za-z]+[0-9]*", lambda m: _symbol(m[0]), text)


def _symbol(name: str) -> str:
    found = re.fullmatch(r"([A-Za-z]+?)(\d*)", name)
    assert found is not None
    return _GREEK.get(found[1], found[1]) + found[2].translate(_SUBSCRIPTS)


def _latex(term: str) -> str:
    text = re.sub(r"\*\*(\d+)", r"^{\1}", term).replace("*", r" \, ")
    text = re.sub(r"\b(sin|cos|sqrt)\(", r"\\\1(", text)

    def symbol(found: re.Match) -> str:
        greek = "\\" + found[1] if found[1] in _GREEK else found[1]
        return greek + (f"_{{{found[2]}}}" if found[2] else "")

    return re.sub(r"(?<!\\)\b([A-Za-z]+?)(\d*)\b", symbol, text)
