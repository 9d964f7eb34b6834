"""The structure of a law: which terms, frictions, gains and zeros of angles it has, how it is seen,
and its gauge.

L → c L + const moves nothing, so one coefficient has to be given: the mean of M₁₁ over the data is
1. (To set the coefficient of ½v₁² alone would admit M₁₁ = 1 − 1.3 cos q + 0.3 cos 2q, which is
nearly zero where the data are, and fits any record with nothing.) In a law whose M₁₁ is constant
that is ½ of v₁². Coordinates that no term or friction couples with q₁ have a scale of their own, by
which their part of L may be multiplied: there the mean of the first one's inertia is 1 too. So have
coordinates that others drive, which do not act back on these (`leaders`).

Where runs differ in parameters of the system, a row has one more entry, the whole powers of these
that its coefficient is multiplied by; a row without it does not depend on them. Within a run
L → c(μ) L moves nothing either: the first term has the power that is given to it, and what is told
of the others is their ratio to it.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from gfnn_jax.families.friction import UNIFORM, Friction
from gfnn_jax.families.lagrangian import Powers, Terms, coordinates_in, functions_of
from gfnn_jax.flows.motion import Form

Row = tuple[Any, ...]  # (k, n, m, φ), then a shape where it has one, and powers of parameters
Loss = tuple[Any, ...]  # (c, kind, ε), or (c, kind, ε, powers of parameters)
Key = tuple[Any, ...]
SINE = -np.pi / 2  # phase


def with_powers(row: Row | Loss, powers: tuple[int, ...]) -> Row | Loss:
    """A row whose coefficient is multiplied by these powers of the parameters."""
    plain = row[:-1] if isinstance(row[-1], tuple) else row
    return (*plain, powers) if any(powers) else plain


def powers_of(row: Row | Loss, count: int) -> tuple[int, ...]:
    """The powers of ``count`` parameters that a row's coefficient is multiplied by."""
    return row[-1] if isinstance(row[-1], tuple) else (0,) * count


def is_constant(row: Row) -> bool:
    """Return whether a term depends on no coordinate, but on velocities at most."""
    return not any(coordinates_in(row))


def cosine_of(row: Row) -> Row | None:
    """cos q_i where a term is sin q_i of one coordinate, else None."""
    speeds, powers, wave, phase, *more = row
    alone = sum(wave) == sum(map(abs, wave)) == 1 and not (any(speeds) or any(powers))
    return (*row[:3], 0.0, *more) if alone and phase == SINE else None


AT_BOUND = "is held at its bound: the record alone would put its coefficient beyond"
AS_EQUAL = "is hardly determined: it has the coefficient of equal masses"


class Held(NamedTuple):
    """A term whose coefficient is no free one: ``value``, or that many times the one of another
    term. why: it is not as told: AT_BOUND or AS_EQUAL."""

    row: Row
    value: float
    of: Row | None = None
    why: str = ""


@dataclasses.dataclass(frozen=True)
class Structure:
    """Terms of L (the first is ½v₁²·2), friction, the coordinates whose zero is unknown, the number
    of inputs, each with a gain for each coordinate, the names of the sensors' parameters with where
    they start, the terms whose coefficients are ``held``, and the coordinates that drive others,
    which do not act back on them (``leaders``)."""

    dim: int
    terms: tuple[Row, ...]
    friction: tuple[Loss, ...] = ()
    zeros: tuple[int, ...] = ()
    num_inputs: int = 0
    sensors: tuple[tuple[str, float], ...] = ()
    held: tuple[Held, ...] = ()
    leaders: tuple[int, ...] = ()

    def keys(self) -> list[Key]:
        """A name of each free coefficient, in their order."""
        gains = [("gain", i, j) for i in range(self.dim) for j in range(self.num_inputs)]
        return [
            *(("term", self.terms[k]) for k in self._free),
            *(("loss", row) for row in self.friction),
            *gains,
            *(("zero", i) for i in self.zeros),
            *(("sensor", name) for name, _ in self.sensors),
        ]

    def start(self, known: Mapping[Key, float]) -> np.ndarray:
        """The coefficients that are known, for sensors those they start from, 0 for the others."""
        known = {**{("sensor", name): value for name, value in self.sensors}, **known}
        return np.array([known.get(key, 0.0) for key in self.keys()])

    def with_a_zero(self, angles: Sequence[int]) -> tuple[int, ...]:
        """The angles that have modes in its terms, and no powers or shapes: their zero can be
        fitted."""
        moved = [i for i in angles if any(row[2][i] for row in self.terms)]
        return tuple(i for i in moved if not self.has_powers(i))

    def has_powers(self, i: int) -> bool:
        """Return whether a term has a power of coordinate i, or a shape of it."""
        return any(coordinates_in(row, phased=False)[i] for row in self.terms)

    @functools.cached_property
    def uncoupled(self) -> tuple[tuple[int, ...], ...]:
        """The coordinates in parts that no term or friction couples, that of the first one first; a
        part that nothing sets in motion belongs to the first. One part where systems differ."""
        rows = [self._acted_on(row) for row in self.terms]
        rows += [list(map(bool, row[0])) for row in self.friction]
        part = list(range(self.dim)) if self.powers is None else [0] * self.dim
        for row in rows:
            joined = {part[i] for i, acts in enumerate(row) if acts}
            part = [min(joined) if i in joined else i for i in part]
        moved = {part[i] for row in self.terms for i in range(self.dim) if self._is_inertia(row, i)}
        part = [i if i in moved else 0 for i in part]
        return tuple(tuple(k for k, own in enumerate(part) if own == i) for i in sorted(set(part)))

    @functools.cached_property
    def given(self) -> tuple[int, ...]:
        """Places of the terms whose coefficients the gauge gives: the first one, and of each other
        uncoupled part v² of its first coordinate, constant where there is such a term."""
        return (0, *map(self._inertia_of, self.uncoupled[1:]))

    def _inertia_of(self, part: tuple[int, ...]) -> int:
        own = [k for k, row in enumerate(self.terms) if any(self._is_inertia(row, i) for i in part)]

        def rank(k: int) -> tuple[int, bool]:
            return self.terms[k][0].index(2), not is_constant(self.terms[k])

        return min(own, key=rank)

    def _acted_on(self, row: Row) -> list[bool]:
        """Return whether a term acts on each coordinate."""
        touched = [bool(k or f) for k, f in zip(row[0], coordinates_in(row), strict=True)]
        if any(own and i not in self.leaders for i, own in enumerate(touched)):
            return [own and i not in self.leaders for i, own in enumerate(touched)]
        return touched

    def _is_inertia(self, row: Row, i: int) -> bool:
        """Return whether a term is a part of the inertia of coordinate i."""
        return row[0][i] == 2 and self._acted_on(row)[i]

    def _moves(self, key: Key, part: tuple[int, ...]) -> bool:
        """Return whether a coefficient is of a term, friction or gain of these coordinates."""
        if key[0] == "gain":
            return key[1] in part
        if key[0] not in ("term", "loss"):
            return False
        moved = self._acted_on(key[1]) if key[0] == "term" else key[1][0]
        return any(moved[i] for i in part)

    def may_have(self, key: Key) -> bool:
        """Return whether a coefficient may belong to it: no sine of an angle beside its cosine and
        its zero, and no friction of the relative speed of coordinates that drive and are driven."""
        if key[0] == "term" and (cosine := cosine_of(key[1])) is not None:
            return cosine not in self.terms or not any(key[1][2][i] for i in self.zeros)
        if key[0] != "loss" or not self.leaders:
            return True
        moved = np.flatnonzero(key[1][0])
        return len({i in self.leaders for i in moved.tolist()}) == 1

    @property
    def _free(self) -> list[int]:
        fixed = {*self.given, *(self.terms.index(one.row) for one in self.held)}
        return [k for k in range(len(self.terms)) if k not in fixed]

    @property
    def powers(self) -> Powers | None:
        """The powers of parameters in each coefficient (θ, ρ, G); None where there are none."""
        rows = (*self.terms, *self.friction)
        count = max((len(row[-1]) for row in rows if isinstance(row[-1], tuple)), default=0)
        if not count:
            return None
        gains = ((0,) * count,) * (self.dim * self.num_inputs)
        return (*(powers_of(row, count) for row in rows), *gains)

    @property
    def most_functions(self) -> int:
        """The largest number of functions of the parameters that one term or friction has."""
        plain = [with_powers(row, ()) for row in (*self.terms, *self.friction)]
        return max(map(plain.count, plain))

    def form(self, q: np.ndarray, args: np.ndarray | None = None) -> Form:
        """The law with free coefficients, in the gauge of the positions q (n, d), where systems
        have the parameters args (n, k)."""
        terms, powers = Terms.of(self.terms, self.dim, self.leaders), self.powers
        values = terms.potentials(q, order=0).value
        if powers is not None:
            values = values * functions_of(powers[: terms.count], args)
        inertia, fixed = terms.quadratic()[0], np.zeros(terms.count)
        basis = np.eye(terms.count)[:, self._free]
        for row, value, of, _ in sorted(self.held, key=lambda one: one.of is not None):
            k = self.terms.index(row)
            if k in self.given:
                continue
            if of is None:
                fixed[k] = value
            else:
                source = self.terms.index(of)
                fixed[k], basis[k] = value * fixed[source], value * basis[source]
        for k in self.given:
            i = self.terms[k][0].index(2)
            own = terms.acting(inertia, 2)[:, i, i] * values.mean(axis=0)
            fixed[k] = (1 - own @ fixed) / own[k]
            basis[k] = -(own @ basis) / own[k]
        friction = Friction.of(self.friction, self.dim)
        return Form(terms, fixed, basis, friction, self.num_inputs, powers)

    def in_gauge(self, known: Mapping[Key, float], q: np.ndarray) -> Mapping[Key, float]:
        """Coefficients that are known of a law which may couple more, with each uncoupled part in
        the gauge of the positions q (n, d)."""
        for part, place in zip(self.uncoupled[1:], self.given[1:], strict=True):
            i, own = self.terms[place][0].index(2), {}
            for key, value in known.items():
                if key[0] == "term" and self._is_inertia(key[1], i):
                    own[key[1]] = value
            if self.terms[place] not in own:
                continue
            terms = Terms.of(tuple(own), self.dim)
            means = terms.potentials(q, order=0).value.mean(axis=0)
            mean = np.sum(terms.quadratic()[0][:, i, i] * means * list(own.values()))
            by = 1 / mean if mean > 0 else 1.0
            known = {k: by * c if self._moves(k, part) else c for k, c in known.items()}
        return known

    def with_sines_as_zeros(
        self, known: Mapping[Key, float], zeros: Sequence[int]
    ) -> tuple[Structure, dict[Key, float]]:
        """The structure with these zeros of angles in place of sines beside cosines of one angle
        alone, and what is known: a cos q + b sin q = ±√(a² + b²) cos(q − zero)."""
        known, gone = dict(known), set()
        for row in self.terms:
            cosine = cosine_of(row)
            if cosine not in self.terms or not (moved := [i for i in zeros if row[2][i]]):
                continue
            keys = ("term", cosine), ("term", row)
            a, b = (known.get(key, 0.0) for key in keys)
            turned = np.arctan(b / a) if a else np.pi / 2
            known |= {keys[0]: float(np.copysign(np.hypot(a, b), a)), ("zero", moved[0]): turned}
            gone.add(keys[1])
        return self.without(gone).plus([("zero", i) for i in zeros]), known

    def without(self, keys: set[Key]) -> Structure:
        return dataclasses.replace(
            self,
            terms=tuple(
                r for k, r in enumerate(self.terms) if k in self.given or ("term", r) not in keys
            ),
            friction=tuple(r for r in self.friction if ("loss", r) not in keys),
            zeros=tuple(i for i in self.zeros if ("zero", i) not in keys),
        )

    def plus(self, keys: list[Key]) -> Structure:
        """The structure with these terms, frictions and zeros; uniform friction stays last."""
        new = {kind: tuple(k[1] for k in keys if k[0] == kind) for kind in ("term", "loss", "zero")}
        return dataclasses.replace(
            self,
            terms=self.terms + tuple(r for r in new["term"] if r not in self.terms),
            friction=tuple(
                sorted(
                    dict.fromkeys((*self.friction, *new["loss"])), key=lambda row: row[1] == UNIFORM
                )
            ),
            zeros=tuple(sorted({*self.zeros, *new["zero"]})),
        )
