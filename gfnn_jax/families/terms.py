"""Products of powers of named variables, linear in the parameters, as a formula is written.

    f(c, w) = Σ_j c_j Π_k x_k(w)^a_jk

A variable x_k is an expression: a coordinate, cos q1, 1/r of a scene, a term that a user gives. The
coefficients are those of the formula, in the user's units; a fit scales the columns itself. The
family consists of text and whole numbers, and is saved as such.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache, cached_property
from itertools import combinations_with_replacement
from typing import Any

import numpy as np

from gfnn_jax.arrays import matmul, namespace, pytree
from gfnn_jax.errors import InputError
from gfnn_jax.families.expressions import (
    Expression,
    coordinate,
    count_operations,
    depends_on,
    parse,
    parse_named,
    to_text,
)
from gfnn_jax.families.family import OfCoefficients
from gfnn_jax.families.jets import jets
from gfnn_jax.families.text import superscript
from gfnn_jax.families.traced import traced

# Up to this number, products with coefficients are written one by one, and XLA fuses them; beyond
# it they are a matrix product.
_MOST_WRITTEN_OUT = 400


class _Plan:
    """Order of computation of the products of powers, N rows of k, and of their derivatives.

    The set of products is closed under division by a variable, and each one is an earlier product
    times a variable. still: variables that depend on no coordinate and have no derivatives.
    """

    def __init__(self, terms: tuple[tuple[int, ...], ...], still: tuple[int, ...]):
        variables = len(terms[0])
        closed: set[tuple[int, ...]] = {(0,) * variables}
        ahead = list(terms)
        while ahead:
            row = ahead.pop()
            if row not in closed:
                closed.add(row)
                ahead += [_less(row, k) for k in range(variables) if row[k]]
        rows = sorted(closed, key=lambda r: (sum(r), r))
        place = {row: i for i, row in enumerate(rows)}
        self.size = len(rows)
        # Each product but 1 is (an earlier product, the variable that multiplies it).
        self.parents = [
            (place[_less(row, k)], k)
            for row in rows[1:]
            for k in [next(k for k in range(variables) if row[k])]
        ]
        self.places = np.array([place[row] for row in terms], dtype=int)
        # ∂/∂x_k as (term, product, factor): ∂_k term = factor · product; ∂²/∂x_k∂x_l likewise.
        slopes: list[list] = [[] for _ in range(variables)]
        curvatures: dict[tuple[int, int], list] = {}
        for j, row in enumerate(terms):
            used = [k for k in range(variables) if row[k] and k not in still]
            for n, k in enumerate(used):
                less = _less(row, k)
                slopes[k].append((j, place[less], row[k]))
                for m in used[n:]:
                    if less[m]:
                        entry = (j, place[_less(less, m)], row[k] * less[m])
                        curvatures.setdefault((k, m), []).append(entry)
        self.slopes = [_columns(entries) for entries in slopes]
        self.curvatures = {pair: _columns(curvatures[pair]) for pair in sorted(curvatures)}

    def products(self, variables: list, xp) -> list:
        """Compute all products from the values of the variables."""
        found: list[Any] = [xp.ones_like(variables[0])]
        for parent, k in self.parents:
            found.append(variables[k] if parent == 0 else found[parent] * variables[k])
        return found

    def combined(self, params, products: list, columns: list) -> list:
        """Compute Σ_j c_j · factor_j · product_j for each column (term, product, factor)."""
        xp = namespace(params, products[-1])
        sizes = [len(c[0]) for c in columns]
        if xp is not np and sum(sizes) <= _MOST_WRITTEN_OUT:
            return [
                sum((params[j] * f) * products[i] for j, i, f in zip(*c, strict=True))
                for c in columns
            ]
        matrix = xp.zeros((self.size, len(columns)), dtype=params.dtype)
        for n, (j, i, f) in enumerate(columns):
            if xp is np:
                np.add.at(matrix[:, n], i, params[j] * f)
            else:
                matrix = matrix.at[i, n].add(params[j] * f.astype(params.dtype))
        if xp is np:
            shape = products[0].shape
            out = matrix.T @ np.stack(products).reshape(self.size, -1)
            return list(out.reshape(len(columns), *shape))
        out = matmul(xp.stack(products, axis=-1), matrix)
        return [out[..., n] for n in range(len(columns))]


def _less(row: tuple[int, ...], k: int) -> tuple[int, ...]:
    return (*row[:k], row[k] - 1, *row[k + 1 :])


def _columns(entries: list) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    j, i, f = zip(*entries, strict=True) if entries else ((), (), ())
    return np.array(j, dtype=int), np.array(i, dtype=int), np.array(f, dtype=float)


_plan_of = cache(_Plan)


@pytree("dim", "variables", "powers", "parameters", "names", eq=True)
class Terms(OfCoefficients):
    """Family of products of powers of ``variables``, one for each row of ``powers`` (N, k).

    variables: expressions as text. params: the coefficients (N,). parameters: names of the args,
    which variables may contain. names: of the coordinates, where these are no (q, p): any number.
    """

    dim: int
    variables: tuple[str, ...]
    powers: tuple[tuple[int, ...], ...]
    parameters: tuple[str, ...] = ()
    names: tuple[str, ...] = ()

    name = "terms"

    @property
    def num_parameters(self) -> int:
        return len(self.powers)

    @cached_property
    def trees(self) -> list[Expression]:
        """Expressions of the variables."""
        if self.names:
            return [parse_named(text, self.names, self.parameters) for text in self.variables]
        return [parse(text, self.dim, self.parameters) for text in self.variables]

    @property
    def _plan(self) -> _Plan:
        return _plan_of(self.powers, self._still)

    @cached_property
    def _still(self) -> tuple[int, ...]:
        return tuple(k for k, tree in enumerate(self.trees) if not depends_on(tree))

    @property
    def term_names(self) -> tuple[str, ...]:
        """Text of each term in a formula: "q1² q2"."""
        named = [
            text if tree.operation not in ("+", "*", "/", "power", "number") else f"({text})"
            for text, tree in zip(self.variables, self.trees, strict=True)
        ]
        names = []
        for row in self.powers:
            factors = [
                (text if alone else name) if a == 1 else f"{name}{superscript(a)}"
                for text, name, a in zip(self.variables, named, row, strict=True)
                if a
                for alone in [sum(row) == 1]
            ]
            names.append(" ".join(factors))
        return tuple(names)

    @property
    def operations(self) -> tuple[int, int]:
        """Floating-point operations of a gradient, and of a gradient with its Hessian."""
        plan = self._plan
        variables = sum(count_operations(t) * (1 + 2 * len(depends_on(t))) for t in self.trees)
        gradient = plan.size + sum(2 * len(c[0]) for c in plan.slopes) + variables
        more = sum(2 * len(c[0]) for c in plan.curvatures.values()) + 2 * variables
        return gradient, gradient + more + 4 * self.dim * self.dim

    def take(self, rows: Sequence[int]) -> Terms:
        """Make the family of these terms alone, without the variables that are no longer used."""
        shape = len(self.powers), len(self.variables)
        kept = np.array(self.powers, dtype=int).reshape(shape)[list(rows)]
        used = np.flatnonzero(kept.any(axis=0)) if len(kept) else np.arange(0)
        variables = tuple(self.variables[k] for k in used)
        powers = tuple(tuple(row) for row in kept[:, used].tolist())
        return Terms(self.dim, variables, powers, self.parameters, self.names)

    def value(self, params, w, args=None):
        """Value of f, shape (...): params (N,), w (..., 2d)."""
        variables = self._variables(w, 0, args)
        products = self._products(variables, w)
        places = self._plan.places
        columns = [(np.arange(len(places)), places, np.ones(len(places)))]
        return self._plan.combined(params, products, columns)[0]

    def gradient(self, params, w, args=None):
        """Gradient ∂f/∂w (..., 2d)."""
        variables = self._variables(w, 1, args)
        products = self._products(variables, w)
        slopes = self._plan.combined(params, products, self._plan.slopes)
        return self._stacked(_pulled_back(variables, slopes), w)

    def gradient_and_hessian(self, params, w, args=None):
        """Gradient ∂f/∂w (..., 2d) and Hessian ∂²f/∂w² (..., 2d, 2d)."""
        xp, width = namespace(w), w.shape[-1]
        variables, plan = self._variables(w, 2, args), self._plan
        products = self._products(variables, w)
        pairs = list(plan.curvatures)
        found = plan.combined(
            params, products, [*plan.slopes, *(plan.curvatures[p] for p in pairs)]
        )
        slopes, bends = found[: len(plan.slopes)], found[len(plan.slopes) :]
        entries: dict[tuple[int, int], Any] = {}

        def add(i, j, term):
            key = (min(i, j), max(i, j))
            entries[key] = entries[key] + term if key in entries else term

        for (k, m), bend in zip(pairs, bends, strict=True):
            for i, a in variables[k].slope.items():
                for j, b in variables[m].slope.items():
                    if k != m:
                        add(i, j, bend * a * b * (2.0 if i == j else 1.0))
                    elif i <= j:
                        add(i, j, bend * a * b)
        for variable, slope in zip(variables, slopes, strict=True):
            for (i, j), curvature in variable.curvature.items():
                add(i, j, slope * curvature)
        zero = xp.zeros_like(w[..., 0])
        full = [
            _like(entries.get((min(i, j), max(i, j)), zero), zero, xp)
            for i in range(width)
            for j in range(width)
        ]
        hessian = xp.stack(full, axis=-1).reshape(*w.shape, width)
        return self._stacked(_pulled_back(variables, slopes), w), hessian

    def term_values(self, w, args=None):
        """Values of all terms at w (..., 2d): (..., N). NumPy."""
        products = self._products(self._variables(w, 0, args), w)
        return np.stack([products[i] for i in self._plan.places], axis=-1)

    def term_gradients(self, w, args=None):
        """Gradients of all terms at w (..., 2d): (..., 2d, N). NumPy."""
        variables, plan = self._variables(w, 1, args), self._plan
        products = np.stack(self._products(variables, w), axis=-1)
        out = np.zeros((*w.shape, self.num_parameters))
        for variable, (j, i, factor) in zip(variables, plan.slopes, strict=True):
            along = products[..., i] * factor
            for index, slope in variable.slope.items():
                unit = isinstance(slope, float)
                out[..., index, j] += along * (slope if unit else slope[..., None])
        return out

    def _variables(self, w, order: int, args) -> list:
        return jets(self.trees, w, order, args)

    def _products(self, variables, w) -> list:
        xp, zero = namespace(w), namespace(w).zeros_like(w[..., 0])
        return self._plan.products([_like(v.value, zero, xp) for v in variables], xp)

    def _stacked(self, gradient: dict, w):
        xp, zero = namespace(w), namespace(w).zeros_like(w[..., 0])
        return xp.stack(
            [_like(gradient.get(i, zero), zero, xp) for i in range(w.shape[-1])], axis=-1
        )


def _like(value, zero, xp):
    """Broadcast the value to an array of the lanes' shape."""
    return value if getattr(value, "shape", None) == zero.shape else zero + value


def _pulled_back(variables, slopes) -> dict[int, Any]:
    """Apply the chain rule: {i: ∂f/∂w_i} from ∂f/∂x_k."""
    gradient: dict[int, Any] = {}
    for variable, slope in zip(variables, slopes, strict=True):
        for i, s in variable.slope.items():
            term = slope if isinstance(s, float) and s == 1.0 else slope * s
            gradient[i] = gradient[i] + term if i in gradient else term
    return gradient


# Constructors of families of terms.


def given_terms(
    dim: int, given: Sequence[str | Callable], parameters: tuple[str, ...] = ()
) -> Terms:
    """Make the family of a user's own terms: text, or functions of z (2d,).

    A function may return several terms. parameters: names that a text may use beside those of the
    coordinates.

    Raises InputError for a term that is not understood, or that does not depend on the state.
    """
    texts: list[str] = []
    for term in given:
        trees = [parse(term, dim, parameters)] if isinstance(term, str) else traced(term, dim)
        for tree in trees:
            text = to_text(tree, dim, parameters)
            if not depends_on(tree):
                raise InputError(
                    f"the term '{text}' is the same at every state and changes no motion: leave it "
                    "out"
                )
            texts.append(text)
    unique = tuple(dict.fromkeys(texts))
    count = range(len(unique))
    rows = tuple(tuple(int(k == j) for k in count) for j in count)
    return Terms(dim, unique, rows, parameters)


def polynomial_terms(
    dim: int,
    degree: int,
    *,
    cyclic: Sequence[int] = (),
    features: Callable | None = None,
    reversor: Sequence[int] | None = None,
) -> Terms:
    """Make all products of total degree 1 to ``degree`` of the coordinates or a scene's features.

    cyclic: indices of z that do not enter. features: ``features(z)`` -> (k,). reversor: signs (2d,)
    under which H is even; odd terms are left out.
    """
    if features is not None:
        trees = traced(features, dim)
    else:
        trees = [coordinate(i) for i in range(2 * dim) if i not in cyclic]
    odd = _odd(trees, dim, reversor)
    rows = tuple(row for row in exponents(len(trees), degree) if sum(row[k] for k in odd) % 2 == 0)
    return Terms(dim, tuple(to_text(tree, dim) for tree in trees), rows)


def joined(first: Terms, second: Terms) -> Terms:
    """Make the union of the terms of both, without duplicates."""
    variables, *rows = _over_both(first, second)
    both = tuple(dict.fromkeys(rows[0] + rows[1]))
    return Terms(first.dim, variables, both, first.parameters, first.names)


def multiplied(first: Terms, second: Terms) -> Terms:
    """Multiply each term of the first family by each term of the second."""
    variables, left, right = _over_both(first, second)
    rows = dict.fromkeys(
        tuple(a + b for a, b in zip(one, other, strict=True)) for one in left for other in right
    )
    return Terms(first.dim, variables, tuple(rows), first.parameters, first.names)


def _over_both(first: Terms, second: Terms):
    """Variables of both families together, and the powers of each over these."""
    variables = tuple(dict.fromkeys((*first.variables, *second.variables)))
    rows = (
        [
            tuple(row[f.variables.index(v)] if v in f.variables else 0 for v in variables)
            for row in f.powers
        ]
        for f in (first, second)
    )
    return (variables, *rows)


def exponents(variables: int, degree: int) -> list[tuple[int, ...]]:
    """Exponents of all products of total degree 1 to ``degree``, by rising degree."""
    rows = []
    for total in range(1, degree + 1):
        for chosen in combinations_with_replacement(range(variables), total):
            rows.append(tuple(chosen.count(k) for k in range(variables)))
    return rows


def _odd(trees: list[Expression], dim: int, reversor) -> list[int]:
    """Indices of the variables that change sign under the reversor.

    A variable that is neither even nor odd counts as even.
    """
    if reversor is None:
        return []
    z = np.random.default_rng(0).uniform(0.2, 1.0, (8, 2 * dim))
    flipped = z * np.array(reversor, dtype=float)
    return [
        k
        for k, (here, there) in enumerate(
            zip(jets(trees, z, 0), jets(trees, flipped, 0), strict=True)
        )
        if np.allclose(here.value, -there.value, rtol=1e-9, atol=1e-12)
    ]
