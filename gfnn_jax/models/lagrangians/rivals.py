"""Terms of other shapes that may follow a record as well as those of its law.

Beside springs r^3.5 imitates r^4 along an orbit whose distance changes little, so that a law with a
power of the distance is fitted again with the next halves of whole numbers. A small constant force
pushes as friction does that is stronger one way, so that a law with both it and linear friction is
fitted again with friction of either side. Powers of a length may be a series of another shape: the
weak form tells the constant inside it, and fits beside that correct it. Laws with as many
coefficients have odds by the sums of their squares (`fitting.evidence`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.optimize import minimize_scalar

from gfnn_jax.families.expressions import factors_of, parse
from gfnn_jax.families.lagrangian import LINEAR, ONE_SIDED, shape_of
from gfnn_jax.fitting.evidence import criterion
from gfnn_jax.models.lagrangians.fit import LawFit
from gfnn_jax.models.lagrangians.libraries import SHAPES, central, losses, shaped, torques
from gfnn_jax.models.lagrangians.structure import Row, Structure, is_constant
from gfnn_jax.models.lagrangians.weak_form import weak_share


@dataclasses.dataclass(frozen=True)
class RivalOptions:
    """Limits of what is tried (`benchmarks/any_record.py`, `vocabulary.py`).

    most: powers of the distance to either side. series: potentials, from which on they may be the
    series of a shape. constants: inside a shape, times the range of the motion, where it begins;
    apart: relative, of fits that correct it; corrections: of it.
    """

    most: int = 4
    series: int = 3
    constants: tuple[float, ...] = (0.5, 1.0, 2.0, 4.0, 8.0)
    apart: float = 0.01
    corrections: int = 2


OPTIONS = RivalOptions()


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


def with_a_shape(fit: LawFit) -> LawFit:
    """The fit of one length with a shape (`libraries.SHAPES`) in place of its powers, where that is
    likelier than these, and than any other shape, by odds that decide."""
    structure, count = fit.structure, _independent(fit)
    powers = [row for row in structure.terms if not any(row[0])]
    if structure.dim > 1 or fit.problem.angles or len(powers) < OPTIONS.series or not fit.follows:
        return fit
    units = np.array(OPTIONS.constants) / np.ptp(fit.problem.states[:, 0])
    masses = tuple(row for row in structure.terms if any(row[0]) and is_constant(row))
    found = [(criterion(fit.fitted.cost, count, len(fit.p)), "", fit)]
    for name in SHAPES:

        def of(a: float, name: str = name) -> Structure:
            return dataclasses.replace(structure, terms=(*masses, *shaped(name, a)))

        def share(a: float, of=of) -> float:
            return weak_share(of(a), fit.problem)

        begun = min((units * side for side in (1, -1)), key=lambda row: min(map(share, row)))
        near = min(begun, key=share)
        ends = sorted((near / 2, near * 2))
        least_at: Any = minimize_scalar(share, bounds=ends, method="bounded")
        a = float(least_at.x)
        other = fit.again(of(a), rescale=False)
        for _ in range(OPTIONS.corrections):
            steps = a * (1 + OPTIONS.apart * np.array([-1, 0, 1]))
            costs = [fit.again(of(b), other.values, rescale=False).fitted.cost for b in steps]
            bend, slope, _ = np.polyfit([-1, 0, 1], costs, 2)
            if not (np.isfinite(bend) and bend > 0):
                break
            a *= float(1 - OPTIONS.apart * slope / (2 * bend))
        other = fit.again(of(a), other.values, rescale=False)
        if other.follows and other.is_definite:
            size = criterion(other.fitted.cost, count, len(other.p) + 1)
            found.append((size, f"{name}, A = {a:.5g},", other))
    (least, name, best), *others = sorted(found, key=lambda one: one[0])
    decide = 2 * np.log(fit.problem.options.evidence.decided)
    if best is fit or min(one[0] for one in others) < least + decide:
        return fit
    fit.problem.on_progress(f"  {name} in place of {len(powers)} powers")
    return best.again()


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


def one_sided(fit: LawFit, coordinates: Sequence[str]) -> str:
    """A line on the coordinate whose friction may be stronger one way in place of a constant force
    beside it; "" where there is none, or where that has no odds against it that decide."""
    structure, evidence = fit.structure, fit.problem.options.evidence
    d, values = structure.dim, fit.values
    sides = losses(d, (ONE_SIDED,), 0.0)
    if not fit.problem.options.choose_friction:
        return ""
    for i, force in enumerate(torques(d, range(d))):
        rubs = losses(d, (LINEAR,), 0.0)[i]
        own = sides[2 * i : 2 * i + 2]
        if force not in structure.terms or rubs not in structure.friction:
            continue
        known = values | dict.fromkeys((("loss", side) for side in own), values["loss", rubs])
        other = structure.without({("term", force), ("loss", rubs)})
        again = fit.again(other.plus([("loss", side) for side in own]), known, rescale=False)
        odds = evidence.odds(fit.fitted.cost, again.fitted.cost, _independent(fit))
        if again.follows and odds < evidence.decided:
            return (
                f"friction of {coordinates[i]} that is stronger one way follows the record as the "
                "constant force on it does. A record that ends at rest would decide: the force "
                "shifts where it rests"
            )
    return ""


def _independent(fit: LawFit) -> float:
    """The number of residuals that are independent."""
    return np.count_nonzero(np.isfinite(fit.arcs.y)) / fit.correlation


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
    found = {own: fit}

    def odds(fit: LawFit) -> float:
        """Odds of the best so far over a fit."""
        least = min(other.fitted.cost for other in found.values())
        return evidence.odds(least, fit.fitted.cost, _independent(fit))

    for step in (-0.5, 0.5):
        first = np.ceil(2 * own) / 2 if step < 0 else np.floor(2 * own) / 2
        for a in (first + step * np.arange(1, OPTIONS.most + 1)).tolist():
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
