"""Structures of many degrees of freedom, as a user names them: equal sites in a ring or a chain, or
bodies.

A structure tells which libraries of terms are tried, and by what the domain of the data is known.
"""

import dataclasses
import re
from collections.abc import Iterator, Sequence
from math import comb

import numpy as np

from gfnn_jax.coordinates import CARTESIAN, Coordinates
from gfnn_jax.dataset.structure_names import EXPECTED
from gfnn_jax.errors import FitError
from gfnn_jax.families.sums import Part, Sums, Windows, body_terms, periodic_site_terms, site_terms
from gfnn_jax.families.terms import Terms
from gfnn_jax.maps.domain import Ranges, ranges_of
from gfnn_jax.phase_space import sizes

_ENDS = {"ring": ("ring",), "chain": ("free", "fixed")}


class Options:
    """Libraries of structures, by rising size (benchmarks/many.py)."""

    # (reach, degree, whether functions are tried too) of the libraries, by rising size.
    libraries: tuple[tuple[int, int, bool], ...] = (
        *((1, 2, False), (1, 4, False), (1, 2, True)),
        *((2, 2, False), (2, 4, False), (1, 6, False), (1, 8, False)),
    )
    # (degree, whether products of p, of modes of q and of modes of the difference are tried) of
    # the libraries where q is an angle, by rising size.
    fourier = ((2, False), (4, False), (2, True), (6, False), (3, True), (4, True))
    # Powers of the distances of bodies, by rising size.
    powers: tuple[tuple[int, ...], ...] = ((-3, -2, -1, 1, 2), (-6, -5, -4, -3, -2, -1, 1, 2, 3, 4))
    # A library of sites is fitted to so many pairs, or to those that hold so many numbers; one of
    # bodies to so many pairs, of which the quiet ones come first.
    fewest_pairs: int = 4
    fewest_numbers: int = 4_000
    fewest_states: int = 200
    most_products: int = 350  # of a library: those of higher degree are not tried of several fields
    fewest_sites: int = 5  # a window of the longest reach meets itself in a smaller ring


_FUNCTIONS = (
    *("cos(q1)", "sin(q1)", "exp(q1)", "exp(-q1)"),
    *("cos(q2 - q1)", "sin(q2 - q1)", "exp(q2 - q1)", "exp(q1 - q2)"),
)


@dataclasses.dataclass(frozen=True)
class Sites:
    """Equal sites in a ring, or in a chain whose ends are free or held. kind: "ring" or "chain".
    angles: those of a site, "" or "q" or "qp". fields: q of a site, which stand together."""

    kind: str
    angles: str = ""
    fields: int = 1

    def fewest(self, width: int) -> int:
        """Pairs of states (2d,) that a library is fitted to, at least."""
        return max(1, min(Options.fewest_pairs, Options.fewest_numbers // width))

    def libraries(self, dim: int, given: Sequence[str] = ()) -> Iterator[Sums]:
        """Sums by rising size. given: a user's own terms, as text in a site's q1, p1 and the next
        sites' q2, p2, …"""
        ends = _ENDS[self.kind]
        if self.angles:
            for degree, products in Options.fourier:
                yield from (periodic_site_terms(dim, e, degree, products=products) for e in ends)
            return
        if given:
            yield from (site_terms(dim, end, 0, 0, given, self.fields) for end in ends)
        for reach, degree, with_functions in Options.libraries:
            if comb((2 + reach) * self.fields + degree, degree) > Options.most_products:
                continue
            functions = (*given, *(self._functions() if with_functions else ()))
            yield from (site_terms(dim, end, reach, degree, functions, self.fields) for end in ends)

    def _functions(self) -> Iterator[str]:
        """The functions of every field."""
        for k in range(1, self.fields + 1):
            places = {"q1": f"q{k}", "q2": f"q{k + self.fields}"}
            yield from (re.sub("q[12]", lambda m: places[m[0]], text) for text in _FUNCTIONS)  # noqa: B023

    def sizes(self, z: np.ndarray) -> np.ndarray:
        """(2d,) sizes of the coordinates: of q and of p of all sites together, field by field."""
        both = z.reshape(len(z), 2, -1, self.fields)
        size = both.std(axis=(0, 2))
        size = np.where(size > 0, size, 1.0)
        return np.repeat(size[:, None], both.shape[2], axis=1).ravel()

    def domain(self, z: np.ndarray, uses_positions: bool = True) -> Ranges:
        """Domain of the states z (N, 2d): p and the differences of neighbours, and q unless only
        its differences are used."""
        dim = z.shape[1] // 2
        ends = "ring" if self.kind == "ring" else "free"
        own = tuple(x for x in ("q", "p") if x not in self.angles and (x == "p" or uses_positions))
        fields = range(1, self.fields + 1)
        alone = tuple(f"{x}{k}" for x in own for k in fields)
        bonds = () if self.angles else tuple(f"q{k + self.fields} - q{k}" for k in fields)
        parts = []
        for k, names in enumerate((alone, bonds)):
            each = tuple(map(tuple, np.eye(len(names), dtype=int).tolist()))
            terms = Terms((k + 1) * self.fields, names, each)
            parts += [Part(terms, Windows(ends, k, self.fields))] if names else []
        return ranges_of(Sums(dim, tuple(parts)), z)


@dataclasses.dataclass(frozen=True)
class Bodies:
    """Bodies in a space of one to three dimensions that attract or repel each other in pairs.

    species: a letter for each body, where those of a species are alike."""

    count: int
    space: int
    species: str = ""
    angles = ""

    def fewest(self, width: int) -> int:
        """Pairs that a library is fitted to, at least."""
        return Options.fewest_states

    def libraries(self, dim: int, given: Sequence[str] = ()) -> Iterator[Sums]:
        """Sums by rising size: of bodies that are all alike, then of bodies that are not; where
        species are known, of these."""
        for powers in Options.powers:
            if self.species:
                yield body_terms(self.count, self.space, powers, species=self.species)
                continue
            for alike in (True, False):
                yield body_terms(self.count, self.space, powers, alike=alike)

    def sizes(self, z: np.ndarray) -> np.ndarray:
        """(2d,) sizes of the coordinates."""
        return sizes(z)

    def domain(self, z: np.ndarray, uses_positions: bool = True) -> Ranges:
        """Domain of the states z (N, 2d): each body's |p|² and each pair's distance."""
        return ranges_of(body_terms(self.count, self.space, (1,), alike=False), z)


Structure = Sites | Bodies


def structure_of(
    text: str | None, dim: int, coordinates: Coordinates = CARTESIAN
) -> Structure | None:
    """The structure that this text names. Raises FitError where there is none, or it does not suit
    ``dim`` degrees of freedom, or the angles are not those of every site."""
    if text is None:
        return None
    known = _bodies(str(text))
    if known is not None:
        count, species = known
        if species and len(species) != count:
            raise FitError(
                f"expected a letter for each of {count} bodies, as bodies:{count}:"
                f"{('a' + 'b' * count)[:count]}; got {len(species)} in {text!r}"
            )
        if dim % count or not 1 <= dim // count <= 3:
            raise FitError(
                f"expected {count} bodies in 1 to 3 dimensions, which have {count}, {2 * count} or "
                f"{3 * count} degrees of freedom; got {dim}"
            )
        return Bodies(count, dim // count, species)
    kind, fields = str(text).partition(":")[0], fields_of(str(text))
    if fields == 0:
        raise FitError(f"expected {EXPECTED}, got {text!r}")
    if dim % fields:
        raise FitError(f"expected {fields} q of every site; got {dim} degrees of freedom")
    if dim // fields < Options.fewest_sites:
        raise FitError(f"expected {Options.fewest_sites} sites or more, got {dim // fields}")
    sides = {(): "", tuple(range(dim)): "q", tuple(range(2 * dim)): "qp"}
    if coordinates.angles not in sides:
        raise FitError(
            f"angles: expected none, all q of the sites (0 to {dim - 1}), or all q and p (0 to "
            f"{2 * dim - 1}), got {coordinates.angles}"
        )
    if coordinates.angles and fields > 1:
        raise FitError(f"expected no angles where a site has {fields} q: a single q may be one")
    return Sites(kind, sides[coordinates.angles], fields)


def fields_of(text: str) -> int:
    """The fields of a site of "ring", "chain:2" and the like; 0 of any other text."""
    found = re.fullmatch(r"(?:ring|chain)(?::([1-9][0-9]?))?", text)
    return int(found[1] or 1) if found is not None else 0


def _bodies(text: str) -> tuple[int, str] | None:
    """(number, species) of "bodies:N" or "bodies:N:SPECIES"; None of any other text."""
    found = re.fullmatch(r"bodies:([0-9]+)(?::([A-Za-z]+))?", text)
    if found is None or int(found[1]) < 2:
        return None
    return int(found[1]), found[2] or ""
