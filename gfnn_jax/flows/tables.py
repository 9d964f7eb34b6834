"""A law as tables of numbers, which the compiled kernel reads at run time: see `flows.kernel`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gfnn_jax.families.lagrangian import DRY, LINEAR, QUADRATIC, UNIFORM, Friction, Terms
from gfnn_jax.flows import kernel as row
from gfnn_jax.flows.dormand_prince import NODES, STAGES, WEIGHTS

_KINDS = {
    LINEAR: row.VISCOUS,
    QUADRATIC: row.CUBIC,
    DRY: row.SMOOTHED,
    UNIFORM: row.EVEN,
}
_LANES = 4  # numbers that a processor works on at once: rows of derivatives are filled up to it


class Tables(NamedTuple):
    """A law but for the values of its coefficients and phases: whole numbers, the number of rows
    of all others, and those of them that the law is made of, by rows."""

    whole: np.ndarray
    rows: int
    numbers: tuple[tuple[int, np.ndarray], ...]

    @classmethod
    def of(cls, terms: Terms, basis: np.ndarray, friction: Friction, num_inputs: int) -> Tables:
        """Make those of terms, whose θ follow coefficients by ``basis`` (P, c), and of friction."""
        count, d = terms.speeds.shape
        touched = (terms.powers != 0) | (terms.modes != 0)
        numbers = touched.sum(axis=1)
        most = max(1, int(numbers.max(initial=0)))
        order = np.argsort(~touched, axis=1, kind="stable")[:, :most]
        own = np.take_along_axis(touched, order, axis=1)
        powers, modes = (
            np.where(own, np.take_along_axis(of, order, axis=1), 0)
            for of in (terms.powers, terms.modes)
        )
        waves: dict[tuple[int, ...], int] = {(0,) * d: -1}  # the first term of each, but of none
        rows = list(map(tuple, terms.modes.tolist()))
        for j, one in enumerate(rows):
            waves.setdefault(one, j)
        numbered = {one: k for k, one in enumerate(waves)}
        at, columns = np.nonzero(basis)
        kinds = np.array([_KINDS[int(kind)] for kind in friction.kinds], dtype=np.int64)
        kinds[friction.jumps] = row.COULOMB
        speeds = terms.speeds
        by_rows = {
            row.DEGREE: speeds.sum(axis=1),
            row.FIRST_V: np.argmax(speeds > 0, axis=1),
            row.LAST_V: d - 1 - np.argmax(speeds[:, ::-1] > 0, axis=1),
            row.WAVE: [numbered[one] for one in rows],
            row.COUNT: numbers,
            row.POWERED: powers.any(axis=1),
            row.WAVES: list(waves.values())[1:],
            row.BEGINS: np.searchsorted(at, np.arange(count + 1)),
            row.COLUMNS: columns,
            row.KINDS: kinds,
        }
        for k, table in enumerate((order, powers, modes)):
            by_rows |= {row.COORDINATES + k * most + i: table[:, i] for i in range(most)}
        longest = max(row.NUM_SIZES, *map(len, by_rows.values()))
        whole = np.zeros((row.COORDINATES + 3 * most, longest), np.int64)
        for k, values in by_rows.items():
            whole[k, : len(values)] = values
        counts = {
            row.DIM: d,
            row.TERMS: count,
            row.NUM_WAVES: len(waves) - 1,
            row.FRICTIONS: len(kinds),
            row.COULOMBS: np.sum(kinds == row.COULOMB),
            row.INPUTS: num_inputs,
            row.FREE_TERMS: basis.shape[1],
            row.MOST: most,
        }
        lengths = (*[d] * 8, *[2 * d] * 3, 12 * d, *[len(kinds)] * 5, most, most**2)
        places = np.cumsum([row.BLOCKS, *lengths])
        whole[row.SIZES, list(counts)] = list(counts.values())
        whole[row.SIZES, row.MASSES : row.NUM_SIZES] = places[:-1]
        directions = places[row.DIRECTIONS - row.MASSES] + np.arange(d)
        parts = ((row.PARTS, basis[at, columns]), (row.WIDTHS, friction.widths))
        columns_of = zip(directions.tolist(), friction.directions.T.astype(float), strict=True)
        stages = zip(range(row.STAGES, row.NODES), STAGES, strict=True)
        tableau = (*stages, (row.NODES, NODES), (row.WEIGHTS, WEIGHTS))
        return cls(whole, int(places[-1]), (*parts, *columns_of, *tableau))

    def room(self, width: int) -> np.ndarray:
        """Room for the numbers of one lane, with ``width`` derivatives of each part of its
        state."""
        sizes = self.whole[row.SIZES]
        d, most = int(sizes[row.DIM]), int(sizes[: row.MASSES].max()) + 1
        longest = max(width, 2 * d, most, *(len(values) for _, values in self.numbers))
        numbers = np.zeros((self.rows, -(-longest // _LANES) * _LANES))
        numbers[row.COSINE, 0] = 1.0
        for place, values in self.numbers:
            numbers[place, : len(values)] = values
        return numbers
