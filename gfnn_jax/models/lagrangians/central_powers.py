"""Powers of the distance in a central force: which of the neighbouring ones are as likely?

Beside springs r^3.5 imitates r^4 along an orbit whose distance changes little. So a law with a
power of the distance is fitted again with the next halves of whole numbers, as far as they follow
its arcs as well: laws with as many coefficients have odds by the sums of their squares
(`fitting.evidence`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from gfnn_jax.families.expressions import factors_of, parse
from gfnn_jax.families.lagrangian import shape_of
from gfnn_jax.models.lagrangians.fit import LawFit
from gfnn_jax.models.lagrangians.libraries import central
from gfnn_jax.models.lagrangians.structure import Row, Structure

MOST = 4  # neighbours that are tried to either side


def with_likeliest_power(fit: LawFit) -> LawFit:
    """The fit with the likeliest power of the distance: with a whole one where that is as good."""
    powers = _as_likely(fit)
    if len(powers) < 2:
        return fit
    whole = {a: other for a, other in powers.items() if a.is_integer()} or powers
    best = min(whole, key=lambda a: whole[a].fitted.cost)
    if whole[best] is fit:
        return fit
    fit.problem.on_progress(f"  r**{best:g} in place of r**{_power(fit):g}: it is as likely")
    return whole[best].again()


def other_powers(fit: LawFit, coordinates: Sequence[str]) -> str:
    """A line on the powers of the distance that follow a record as that of its law does; "" where
    there are none."""
    others = [a for a, other in _as_likely(fit).items() if other is not fit]
    if not others:
        return ""
    squares = " + ".join(f"{name}**2" for name in coordinates)
    named = " or ".join(f"r**{a:g}" for a in sorted(others))
    return (
        f"the power of the distance r = sqrt({squares}) may be {named} in place of "
        f"r**{_power(fit):g}. A start farther out, or closer in, would decide"
    )


def _power(fit: LawFit) -> float | None:
    """The power of the distance that a law has; None of a law without."""
    d = fit.structure.dim
    distance = parse(shape_of(central(d, 1.0)[0]), d)
    found = (factors_of(parse(shape_of(row) or "1", d)) for row in fit.structure.terms)
    return next((one[distance] for one in found if set(one) == {distance}), None)


def _as_likely(fit: LawFit) -> dict[float, LawFit]:
    """The law's own power of the distance, and neighbours of it -> fits: those against which the
    best of them has no odds that decide. Empty of a law without such a power."""
    own, evidence = _power(fit), fit.problem.options.evidence
    if own is None or not fit.follows:
        return {}
    springs = any(max(row[1]) == 2 and not any(row[0]) for row in fit.structure.terms)
    count = np.count_nonzero(np.isfinite(fit.arcs.y)) / fit.correlation
    found = {own: fit}

    def odds(fit: LawFit) -> float:
        """Odds of the best so far over a fit."""
        least = min(other.fitted.cost for other in found.values())
        return evidence.odds(least, fit.fitted.cost, count)

    for step in (-0.5, 0.5):
        first = np.ceil(2 * own) / 2 if step < 0 else np.floor(2 * own) / 2
        for a in (first + step * np.arange(1, MOST + 1)).tolist():
            if a == 0 or (a == 2 and springs):
                continue  # which the other terms are
            other = fit.again(_with_power(fit, own, a), rescale=False)
            if not other.follows or odds(other) > evidence.decided:
                break
            found[a] = other
    return {a: other for a, other in found.items() if odds(other) < evidence.decided}


def _with_power(fit: LawFit, own: float, other: float) -> Structure:
    """The structure with another power of the distance."""
    structure = fit.structure
    before, after = (shape_of(central(structure.dim, a)[0]) for a in (own, other))

    def turned(row: Row) -> Row:
        return (*row[:4], after, *row[5:]) if shape_of(row) == before else row

    return dataclasses.replace(structure, terms=tuple(map(turned, structure.terms)))
