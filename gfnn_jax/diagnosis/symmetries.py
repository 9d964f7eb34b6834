"""Symmetries of the pairs by themselves, whatever is learned from them.

A continuous symmetry of H conserves its generator I(z) = ½zᵀAz + bᵀz (Noether): what I changes by
from the first state of a run to its last tells. A discrete one, H(R z) = H(z) with an orthogonal R,
makes ∇H at R z the image of that at z: gradients at the midpoints of some pairs, as polynomials
hold them, are compared with the images of others.
"""

from collections.abc import Iterator
from itertools import combinations
from typing import NamedTuple

import numpy as np

from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.dataset.runs import next_of
from gfnn_jax.families.inputs import box_inputs
from gfnn_jax.families.products import Products
from gfnn_jax.fitting.linear_starts import fitted_gradients
from gfnn_jax.phase_space import apply_j


class Options:
    """Options of the search for symmetries (benchmarks/as_a_user.py)."""

    most_dim: int = 4
    conserved: float = 0.01  # of what it would change by, that a conserved quantity changes by
    degrees: tuple[int, ...] = (2, 3, 4, 5, 6)
    most_terms: int = 210
    rows_per_term: int = 4
    rows: int = 100000  # pairs, the first ones, of which runs are followed
    # pairs to which gradients are fitted, and on which they are compared
    trained: int = 1_000
    held: int = 500
    fitted: float = 0.2  # of the gradients, that polynomials may leave over where they are compared
    # times what they leave of the pairs themselves, they may leave of the images
    as_well: float = 1.5
    covered: float = 0.5  # part of the images that must lie among the pairs


class SymmetryOfPairs(NamedTuple):
    """text: as it is told. left: of a conserved quantity what it changes by, in parts of what it
    would; else what gradients and their images differ by, in parts of the gradients."""

    text: str
    left: float

    def __str__(self) -> str:
        return f"{self.text} (to {self.left:.0e})"


def symmetries_of_pairs(data: Dataset) -> tuple[SymmetryOfPairs, ...]:
    """The symmetries that the pairs show, or a sample of them; none of pairs with args, of many
    degrees of freedom, or where too few lie where their images do. data: without a base map."""
    if data.varied or data.structure is not None or data.dim > Options.most_dim:
        return ()
    angles = tuple(a for a in data.coordinates.angles if a < data.dim)
    if len(angles) < len(data.coordinates.angles):  # a momentum is one: pairs of a kicked map
        return ()
    return (*_conserved(data, angles), *_reflected(data, angles))


def _conserved(data: Dataset, angles: tuple[int, ...]) -> Iterator[SymmetryOfPairs]:
    rows = np.arange(min(len(data.y0), Options.rows))
    goes_on, before, after = next_of(data.pairs, rows), data.y0[rows], data.y1[rows]
    first = before[np.concatenate([[True], ~goes_on])]
    last = after[np.concatenate([~goes_on, [True]])]
    moved = np.sqrt(np.mean(((last - first) / data.scale) ** 2))
    for text, generator in generators(data.dim, angles, data.coordinates.names):
        a, b = generator[:, :-1], generator[:, -1]
        values = [np.sum(z * (0.5 * z @ a + b), axis=1) for z in (before, first, last)]
        spread = np.std(values[0])
        if not spread > 0 or not moved > 0:
            continue
        left = np.sqrt(np.mean((values[2] - values[1]) ** 2)) / spread / moved
        if left <= Options.conserved:
            yield SymmetryOfPairs(text, float(left))


def _reflected(data: Dataset, angles: tuple[int, ...]) -> Iterator[SymmetryOfPairs]:
    parts = _some(data.training, Options.trained), _some(data.validation, Options.held)
    rows = np.concatenate(parts)
    train, held = np.split(np.arange(len(rows)), [min(len(data.training), Options.trained)])
    before, after = data.y0[rows], data.y1[rows]
    middle, weight = 0.5 * (before + after), 1.0 / np.roll(data.scale, data.dim)
    gradient = -apply_j(after - before) / data.dt
    inputs = box_inputs(middle[train], angles=angles, cyclic=data.coordinates.cyclic)
    most = min(Options.most_terms, len(train) * 2 * data.dim // Options.rows_per_term)
    known = [f for f in (Products(inputs, n) for n in Options.degrees) if f.num_parameters <= most]
    if not known or not len(held):
        return
    c = fitted_gradients(known[-1], middle[train], gradient[train], data.scale)

    def missed(z: np.ndarray, wanted: np.ndarray) -> float:
        off = (known[-1].term_gradients(z) @ c - wanted) * weight
        return float(np.sqrt(np.mean(off**2) / np.mean((wanted * weight) ** 2)))

    plain = [i for i in range(2 * data.dim) if i not in angles]
    low, high = middle[train].min(axis=0)[plain], middle[train].max(axis=0)[plain]
    for text, matrix in reflections(data.dim, angles):
        there = middle[held] @ matrix.T
        inside = ((there[:, plain] >= low) & (there[:, plain] <= high)).all(axis=1)
        if np.mean(inside) < Options.covered:
            continue
        own = missed(middle[held][inside], gradient[held][inside])
        left = missed(there[inside], gradient[held][inside] @ matrix.T)
        if own <= Options.fitted and left <= Options.as_well * own:
            yield SymmetryOfPairs(text, left)


def _some(rows: np.ndarray, most: int) -> np.ndarray:
    """At most so many of these rows, evenly spaced."""
    return rows[np.linspace(0, len(rows) - 1, min(len(rows), most)).astype(int)]


# What is looked for, of pairs and of laws


def generators(
    dim: int, angles: tuple[int, ...], names: tuple[str, ...] = ()
) -> Iterator[tuple[str, np.ndarray]]:
    """(text, [A b] (2d, 2d + 1)) of the generators I = ½ zᵀA z + bᵀz; names: of z."""
    one = dim == 1
    names = names or tuple(f"{letter}{i + 1}" for letter in "qp" for i in range(dim))
    plain = [i for i in range(dim) if i not in angles]
    for i in range(dim):
        text = f"translation of {names[i]}: {names[i + dim]} conserved"
        yield text, _generator(dim, linear={i + dim: 1.0})
    if not one:
        name = "translation of all positions: the sum of all momenta conserved"
        yield name, _generator(dim, linear={i + dim: 1.0 for i in range(dim)})
    for i, j in combinations(plain, 2):
        conserved = f"{names[i]} {names[j + dim]} − {names[j]} {names[i + dim]} conserved"
        text = f"rotation in ({names[i]}, {names[j]}): angular momentum {conserved}"
        yield text, _generator(dim, {(i, j + dim): 1.0, (j, i + dim): -1.0})
    if len(plain) == dim:
        squares = "q1² + p1²" if one else "the sum of all q² + p²"
        each = {(i, i): 1.0 for i in range(2 * dim)}
        yield f"rotation of every (q, p): {squares} conserved", _generator(dim, each)


def _generator(dim: int, quadratic=None, linear=None) -> np.ndarray:
    found = np.zeros((2 * dim, 2 * dim + 1))
    for (i, j), value in (quadratic or {}).items():
        found[i, j] = found[j, i] = value
    for i, value in (linear or {}).items():
        found[i, -1] = value
    return found


def reflections(dim: int, angles: tuple[int, ...]) -> Iterator[tuple[str, np.ndarray]]:
    """(text, R (2d, 2d)) of the linear maps under which H may be the same."""
    yield "reversal of time", np.diag(np.repeat([1.0, -1.0], dim))
    yield "reflection of all coordinates", -np.eye(2 * dim)
    for i, j in combinations(range(dim), 2):
        if (i in angles) == (j in angles):
            order = np.arange(2 * dim)
            order[[i, j, i + dim, j + dim]] = order[[j, i, j + dim, i + dim]]
            yield f"exchange of degrees of freedom {i + 1} and {j + 1}", np.eye(2 * dim)[order]
