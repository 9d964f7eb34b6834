"""Terms of systems with angles: Fourier modes times powers of the other coordinates.

    cos(m·θ) Π_k x_k^a_k,      sin(m·θ) Π_k x_k^a_k

θ are the angles, x_k the other coordinates.
"""

from __future__ import annotations

from itertools import combinations, product

from gfnn_jax.families.expressions import call, coordinate, to_text
from gfnn_jax.families.terms import Terms


def modes(
    dim: int, angles: tuple[int, ...], others: tuple[str, ...], order: int, degree: int
) -> Terms:
    """Make the modes of at most two angles with |m_i| up to ``order``, of m and −m one, times
    products of the others of total degree up to ``degree``.

    angles: indices of z; others: names.
    """
    count = len(angles)
    waves = set()
    for places in combinations(range(count), min(2, count)):
        for m in product(range(-order, order + 1), repeat=len(places)):
            wave = dict(zip(places, m, strict=True))
            waves.add(tuple(wave.get(i, 0) for i in range(count)))
    positive = sorted((wave for wave in waves if wave > (0,) * count), key=_size)
    names = [name for wave in positive for name in _names(dim, angles, wave)]
    powers = [a for a in product(range(degree + 1), repeat=len(others)) if sum(a) <= degree]
    units = [tuple(int(j == k) for j in range(len(names))) for k in range(-1, len(names))]
    rows = [(*unit, *a) for a in sorted(powers, key=_size) for unit in units]
    return Terms(dim, (*names, *others), tuple(row for row in rows if any(row)))


def _names(dim: int, angles: tuple[int, ...], wave: tuple[int, ...]) -> tuple[str, str]:
    """cos and sin of m·θ as text."""
    first, *rest = (coordinate(i) * m for i, m in zip(angles, wave, strict=True) if m)
    angle = sum(rest, start=first)
    return to_text(call("cos", angle), dim), to_text(call("sin", angle), dim)


def _size(numbers: tuple[int, ...]) -> tuple[int, tuple[int, ...]]:
    return sum(map(abs, numbers)), numbers
