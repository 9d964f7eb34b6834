"""Terms of systems with angles: Fourier modes times powers of the other variables.

    cos(m·θ) Π_k x_k^a_k,      sin(m·θ) Π_k x_k^a_k

θ are the angles, x_k the other coordinates and a user's own terms. The modes m of an H seldom form
a box; those of two rods are m₁ + m₂ ∈ {0, ±1}. A basis therefore holds no list of terms, and names
the neighbours of those that are known to matter.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from itertools import combinations, product
from typing import NamedTuple

from gfnn_jax.families.expressions import Expression, call, coordinate, to_text
from gfnn_jax.families.terms import Terms

_ORDER, _DEGREE = 2, 2  # largest |m_i| of the box, and largest total degree in the others


class Mode(NamedTuple):
    """Term of a mode: m (angles,), sin or cos, and powers of the other variables.

    The first entry of m that is not 0 is positive.
    """

    wave: tuple[int, ...]
    sine: bool
    powers: tuple[int, ...]


@dataclasses.dataclass(frozen=True)
class Modes:
    """Basis over ``angles`` (indices of z) and ``others``, variables as text.

    The last ``num_given`` of the others are a user's own terms.
    """

    dim: int
    angles: tuple[int, ...]
    others: tuple[str, ...]
    num_given: int = 0

    def terms(self, modes: Sequence[Mode]) -> Terms:
        """Make the family of these modes, in their order."""
        waves = dict.fromkeys((m.wave, m.sine) for m in modes if any(m.wave))
        place = {wave: j for j, wave in enumerate(waves)}
        rows = []
        for mode in modes:
            row = [0] * len(waves)
            if any(mode.wave):
                row[place[mode.wave, mode.sine]] = 1
            rows.append((*row, *mode.powers))
        names = tuple(self._text(wave, sine) for wave, sine in waves)
        return Terms(self.dim, (*names, *self.others), tuple(rows))

    def box(self, order: int = _ORDER, degree: int = _DEGREE) -> list[Mode]:
        """List the modes of at most two angles with |m_i| ≤ order.

        They are multiplied by products of the other variables of total degree up to ``degree``; so
        are the user's terms.
        """
        count = len(self.angles)
        waves = {(0,) * count}
        for pair in combinations(range(count), min(2, count)):
            for m in product(range(-order, order + 1), repeat=len(pair)):
                wave = [0] * count
                for i, value in zip(pair, m, strict=True):
                    wave[i] = value
                waves.add(_directed(tuple(wave)))
        given = [tuple(int(j == k) for j in range(self.num_given)) for k in range(self.num_given)]
        plain = len(self.others) - self.num_given
        powers = [a for a in product(range(degree + 1), repeat=plain) if sum(a) <= degree]
        powers.sort(key=_size)
        return [
            *self._modes([(0,) * count], [(*a, *b) for b in given for a in powers]),
            *self._modes(sorted(waves, key=_size), [(*a, *(0,) * self.num_given) for a in powers]),
        ]

    def around(self, known: Iterable[Mode]) -> list[Mode]:
        """List candidates next to the modes that are known to matter.

        They are the sums and differences of the known m with the short ones among them, for every
        known product of powers; and the known m with these products times one more variable.
        """
        known = list(dict.fromkeys(known))
        waves = list(dict.fromkeys(m.wave for m in known))
        products = list(dict.fromkeys(m.powers for m in known))
        short = [w for w in waves if any(w) and max(map(abs, w)) <= _ORDER]
        sums = {
            _directed(tuple(a + s * b for a, b in zip(w, g, strict=True)))
            for w in waves
            for g in short
            for s in (1, -1)
        }
        higher = {
            (*a[:k], a[k] + 1, *a[k + 1 :]) for a in products for k in range(len(self.others))
        }
        found = [
            *self._modes(sorted({*waves, *sums}, key=_size), products),
            *self._modes(waves, sorted(higher)),
        ]
        return [m for m in dict.fromkeys(found) if m not in set(known)]

    @staticmethod
    def _modes(waves, products) -> list[Mode]:
        return [
            Mode(wave, sine, powers)
            for powers in products
            for wave in waves
            for sine in ((False, True) if any(wave) else (False,))
            if any(wave) or any(powers)
        ]

    def _text(self, wave: tuple[int, ...], sine: bool) -> str:
        angle: Expression | None = None
        for i, m in zip(self.angles, wave, strict=True):
            if m:
                part = coordinate(i) * m
                angle = part if angle is None else angle + part
        assert angle is not None
        return to_text(call("sin" if sine else "cos", angle), self.dim)


def _directed(wave: tuple[int, ...]) -> tuple[int, ...]:
    """Return m or −m, which are the same mode, with its first entry that is not 0 positive."""
    first = next((m for m in wave if m), 0)
    return tuple(-m for m in wave) if first < 0 else wave


def _size(wave: tuple[int, ...]):
    return sum(map(abs, wave)), wave
