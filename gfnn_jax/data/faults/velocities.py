"""Velocities that are not the derivatives of their positions."""

from __future__ import annotations

import itertools
import shlex
from collections.abc import Iterator, Sequence

import numpy as np

from gfnn_jax.data.columns import SECONDS
from gfnn_jax.data.faults import angles
from gfnn_jax.data.faults.fault import Fault
from gfnn_jax.data.traits import Traits
from gfnn_jax.signals.derivatives import Relation, difference

_DERIVATIVE = 0.8  # of a velocity's variance that the position's derivative must explain
_BETTER = 0.25  # score by which other pairs of columns must be better than the declared ones
_NEAR = 0.1  # of a factor like 180/π or 1000
_OFF = 0.2  # logarithm of a factor that no filter makes
_FILTERED = 0.03  # deviation of a factor from 1 that is reported
_LATE = 0.4  # steps of lag that are reported


def related(traits: Traits) -> Iterator[Fault]:
    """The pairs of position and velocity: columns in another order, or factors that mend one."""
    recording = traits.recording
    declared = list(zip(recording.positions, recording.velocities, strict=False))
    still = {
        n for n in recording.columns if np.nanmin(traits.columns[n]) == np.nanmax(traits.columns[n])
    }
    excluded = still | recording.explained  # what a sensor shows is fitted with the law
    declared = [p for p in declared if not excluded & set(p) and not _jumps(traits, p[0])]
    relations = {pair: traits.relation(*pair) for pair in declared}
    known = {pair: relation for pair, relation in relations.items() if relation is not None}
    if not known or len(known) < len(declared):
        return
    other = _other_order(traits, declared)
    if other is not None:
        positions, velocities = zip(*other, strict=True)
        finding = ", ".join(f"{v} is the derivative of {x}" for x, v in other)
        yield Fault(
            "order",
            f"the columns are in another order than their names say: {finding}",
            f"--positions {_typed(positions)} --velocities {_typed(velocities)}",
            {"positions": positions, "velocities": velocities},
        )
        return
    factors = [relation.factor for relation in known.values()]
    second = _second(recording.time_unit, factors)
    if second is not None:
        finding = ", ".join(f"{v} is {r.factor:.4g} × d{x}/dt" for (x, v), r in known.items())
        yield Fault(
            "time unit",
            finding,
            f"The times are in {second}: --time-unit {second}",
            {"time_unit": second},
        )
        return
    for (x, v), relation in known.items():
        yield from _pair(traits, x, v, relation)


def _jumps(traits: Traits, x: str) -> bool:
    """Return whether a column that jumps by turns has not been lifted, so that it has no
    derivative."""
    found = angles.jumps(traits, x)
    return found is not None and not (x in traits.recording.angles and found[0] < 10)


def _other_order(traits: Traits, declared: list[tuple[str, str]]) -> list[tuple[str, str]] | None:
    """The pairs of the same columns that fit much better than the declared ones, or None."""
    if not 1 <= len(declared) <= 3:
        return None
    names = [name for pair in declared for name in pair]
    related = {pair: traits.relation(*pair) for pair in itertools.permutations(names, 2)}
    scores = {pair: 0.0 if r is None else r.likeness for pair, r in related.items()}
    best = max(_pairings(names), key=lambda pairs: sum(scores[pair] for pair in pairs))
    now = sum(scores[pair] for pair in declared)
    better = sum(scores[pair] for pair in best) > now + _BETTER
    good = all(scores[pair] > 0.9 for pair in best)
    if not (better and good and set(best) != set(declared)):
        return None
    return sorted(best, key=lambda pair: names.index(pair[0]))


def _pairings(names: list[str]) -> Iterator[list[tuple[str, str]]]:
    """All ways to make ordered pairs of an even number of names."""
    if not names:
        yield []
        return
    first = names[0]
    for other in names[1:]:
        rest = [name for name in names[1:] if name != other]
        for pairs in _pairings(rest):
            yield [(first, other), *pairs]
            yield [(other, first), *pairs]


def _second(unit: str, factors: list[float]) -> str | None:
    """The unit of time that makes all velocities derivatives, if factors are a power of 1000."""
    power = np.round(np.log10(np.abs(factors)) / 3) * 3
    near = np.abs(np.array(factors) / 10.0**power - 1) < _NEAR
    if not near.all() or len(set(power)) > 1 or power[0] == 0:
        return None
    second = SECONDS[unit] / 10.0 ** power[0]
    return next((name for name, s in SECONDS.items() if np.isclose(s, second)), None)


def _typed(names: Sequence[str]) -> str:
    """Names as one word of a command line."""
    return shlex.quote(",".join(names))


def _pair(traits: Traits, x: str, v: str, relation: Relation) -> Iterator[Fault]:
    factor, degree = relation.factor, 180 / np.pi
    typed_x, typed_v = shlex.quote(x), shlex.quote(v)
    without = f"or ignore {v}: --positions {_typed(traits.recording.positions)}"
    alone = {"positions": traits.recording.positions}
    finding = f"{v} is {factor:.4g} × d{x}/dt"
    if relation.explained < _DERIVATIVE:
        yield Fault(
            "no derivative",
            f"{v} is not the derivative of {x}: d{x}/dt explains "
            f"{100 * relation.explained:.0f} % of its variance",
            f"Name {v} as an input (--inputs {typed_v}), {without}",
            alone,
        )
    elif abs(factor * degree - 1) < _NEAR:
        yield Fault(
            "degrees",
            finding,
            f"The unit of {x} is degrees: --degrees {typed_x}",
            {"degrees": (x,)},
        )
    elif abs(factor / degree - 1) < _NEAR:
        yield Fault(
            "degrees",
            finding,
            f"The unit of {v} is degrees per second: --degrees {typed_v}",
            {"degrees": (v,)},
        )
    elif abs(factor + 1) < _NEAR:
        yield Fault("sign", finding, f"Change the sign of {v} in the file, {without}", alone)
    elif factor < 0 or abs(np.log(factor)) > _OFF:
        yield Fault(
            "factor",
            finding,
            f"Check its unit, fit its scale (--scale {typed_v}), {without}",
            alone,
        )
    else:
        yield from _derived(traits, x, v, relation)


def _derived(traits: Traits, x: str, v: str, relation: Relation) -> Iterator[Fault]:
    """Notes about a velocity that was made of the position."""
    alone = {"positions": traits.recording.positions}
    without = f"To ignore {v}: --positions {_typed(traits.recording.positions)}"
    kind = difference(traits.times, traits.columns[x], traits.columns[v])
    if kind is not None:
        yield Fault(
            "difference",
            f"{v} is the {kind} difference of {x} and adds no information",
            without,
            alone,
            wrong=False,
        )
        return
    error = max(5 * relation.factor_error, _FILTERED)
    late = max(5 * relation.lag_error, _LATE * traits.step)
    if abs(relation.factor - 1) > error or abs(relation.lag) > late:
        yield Fault(
            "filtered",
            f"{v} looks filtered: it is {relation.factor:.3g} × d{x}/dt with a lag of "
            f"{1e3 * relation.lag:.2g} ms",
            without,
            alone,
            wrong=False,
        )
