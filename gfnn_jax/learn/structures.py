"""What a user says of many degrees of freedom: equal sites in a ring or a chain, or bodies.

A structure tells which libraries of terms are tried, and by what the domain of the data is known.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np

from gfnn_jax.errors import FitError
from gfnn_jax.families.sums import Part, Sums, Windows, body_terms, site_terms
from gfnn_jax.families.terms import Terms
from gfnn_jax.maps.domain import Ranges, ranges_of
from gfnn_jax.phase_space import sizes

NAMES = ("ring", "chain", "bodies:N")
_ENDS = {"ring": ("ring",), "chain": ("free", "fixed")}
# (reach, degree, whether functions are tried too) of the libraries, by rising size.
_LIBRARIES = (
    (1, 2, False), (1, 4, False), (1, 2, True), (2, 2, False), (2, 4, False), (1, 6, False),
    (1, 8, False),
)  # fmt: skip
_FUNCTIONS = (
    "cos(q1)", "sin(q1)", "exp(q1)", "exp(-q1)",
    "cos(q2 - q1)", "sin(q2 - q1)", "exp(q2 - q1)", "exp(q1 - q2)",
)  # fmt: skip
# Powers of the distances of bodies, by rising size.
_POWERS = ((-3, -2, -1, 1, 2), (-6, -5, -4, -3, -2, -1, 1, 2, 3, 4))
# A library of sites is fitted to so many pairs, or to those that hold so many numbers; one of
# bodies to so many pairs, of which the quiet ones come first.
_FEWEST_PAIRS, _FEWEST_NUMBERS, _FEWEST_STATES = 4, 4_000, 200
_FEWEST_SITES = 5  # a window of the longest reach meets itself in a smaller ring


@dataclasses.dataclass(frozen=True)
class Sites:
    """Equal sites in a ring, or in a chain whose ends are free or held. kind: "ring" or "chain"."""

    kind: str

    def fewest(self, width: int) -> int:
        """Pairs of states (2d,) that a library is fitted to, at least."""
        return max(1, min(_FEWEST_PAIRS, _FEWEST_NUMBERS // width))

    def libraries(self, dim: int, given: Sequence[str] = ()) -> Iterator[Sums]:
        """Sums by rising size. given: a user's own terms, as text in a site's q1, p1 and the next
        sites' q2, p2, …"""
        ends = _ENDS[self.kind]
        if given:
            yield from (site_terms(dim, end, 0, 0, given) for end in ends)
        for reach, degree, with_functions in _LIBRARIES:
            functions = (*given, *(_FUNCTIONS if with_functions else ()))
            yield from (site_terms(dim, end, reach, degree, functions) for end in ends)

    def sizes(self, z: np.ndarray) -> np.ndarray:
        """(2d,) sizes of the coordinates: of q and of p of all sites together."""
        both = z.reshape(len(z), 2, -1)
        size = both.std(axis=(0, 2))
        return np.repeat(np.where(size > 0, size, 1.0), both.shape[2])

    def domain(self, z: np.ndarray, uses_positions: bool = True) -> Ranges:
        """Where the states z (N, 2d) were: p and the differences of neighbours, and q unless only
        its differences are used."""
        dim = z.shape[1] // 2
        ends = "ring" if self.kind == "ring" else "free"
        own = ("q1", "p1") if uses_positions else ("p1",)
        seen = tuple(
            Part(Terms(k + 1, names, _units(len(names))), Windows(ends, k))
            for k, names in enumerate((own, ("q2 - q1",)))
        )
        return ranges_of(Sums(dim, seen), z)


@dataclasses.dataclass(frozen=True)
class Bodies:
    """Bodies in a space of one to three dimensions that attract or repel each other in pairs."""

    count: int
    space: int

    def fewest(self, width: int) -> int:
        """Pairs that a library is fitted to, at least."""
        return _FEWEST_STATES

    def libraries(self, dim: int, given: Sequence[str] = ()) -> Iterator[Sums]:
        """Sums by rising size: of bodies that are all alike, then of bodies that are not."""
        for powers in _POWERS:
            for alike in (True, False):
                yield body_terms(self.count, self.space, powers, alike=alike)

    def sizes(self, z: np.ndarray) -> np.ndarray:
        """(2d,) sizes of the coordinates."""
        return sizes(z)

    def domain(self, z: np.ndarray, uses_positions: bool = True) -> Ranges:
        """Where the states z (N, 2d) were: each body's |p|² and each pair's distance."""
        return ranges_of(body_terms(self.count, self.space, (1,), alike=False), z)


def _units(count: int) -> tuple[tuple[int, ...], ...]:
    return tuple(tuple(int(k == j) for k in range(count)) for j in range(count))


Structure = Sites | Bodies


def structure_of(text: str | None, dim: int) -> Structure | None:
    """The structure that this text names. Raises FitError where there is none, or it does not suit
    ``dim`` degrees of freedom."""
    if text is None:
        return None
    kind, _, number = str(text).partition(":")
    if kind == "bodies" and number.isdecimal() and int(number) > 1:
        count = int(number)
        if dim % count or not 1 <= dim // count <= 3:
            raise FitError(
                f"expected {count} bodies in 1 to 3 dimensions, which have {count}, {2 * count} or "
                f"{3 * count} degrees of freedom; got {dim}"
            )
        return Bodies(count, dim // count)
    if text not in _ENDS:
        raise FitError(f"expected a structure among {', '.join(NAMES)}; got {text!r}")
    if dim < _FEWEST_SITES:
        raise FitError(f"expected a {text} of at least {_FEWEST_SITES} sites, got {dim}")
    return Sites(text)
