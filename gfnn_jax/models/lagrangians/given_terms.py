"""Terms of a law that a user gives: text in the names of positions and velocities.

    omega1**2;  omega1*omega2*cos(theta1 - theta2);  V: cos(theta1);  R: omega1**2;  R: abs(omega2)

A term is one of L unless V: (potential) or R: (friction) stands before it. A sum gives each of its
terms, so that the formula of a fit can be given again; factors before terms say nothing, because
the fit finds them.
"""

from __future__ import annotations

import ast
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from gfnn_jax.errors import InputError
from gfnn_jax.families.lagrangian import DRY, LINEAR, MAX_POWER, QUADRATIC
from gfnn_jax.families.text import plain
from gfnn_jax.models.lagrangians.libraries import SINE
from gfnn_jax.models.lagrangians.structure import Loss, Row, with_powers

Node = ast.expr


class Given(NamedTuple):
    """Terms of L, the first with v₁², and of R, None where none was given."""

    terms: tuple[Row, ...]
    friction: tuple[Loss, ...] | None


def given_terms(
    texts: Sequence[Any],
    positions: Sequence[str],
    speeds: Sequence[str],
    parameters: Sequence[str] = (),
) -> Given:
    """The terms that these texts name. ``parameters`` are those in which the systems of the
    runs differ.

    Without a kinetic term each coordinate has its ½v². Raises InputError, a line with the text, for
    what is no term of such a law.
    """
    reader = _Reader(tuple(positions), tuple(speeds), tuple(parameters))
    rows: list[Row] = []
    losses: list[Loss] = []
    kinds = set()
    for text in texts:
        if not isinstance(text, str):
            raise InputError("expected terms of a recording's law as text, got a function")
        kind, colon, rest = text.partition(":")
        kind = kind.strip().upper() if colon else "L"
        if kind not in ("L", "V", "R"):
            raise InputError(f"terms: expected L:, V: or R: before a term, got '{text}'")
        kinds.add(kind)
        for node, shown in _summands(rest if colon else text):
            if kind == "R":
                losses.append(reader.loss(node, shown))
            else:
                row = reader.row(node, shown)
                if kind == "V" and any(row[0]):
                    raise InputError(f"terms: '{shown}' has a velocity, and is no term of V")
                rows.append(row)
    dim = len(positions)
    if not any(sum(row[0]) == 2 for row in rows):
        none = (0,) * dim
        own = [tuple(2 * int(i == k) for i in range(dim)) for k in range(dim)]
        rows = [(speeds_of, none, none, 0.0) for speeds_of in own] + rows
    first = next((row for row in rows if row[0][0] == 2), None)
    if first is None:
        raise InputError(f"terms: add a kinetic one, {speeds[0]}**2, which sets the scale of L")
    ordered = dict.fromkeys([first, *rows])
    moving = tuple(row for row in ordered if any(map(any, row[:3])))  # constants move nothing
    return Given(moving, tuple(dict.fromkeys(losses)) if "R" in kinds else None)


def _summands(text: str) -> list[tuple[Node, str]]:
    """The terms of a sum, each with its text."""
    try:
        tree = ast.parse(plain(text.strip()), mode="eval").body
    except (SyntaxError, ValueError, RecursionError) as error:
        raise InputError(f"terms: '{text.strip()}' cannot be read: {error}") from None
    found, open_ = [], [tree]
    while open_:
        node = open_.pop()
        if isinstance(node, ast.BinOp) and isinstance(node.op, (ast.Add, ast.Sub)):
            open_ += [node.right, node.left]
        elif isinstance(node, ast.UnaryOp):
            open_.append(node.operand)
        else:
            found.append((node, ast.unparse(node)))
    return found


class _Reader(NamedTuple):
    """Reads terms in these names."""

    positions: tuple[str, ...]
    speeds: tuple[str, ...]
    parameters: tuple[str, ...]

    def apart(self, node: Node) -> tuple[list[tuple[Node, int]], tuple[int, ...]]:
        """The factors of a product that are no parameters, and the powers of these."""
        powers, others = [0] * len(self.parameters), []
        for factor, power in _factors(node):
            if isinstance(factor, ast.Name) and factor.id in self.parameters:
                powers[self.parameters.index(factor.id)] += power
            else:
                others.append((factor, power))
        return others, tuple(powers)

    def row(self, node: Node, text: str) -> Row:
        """(k, n, m, φ) of a product, with its powers of parameters."""
        k, n, wave = [0] * len(self.positions), [0] * len(self.positions), None
        factors, of_system = self.apart(node)
        for factor, power in factors:
            if isinstance(factor, ast.Constant):
                continue
            if isinstance(factor, ast.Name) and factor.id in (*self.positions, *self.speeds):
                to = k if factor.id in self.speeds else n
                names = self.speeds if factor.id in self.speeds else self.positions
                to[names.index(factor.id)] += power
            elif _called(factor) in ("cos", "sin") and power == 1 and wave is None:
                assert isinstance(factor, ast.Call)
                multiples, phase = self.linear(factor.args[0], text)
                m = [multiples.get(name, 0) for name in self.positions]
                if set(multiples) - set(self.positions) or not any(m):
                    raise self.refused(text)
                wave = tuple(m), phase + (SINE if _called(factor) == "sin" else 0.0)
            else:
                raise self.refused(text)
        if sum(k) > 2 or max(n, default=0) > MAX_POWER or min([*k, *n]) < 0:
            raise self.refused(text)
        m, phase = wave if wave is not None else ((0,) * len(n), 0.0)
        return with_powers((tuple(k), tuple(n), m, phase), of_system)

    def loss(self, node: Node, text: str) -> Loss:
        """(c, kind, ε) of a friction, with its powers of parameters."""
        factors, of_system = self.apart(node)
        factors = [(f, p) for f, p in factors if not isinstance(f, ast.Constant)]
        if len(factors) != 1:
            raise self.refused(text)
        (factor, power), kind, width = factors[0], LINEAR, 0.0
        inside: Node = factor
        if _called(factor) == "abs" and power in (1, 3):
            assert isinstance(factor, ast.Call)
            inside, kind = factor.args[0], (DRY if power == 1 else QUADRATIC)
        elif _called(factor) == "sqrt" and power == 1:
            assert isinstance(factor, ast.Call)
            inside, width = self.smoothed(factor.args[0], text)
            kind = DRY
        elif power != 2:
            raise self.refused(text)
        multiples, rest = self.linear(inside, text)
        if rest or not multiples or set(multiples) - set(self.speeds):
            raise self.refused(text)
        direction = tuple(multiples.get(name, 0) for name in self.speeds)
        return with_powers((direction, kind, width), of_system)

    def smoothed(self, node: Node, text: str) -> tuple[Node, float]:
        """(v, ε) of v² + ε²."""
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
            (speed, power), *others = _factors(node.left)
            size = _number(node.right)
            if power == 2 and not others and size is not None and size > 0:
                return speed, float(np.sqrt(size))
        raise self.refused(text)

    def linear(self, node: Node, text: str) -> tuple[dict[str, int], float]:
        """Whole multiples of names, and a number, whose sum a node is."""
        value = _number(node)
        if value is not None:
            return {}, value
        if isinstance(node, ast.Name):
            return {node.id: 1}, 0.0
        if isinstance(node, ast.UnaryOp):
            return _times(self.linear(node.operand, text), -1)
        if isinstance(node, ast.BinOp):
            if isinstance(node.op, ast.Mult):
                for one, other in ((node.left, node.right), (node.right, node.left)):
                    factor = _number(one)
                    if factor is not None and factor.is_integer():
                        return _times(self.linear(other, text), int(factor))
            if isinstance(node.op, (ast.Add, ast.Sub)):
                sign = 1 if isinstance(node.op, ast.Add) else -1
                a, x = self.linear(node.left, text)
                b, y = _times(self.linear(node.right, text), sign)
                return {n: a.get(n, 0) + b.get(n, 0) for n in (*a, *b)}, x + y
        raise self.refused(text)

    def refused(self, text: str) -> InputError:
        of = f", times whole powers of {', '.join(self.parameters)}" if self.parameters else ""
        return InputError(
            f"terms: '{text}' is no term of a law. A term of L or V is a product of powers of "
            f"{', '.join(self.positions)}, one cos or sin of a sum of whole multiples of them, and "
            f"in L up to two of {', '.join(self.speeds)}; one of R is v**2, abs(v)**3 or abs(v){of}"
        )


def _factors(node: Node) -> list[tuple[Node, int]]:
    """(factor, power) of a product; numbers below a fraction line are numbers."""
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Mult):
        return [*_factors(node.left), *_factors(node.right)]
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Div):
        below = [] if _number(node.right) else _factors(node.right)
        return [*_factors(node.left), *((factor, -power) for factor, power in below)]
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Pow):
        power = _number(node.right)
        if power is not None and power.is_integer() and power != 0:
            return [(factor, inner * int(power)) for factor, inner in _factors(node.left)]
    if isinstance(node, ast.UnaryOp):
        return _factors(node.operand)
    return [(node, 1)]


def _number(node: Node) -> float | None:
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
        value = _number(node.operand)
        return None if value is None else -value
    if isinstance(node, ast.Constant) and isinstance(node.value, (int, float)):
        return float(node.value)
    return None


def _called(node: Node) -> str | None:
    """The name of the function of one argument that a node calls."""
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
        return node.func.id if len(node.args) == 1 and not node.keywords else None
    return None


def _times(linear: tuple[dict[str, int], float], factor: int) -> tuple[dict[str, int], float]:
    multiples, rest = linear
    return {name: factor * n for name, n in multiples.items()}, factor * rest
