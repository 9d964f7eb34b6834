"""Sums of one function over neighbourhoods: sites of a ring or a chain, bodies, pairs of bodies.

    f(c, w) = Σ_parts Σ_neighbourhoods Σ_j c_j φ_j(w in the neighbourhood)

All neighbourhoods of a part share its coefficients, so that one state of a ring of 1,000 sites
gives 1,000 rows of data for a function of a few variables. The cost of a gradient, and of a product
with the Hessian, grows linearly with the number of neighbourhoods; no matrix is dense.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Sequence
from itertools import combinations, product
from typing import Any

import numpy as np

from gfnn_jax.arrays import as_row, matmul, namespace, pytree
from gfnn_jax.families.expressions import depends_on, parse, window_terms
from gfnn_jax.families.family import OfCoefficients
from gfnn_jax.families.site_sums import site_sum
from gfnn_jax.families.terms import Terms, exponents, given_terms, joined
from gfnn_jax.families.text import added
from gfnn_jax.phase_space import split

_LONGEST = 4  # sites of a window that a user's own terms may name
_DENSE = 32  # 2d up to which matrices (2d, 2d) are cheaper than products with them


@dataclasses.dataclass(frozen=True)
class Windows:
    """Windows of ``reach`` + 1 successive sites, one for each place where they fit.

    ends: "ring", where the last site's neighbour is the first; "free"; or "fixed", between two
    sites that stay at q = p = 0. fields: number of q of a site, which stand together; as many p.
    """

    ends: str
    reach: int
    fields: int = 1

    prefix = "Σ_i "  # of a formula

    def gather(self, w):
        """Gather w (..., 2d) into states (..., windows, 2·(reach + 1)·fields) of the windows."""
        xp = namespace(w)
        columns = [c for x in split(w) for c in self._shifted(x)]
        return xp.moveaxis(xp.stack(columns), 0, -1)

    def scatter(self, g):
        """Transpose of ``gather``: (..., windows, 2·(reach + 1)·fields) -> (..., 2d)."""
        xp, half = namespace(g), g.shape[-1] // 2
        sides = (g[..., :half], g[..., half:])
        return xp.concatenate([self._summed(side) for side in sides], axis=-1)

    def _shifted(self, x) -> list:
        xp = namespace(x)
        x = x.reshape(*x.shape[:-1], -1, self.fields)
        if self._held:
            wall = xp.zeros_like(x[..., :1, :])
            x = xp.concatenate([wall, x, wall], axis=-2)
        last = x.shape[-2] - self.reach
        rows: Any = range(self.reach + 1)
        if self.ends == "ring":
            rows = [xp.roll(x, -j, axis=-2) for j in rows]
        else:
            rows = [x[..., j : j + last, :] for j in rows]
        return [row[..., k] for row in rows for k in range(self.fields)]

    def _summed(self, g):
        xp, lanes = namespace(g), g.shape[:-2]
        g = g.reshape(*g.shape[:-1], self.reach + 1, self.fields)
        rows = [g[..., j, :] for j in range(self.reach + 1)]
        total: Any
        if self.ends == "ring":
            total = sum(xp.roll(row, j, axis=-2) for j, row in enumerate(rows))
        else:
            nothing = [(0, 0)] * len(lanes)
            places = [[*nothing, (j, self.reach - j), (0, 0)] for j in range(self.reach + 1)]
            total = sum(xp.pad(row, place) for row, place in zip(rows, places, strict=True))
            total = total[..., 1:-1, :] if self._held else total
        return total.reshape(*lanes, -1)

    @property
    def _held(self) -> bool:
        return self.ends == "fixed" and self.reach > 0

    def count(self, dim: int) -> int:
        """Number of windows among the sites of ``dim`` degrees of freedom."""
        sites = dim // self.fields
        return sites if self.ends == "ring" else sites - self.reach + 2 * self._held

    def named(self, text: str) -> str:
        """Rewrite a term of the window's q1, q2, … for a general site: q_i, q_{i+1}, …

        With several fields the coordinates are q1_i, q2_i, q1_{i+1}, …
        """

        def of_site(found) -> str:
            ahead, field = divmod(int(found[2]) - 1, self.fields)
            site = f"{{i+{ahead}}}" if ahead else "i"
            return f"{found[1]}{field + 1 if self.fields > 1 else ''}_{site}"

        return re.sub(r"\b([qp])([0-9]+)", of_site, text)

    def as_code(self, text: str, dim: int) -> str:
        """Sum over all windows of a text in the window's q1, p1, q2, …, as `parse` reads it."""
        return site_sum(text, dim, self.ends, self.reach, self.fields)


@dataclasses.dataclass(frozen=True)
class Groups:
    """Groups of one or two bodies in a space of ``space`` dimensions, q body by body.

    members: indices of the bodies of each group. size: number of all bodies. species: a letter for
    each body of a group, where the groups are those of some species only.
    """

    members: tuple[tuple[int, ...], ...]
    size: int
    space: int
    species: str = ""

    prefix = ""

    def gather(self, w):
        """Gather w (..., 2d) into states (..., groups, 2k) of the groups, body by body."""
        places = np.array(self.members)
        sides = []
        for x in split(w):
            bodies = x.reshape(*x.shape[:-1], self.size, self.space)[..., places, :]
            sides.append(bodies.reshape(*x.shape[:-1], len(places), -1))
        return namespace(w).concatenate(sides, axis=-1)

    def scatter(self, g):
        """Transpose of ``gather``: (..., groups, 2k) -> (..., 2d)."""
        count, lanes = len(self.members[0]), g.shape[:-2]
        sides = g.reshape(*lanes, len(self.members), 2, count, self.space)
        total: Any = 0.0
        for m in range(count):
            chosen = np.eye(self.size, dtype=g.dtype)[:, [group[m] for group in self.members]]
            own = namespace(g).moveaxis(sides[..., m, :], -2, -3)  # (..., 2, groups, space)
            total = total + matmul(chosen, own)
        return total.reshape(*lanes, -1)

    def count(self, dim: int) -> int:
        """Number of groups."""
        return len(self.members)

    def named(self, text: str) -> str:
        """Rewrite a term of a group's q1, q2, … in positions and momenta of bodies."""
        one = len(self.members) == 1
        bodies = [str(b + 1) for b in self.members[0]] if one else ["i", "j"]
        pair = f"|q_{bodies[0]} - q_{bodies[-1]}|"
        for written, short in (
            (distance(self.space), pair),
            (f"({momentum_squared(self.space)})", f"|p_{bodies[0]}|²"),
            (momentum_squared(self.space), f"|p_{bodies[0]}|²"),
        ):
            text = text.replace(written, short)
        text = re.sub(r"\(1/(\|[^|]*\|)\)", r"1/\1", text)
        return text if one else f"{self._every} {text}"

    def as_code(self, text: str, dim: int) -> str:
        """Sum over all groups of a text in a group's q1, p1, q2, …, written out in q1..qd, p1..pd,
        as `parse` reads it."""

        def of_bodies(group: tuple[int, ...]) -> str:
            def name(found) -> str:
                member, axis = divmod(int(found[2]) - 1, self.space)
                return f"{found[1]}{group[member] * self.space + axis + 1}"

            return re.sub(r"\b([qp])([0-9]+)\b", name, text)

        return added(map(of_bodies, self.members))

    @property
    def _every(self) -> str:
        """Symbol of the sum over all groups in a formula."""
        pairs = len(self.members[0]) == 2
        if not self.species:
            return "Σ_{i<j}" if pairs else "Σ_i"
        first, last = self.species[0], self.species[-1]
        if not pairs:
            return f"Σ_{{i∈{first}}}"
        return f"Σ_{{i<j∈{first}}}" if first == last else f"Σ_{{i∈{first},j∈{last}}}"


def momentum_squared(space: int) -> str:
    """Write |p|² of a body as text."""
    return " + ".join(f"p{k}**2" for k in range(1, space + 1))


def distance(space: int) -> str:
    """Write |q − q'| of two bodies as text."""
    squares = (f"(q{k} - q{k + space})**2" for k in range(1, space + 1))
    return f"sqrt({' + '.join(squares)})"


@dataclasses.dataclass(frozen=True)
class Part:
    """Sum of ``terms`` of a neighbourhood's own state over all neighbourhoods of one kind."""

    terms: Terms
    over: Any


@pytree("dim", "parts", eq=True)
class Sums(OfCoefficients):
    """Family that is the sum of its parts. params: coefficients (N,) of all parts in order."""

    dim: int
    parts: tuple[Part, ...]

    name = "sums"

    @property
    def num_parameters(self) -> int:
        return sum(part.terms.num_parameters for part in self.parts)

    @property
    def prefix(self) -> str:
        """Text before the formula, a sum sign where one is needed."""
        return self.parts[0].over.prefix

    @property
    def matrix_free(self) -> bool:
        """True where solvers shall use products with the Hessian instead of the Hessian."""
        return 2 * self.dim > _DENSE

    @property
    def term_names(self) -> tuple[str, ...]:
        """Text of each term in the formula of a general neighbourhood."""
        return tuple(part.over.named(n) for part in self.parts for n in part.terms.term_names)

    def as_code(self, texts: Sequence[str]) -> str:
        """The sum as text that `parse` reads, of a text for each part, in the q1, p1, q2, … of a
        neighbourhood."""
        return added(p.over.as_code(t, self.dim) for p, t in zip(self.parts, texts, strict=True))

    @property
    def operations(self) -> tuple[int, int]:
        """Floating-point operations of a gradient, and of a gradient with its Hessian."""
        counted = [(p.over.count(self.dim), p.terms.operations) for p in self.parts]
        gradient, with_hessian = (sum(n * own[k] for n, own in counted) for k in (0, 1))
        return gradient, with_hessian

    def take(self, rows: Sequence[int]) -> Sums:
        """Make the family of these terms alone."""
        parts, first = [], 0
        for part in self.parts:
            last = first + part.terms.num_parameters
            own = [row - first for row in rows if first <= row < last]
            if own:
                parts.append(Part(part.terms.take(own), part.over))
            first = last
        return Sums(self.dim, tuple(parts))

    def value(self, params, w, args=None):
        """Value of f, shape (...): params (N,), w (..., 2d)."""
        return sum(
            namespace(w).sum(part.terms.value(own, part.over.gather(w), args), axis=-1)
            for part, own in self._with_params(params)
        )

    def gradient(self, params, w, args=None):
        """Gradient ∂f/∂w (..., 2d)."""
        return sum(
            part.over.scatter(part.terms.gradient(own, part.over.gather(w), args))
            for part, own in self._with_params(params)
        )

    def curvatures(self, params, w, args=None) -> list:
        """Hessians (..., neighbourhoods, k, k) of the terms of each part, for `hessian_product`."""
        return [
            part.terms.gradient_and_hessian(own, part.over.gather(w), args)[1]
            for part, own in self._with_params(params)
        ]

    def hessian_product(self, curvatures, v):
        """Product ∂²f/∂w² v (..., 2d), from the curvatures at w (..., 2d).

        v may have further leading axes.
        """
        xp = namespace(v)
        rows = [part.over.gather(v)[..., None, :] for part in self.parts]
        return sum(
            part.over.scatter(xp.sum(as_row(bend, row) * row, axis=-1))
            for part, bend, row in zip(self.parts, curvatures, rows, strict=True)
        )

    def gradient_and_hessian(self, params, w, args=None):
        """Gradient ∂f/∂w (..., 2d) and Hessian ∂²f/∂w² (..., 2d, 2d), a product per column."""
        xp, width = namespace(w), w.shape[-1]
        units = np.eye(width, dtype=w.dtype).reshape(width, *(1,) * (w.ndim - 1), width)
        columns = self.hessian_product(
            self.curvatures(params, w, args), xp.broadcast_to(units, (width, *w.shape))
        )
        return self.gradient(params, w, args), xp.moveaxis(columns, 0, -1)

    def term_gradients(self, w, args=None):
        """Gradients of all terms at w (..., 2d): (..., 2d, N). NumPy."""
        found = []
        for part in self.parts:
            local = part.terms.term_gradients(part.over.gather(w), args)
            found.append(part.over.scatter(np.moveaxis(local, -1, 0)))
        return np.moveaxis(np.concatenate(found), 0, -1)

    def _with_params(self, params):
        first = 0
        for part in self.parts:
            last = first + part.terms.num_parameters
            yield part, params[first:last]
            first = last


def matrix_free(family) -> bool:
    """Return whether solvers shall use no (2d, 2d) matrices of this family."""
    return bool(getattr(family, "matrix_free", False))


def site_terms(
    dim: int, ends: str, reach: int, degree: int, functions: Sequence[str] = (), fields: int = 1
) -> Sums:
    """Make terms of equal sites: products of total degree 1 to ``degree``, and ``functions``.

    The products are of a site's q and p and the differences of its q to those of the next sites up
    to ``reach``. functions: text in a site's q1, p1 and the next sites' q2, p2, … to q4, p4; with
    two fields q1, q2 are the site's, q3, q4 the next one's. Powers of one variable come first, so
    that a fit keeps them among combinations that are equal when summed. Each term goes to the
    shortest window that holds it. Raises InputError for a function that is not understood.
    """
    own = range(1, fields + 1)
    ahead = (f"q{j * fields + k} - q{k}" for j in range(1, reach + 1) for k in own)
    variables = (*(f"q{k}" for k in own), *(f"p{k}" for k in own), *ahead)
    rows = exponents(len(variables), degree)
    rows.sort(key=lambda row: sum(a > 0 for a in row) > 1)

    def furthest(row: tuple[int, ...]) -> int:
        return max(max((k for k, a in enumerate(row) if a), default=0) // fields - 1, 0)

    functions = [term for text in functions for term in window_terms(text)]
    longest = _LONGEST * fields
    used = (depends_on(parse(text, longest)) for text in functions)
    reaches = [max((i % longest // fields for i in own), default=0) for own in used]
    parts = []
    for near in range(max([reach, *reaches]) + 1):
        width = (near + 2) * fields
        mine = [row[:width] for row in rows if furthest(row) == near]
        terms = Terms((near + 1) * fields, variables[:width], tuple(mine))
        given = [t for t, r in zip(functions, reaches, strict=True) if r == near]
        if given:
            terms = joined(given_terms((near + 1) * fields, given), terms)
        if terms.powers:
            parts.append(Part(terms, Windows(ends, near, fields)))
    return Sums(dim, tuple(parts))


def periodic_site_terms(dim: int, ends: str, degree: int, *, products: bool) -> Sums:
    """Make terms of sites with angles: powers of p_i, harmonics of q_i and of q_{i+1} − q_i.

    Each goes up to ``degree``. With ``products`` their products up to this total degree are added.
    """
    own, bond = _harmonics("q1", degree), _harmonics("q2 - q1", degree)
    rows: tuple[list, list] = ([], [])  # of one site, of two
    for a, (i, k), (j, m) in product(range(degree + 1), _numbered(degree), _numbered(degree)):
        one = products or (a > 0) + (k > 0) + (m > 0) == 1
        if one and 0 < a + k + m <= degree:
            row = (a, *(int(n == i) for n in range(2 * degree)))
            rows[m > 0].append(row if m == 0 else (*row, *(int(n == j) for n in range(2 * degree))))
    count = range(sum(map(len, rows)))
    variables = ("p1", *own), ("p1", *own, *bond)
    parts = tuple(
        Part(Terms(k + 1, variables[k], tuple(rows[k])), Windows(ends, k)) for k in (0, 1)
    )
    return Sums(dim, parts).take(count)


def _harmonics(angle: str, degree: int) -> tuple[str, ...]:
    """Write cos and sin of the angle, of twice the angle, … up to ``degree``, as text."""
    multiples = [angle, *(f"{k}*({angle})" for k in range(2, degree + 1))]
    return tuple(f"{function}({a})" for a in multiples for function in ("cos", "sin"))


def _numbered(degree: int) -> list[tuple[int, int]]:
    """(place, harmonic) of each of `_harmonics`, and (-1, 0) of none."""
    return [(-1, 0), *((n, n // 2 + 1) for n in range(2 * degree))]


def body_terms(
    bodies: int, space: int, powers: Sequence[int], *, alike: bool = True, species: str = ""
) -> Sums:
    """Make terms |p_i|² of all bodies, and ``powers`` of the distances of all pairs.

    alike: True where all bodies share their coefficients; else each body and each pair has its own.
    species: a letter for each body, for example "abbb". Bodies of one letter share coefficients,
    and so do pairs of the same two letters.
    """
    r = distance(space)
    rows = tuple((max(n, 0), max(-n, 0)) for n in powers)
    local = (
        (Terms(space, (momentum_squared(space),), ((1,),)), [(i,) for i in range(bodies)]),
        (Terms(2 * space, (r, f"1/{r}"), rows), list(combinations(range(bodies), 2))),
    )
    parts = []
    for terms, groups in local:
        shared: dict[Any, list[tuple[int, ...]]] = {}
        for group in groups:
            letters = "".join(sorted(species[i] for i in group)) if species else ""
            shared.setdefault(letters if species or alike else group, []).append(group)
        for key, members in shared.items():
            over = Groups(tuple(members), bodies, space, key if species else "")
            parts.append(Part(terms, over))
    return Sums(bodies * space, tuple(parts))
