"""A law as tables of numbers, which the compiled kernel reads at run time: see `flows.kernel`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.polynomial import chebyshev

from gfnn_jax.families.expressions import Expression, depends_on, number
from gfnn_jax.families.friction import (
    DRY,
    ISOTROPIC,
    LINEAR,
    LOADED,
    ONE_SIDED,
    PLACED,
    POWER,
    QUADRATIC,
    STRIBECK,
    UNIFORM,
    Friction,
)
from gfnn_jax.families.functions import CHEBYSHEV, own_function
from gfnn_jax.families.lagrangian import Terms
from gfnn_jax.families.traced import traced_pieces
from gfnn_jax.flows import kernel as row
from gfnn_jax.flows.dormand_prince import NODES, STAGES, WEIGHTS

_KINDS = {
    LINEAR: row.VISCOUS,
    QUADRATIC: row.CUBIC,
    DRY: row.SMOOTHED,
    UNIFORM: row.EVEN,
    POWER: row.RAISED_SPEED,
    ONE_SIDED: row.ONE_SIDED,
    ISOTROPIC: row.DRAG,
    STRIBECK: row.FADING,
    LOADED: row.SMOOTHED,
    PLACED: row.PLACED,
}
_BINARY = {"+": row.PLUS, "*": row.TIMES, "max": row.LARGER, ">": row.GREATER}
_TAKEN = dict.fromkeys(_BINARY.values(), 1) | {row.SELECT: 2, row.COMPOSE: 3}  # from the stack
_PUSHED = (row.VARIABLE, row.CONSTANT, row.COPY, row.INPUT)
_POWERS = {2.0: row.SQUARE, -1.0: row.INVERSE_OF, 0.5: row.ROOT}
_FUNCTIONS = {
    "sin": row.SIN,
    "cos": row.COS,
    "tan": row.TAN,
    "exp": row.EXP,
    "log": row.LOG,
    "sqrt": row.ROOT,
    "sinh": row.SINH,
    "cosh": row.COSH,
    "tanh": row.TANH,
    "arctan": row.ARCTAN,
    "abs": row.ABS,
}
_LANES = 8  # numbers that a processor works on at once: rows of derivatives are filled up to it


class Tables(NamedTuple):
    """A law but for the values of its coefficients and phases: whole numbers, the number of rows
    of all others, and those of them that the law is made of, by rows; and rooms of each width."""

    whole: np.ndarray
    rows: int
    numbers: tuple[tuple[int, np.ndarray], ...]
    rooms: dict[int, np.ndarray]

    @classmethod
    def of(cls, terms: Terms, basis: np.ndarray, friction: Friction, num_inputs: int) -> Tables:
        """Make those of terms, whose θ follow coefficients by ``basis`` (P, c), and of friction."""
        count, d = terms.speeds.shape
        touched = (terms.powers != 0) | (terms.modes != 0)
        for j, tree in terms.trees.items():
            touched[j, list(depends_on(tree))] = True
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
        kinds = np.array([_KINDS[min(int(k), LOADED)] for k in friction.kinds], dtype=np.int64)
        kinds[friction.jumps] = row.COULOMB
        speeds = terms.speeds
        code: list[Operation] = []
        begins = [0]
        for j in range(count):
            if j in terms.trees:
                code += operations(terms.trees[j], order[j].tolist())
            begins.append(len(code))
        by_rows = {
            row.DEGREE: speeds.sum(axis=1),
            row.FIRST_V: np.argmax(speeds > 0, axis=1),
            row.LAST_V: d - 1 - np.argmax(speeds[:, ::-1] > 0, axis=1),
            row.WAVE: [numbered[one] for one in rows],
            row.COUNT: numbers,
            row.POWERED: powers.any(axis=1),
            row.LEVEL: terms.follows if terms.leaders else [0] * count,
            row.LEVELS: [int(bool(terms.leaders) and i not in terms.leaders) for i in range(d)],
            row.WAVES: list(waves.values())[1:],
            row.BEGINS: np.searchsorted(at, np.arange(count + 1)),
            row.COLUMNS: columns,
            row.KINDS: kinds,
            row.LOADS: np.maximum(friction.kinds - LOADED, -1),
            row.PROGRAMS: begins,
            row.CODE: [operation for operation, _ in code],
        }
        for k, table in enumerate((order, powers, modes)):
            by_rows |= {row.COORDINATES + k * most + i: table[:, i] for i in range(most)}
        longest = max(row.NUM_SIZES, *map(len, by_rows.values()))
        whole = np.zeros((row.COORDINATES + 3 * most, longest), np.int64)
        for k, values in by_rows.items():
            whole[k, : len(values)] = values
        counts = {row.DIM: d, row.TERMS: count, row.INPUTS: num_inputs, row.MOST: most}
        counts |= {row.NUM_WAVES: len(waves) - 1, row.FREE_TERMS: basis.shape[1]}
        counts |= {row.FRICTIONS: len(kinds), row.COULOMBS: np.sum(kinds == row.COULOMB)}
        jet = 1 + most + most**2 if code else 0
        lengths = (*[d] * 8, *[2 * d] * 3, 12 * d, *[len(kinds)] * 5, most, most**2, jet)
        places = np.cumsum([row.BLOCKS, *lengths])
        whole[row.SIZES, list(counts)] = list(counts.values())
        whole[row.SIZES, row.MASSES : row.NUM_SIZES] = places[:-1]
        directions = places[row.DIRECTIONS - row.MASSES] + np.arange(d)
        operands = np.array([operand for _, operand in code])
        stack = np.zeros(_depth(code))
        parts = (row.PARTS, basis[at, columns]), (row.WIDTHS, friction.widths)
        parts += (row.OPERANDS, operands), (row.STACK, stack)
        columns_of = zip(directions.tolist(), friction.directions.T.astype(float), strict=True)
        stages = zip(range(row.STAGES, row.NODES), STAGES, strict=True)
        tableau = (*stages, (row.NODES, NODES), (row.WEIGHTS, WEIGHTS))
        return cls(whole, int(places[-1]), (*parts, *columns_of, *tableau), {})

    def room(self, width: int) -> np.ndarray:
        """Room for the numbers of one lane, with ``width`` derivatives of each part of its
        state."""
        if width in self.rooms:
            return self.rooms[width].copy()
        sizes = self.whole[row.SIZES]
        d, most = int(sizes[row.DIM]), int(sizes[: row.MASSES].max()) + 1
        longest = max(width, 2 * d, most, *(len(values) for _, values in self.numbers))
        numbers = np.zeros((self.rows, -(-longest // _LANES) * _LANES))
        for place, values in self.numbers:
            numbers[place, : len(values)] = values
        self.rooms[width] = numbers
        return numbers.copy()


Operation = tuple[int, float]


def operations(tree: Expression, slots: list[int], at: int = 0) -> list[Operation]:
    """The operations of a shape in the order in which a stack that holds ``at`` numbers computes
    them; coordinates by their places among ``slots``, inputs by their own.

    Raises InputError for a function of a user's own that is no formula.
    """
    kind, operands = tree.operation, tree.operands
    if kind == "number":
        return [(row.CONSTANT, operands[0])]
    if kind == "coordinate":
        return [(row.VARIABLE, float(slots.index(operands[0])))]
    if kind == "parameter":
        return [(row.INPUT, float(operands[0]))]
    if CHEBYSHEV.fullmatch(kind):
        return operations(_chebyshev(int(kind[1:]), operands[0]), slots, at)
    if kind == "/":
        power = Expression("power", (operands[1], -1.0))
        if operands[0].value == 1:
            return operations(power, slots, at)
        return operations(Expression("*", (operands[0], power)), slots, at)
    trees = [operand for operand in operands if isinstance(operand, Expression)]
    inner = [o for k, of in enumerate(trees) for o in operations(of, slots, at + k)]
    if kind == "power":
        return [*inner, (_POWERS.get(operands[1], row.RAISED), operands[1])]
    if (own := own_function(kind)) is not None:
        for k, piece in enumerate(traced_pieces(own.derivatives), 1):
            # The variable is the number on the stack.
            code = operations(piece, [0], at + k)
            inner += [(row.COPY, at) if o == row.VARIABLE else (o, c) for o, c in code]
    known = _BINARY | _FUNCTIONS | {"select": row.SELECT}
    return [*inner, (row.COMPOSE if own else known[kind], 0.0)]


def _chebyshev(n: int, x: Expression) -> Expression:
    """T_n(x) by its coefficients, as Horner computes it."""
    found = number(0.0)
    for c in chebyshev.cheb2poly([0.0] * n + [1.0])[::-1].tolist():
        found = found * x + c
    return found


def _depth(code: list[Operation]) -> int:
    """The most numbers that are on the stack at once."""
    if not code:
        return 0
    steps = [1 if o in _PUSHED else -_TAKEN.get(o, 0) for o, _ in code]
    return int(np.cumsum(steps).max())
