"""Expressions in the coordinates of a state: trees made of text or of a Python function.

Text is parsed with `ast` against a list of allowed names; nothing is ever evaluated as code, so
that a term a user gives is data. A Python function becomes the same tree in `traced`; values and
derivatives are computed in `jets`.
"""

import ast
import dataclasses
import keyword
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache, cached_property
from typing import Any

from gfnn_jax.errors import InputError
from gfnn_jax.families.functions import CHEBYSHEV, known_functions
from gfnn_jax.families.site_sums import balanced, of_a_window, written_out
from gfnn_jax.families.text import OTHER_NAMES, added, plain

_LONGEST_TEXT, _DEEPEST = 20_000, 60
_CONSTANTS = {"pi": math.pi, "e": math.e}


@dataclasses.dataclass(frozen=True, eq=True)
class Expression:
    """Node of a tree: ``operation`` with its ``operands``.

    "number" holds a float, "coordinate" an index of z, "parameter" an index of the args, "power" a
    node and a float. "+", "*" and "/" hold two nodes. The name of a function holds one, and so does
    "T3", a Chebyshev polynomial.
    """

    operation: str
    operands: tuple

    def __hash__(self):
        return self._hash

    @cached_property
    def _hash(self) -> int:
        return hash((self.operation, self.operands))

    def __add__(self, other):
        return _sum(self, as_expression(other))

    def __radd__(self, other):
        return _sum(as_expression(other), self)

    def __sub__(self, other):
        return _sum(self, -as_expression(other))

    def __rsub__(self, other):
        return _sum(as_expression(other), -self)

    def __neg__(self):
        return _product(number(-1.0), self)

    def __mul__(self, other):
        return _product(self, as_expression(other))

    def __rmul__(self, other):
        return _product(as_expression(other), self)

    def __truediv__(self, other):
        return _quotient(self, as_expression(other))

    def __rtruediv__(self, other):
        return _quotient(as_expression(other), self)

    def __pow__(self, exponent):
        return power(self, exponent)

    @property
    def value(self) -> float | None:
        """Number of a constant; None for another node."""
        return self.operands[0] if self.operation == "number" else None


def number(value: Any) -> Expression:
    return Expression("number", (float(value),))


def coordinate(index: int) -> Expression:
    return Expression("coordinate", (index,))


def parameter(index: int) -> Expression:
    return Expression("parameter", (index,))


def as_expression(value: Any) -> Expression:
    return value if isinstance(value, Expression) else number(value)


def _sum(a: Expression, b: Expression) -> Expression:
    if a.value is not None and b.value is not None:
        return number(a.value + b.value)
    if a.value == 0:
        return b
    if b.value is not None and a.operation == "+" and a.operands[1].value is not None:
        return _sum(a.operands[0], number(a.operands[1].value + b.value))
    return a if b.value == 0 else Expression("+", (a, b))


def _product(a: Expression, b: Expression) -> Expression:
    if a.value is not None and b.value is not None:
        return number(a.value * b.value)
    if b.value is not None:
        a, b = b, a
    if a.value == 0:
        return a
    if a.value is not None and b.operation == "*" and b.operands[0].value is not None:
        return _product(number(a.value * b.operands[0].value), b.operands[1])
    if a == b:
        return power(a, 2.0)
    return b if a.value == 1 else Expression("*", (a, b))


def _quotient(a: Expression, b: Expression) -> Expression:
    if b.value is not None and b.value != 0:
        return _product(number(1 / b.value), a)
    return Expression("/", (a, b))


def power(base: Expression, exponent: float) -> Expression:
    exponent = float(exponent)
    if exponent == 0:
        return number(1.0)
    if base.value is not None:
        return number(base.value**exponent)
    if exponent == 0.5:
        return call("sqrt", base)
    return base if exponent == 1 else Expression("power", (base, exponent))


def call(name: str, operand: Expression) -> Expression:
    return Expression(name, (operand,))


# Names of the coordinates, text -> tree, tree -> text.


def coordinate_names(dim: int) -> tuple[str, ...]:
    """Names q1..qd, p1..pd of the coordinates."""
    return tuple(f"{letter}{i + 1}" for letter in "qp" for i in range(dim))


def check_names(dim: int, names: Sequence[str]) -> None:
    """Raise InputError where these names of parameters could not be used in an expression."""
    taken = {*coordinate_names(dim), *known_functions(), *OTHER_NAMES, "q", "p", "t"}
    for name in names:
        if not name.isidentifier() or keyword.iskeyword(name):
            raise InputError(f"expected letters, digits and _ as a parameter's name, got '{name}'")
        if name in taken or CHEBYSHEV.fullmatch(name):
            raise InputError(
                f"'{name}' cannot name a parameter: it already names a coordinate, the time or a "
                "function; choose another name"
            )


@cache
def parse(text: str, dim: int, parameters: tuple[str, ...] = ()) -> Expression:
    """Parse an expression in q1..qd, p1..pd (q, p where d = 1) and the parameters into a tree,
    written as code, "p1**2*q1", or as a formula is shown, "p1² q1".

    Sums over sites are written as `site_sums` has them. Raises InputError, in one line, for
    anything else but numbers, + - * / **, the coordinates, the parameters and the functions of
    `known_functions`.
    """
    names = {name: coordinate(i) for i, name in enumerate(coordinate_names(dim))}
    if dim == 1:
        names.update(q=coordinate(0), p=coordinate(1))
    names.update({name: parameter(i) for i, name in enumerate(parameters)})
    return _read(text, lambda tree: _parsed(written_out(tree, dim), names, text, 0))


def window_terms(text: str) -> list[str]:
    """The summands of sums over sites, each in the q1, p1, q2, … of a site and the next ones; of
    any other term its text alone.

    Raises InputError as `parse` does.
    """
    return _read(text, lambda tree: [ast.unparse(part) for part in of_a_window(tree)])


def parse_named(text: str, names: Sequence[str], parameters: Sequence[str] = ()) -> Expression:
    """Parse an expression in variables of any names, which become coordinates in their order, and
    in parameters.

    Raises InputError as `parse` does.
    """
    known = {name: coordinate(i) for i, name in enumerate(names)}
    known |= {name: parameter(i) for i, name in enumerate(parameters)}
    return _read(text, lambda tree: _parsed(tree, known, text, 0))


def summands(
    text: str, names: Sequence[str], parameters: Sequence[str] = ()
) -> list[tuple[str, Expression]]:
    """The terms of a sum in variables and parameters of these names, as `parse_named` reads each,
    without the number before it, and its text.

    Raises InputError as `parse` does.
    """
    known = {name: coordinate(i) for i, name in enumerate(names)}
    known |= {name: parameter(i) for i, name in enumerate(parameters)}

    def parts(tree: ast.expr) -> list[tuple[str, Expression]]:
        found, open_ = [], [tree]
        while open_:
            node = open_.pop()
            if isinstance(node, ast.BinOp) and isinstance(node.op, (ast.Add, ast.Sub)):
                open_ += [node.right, node.left]
            elif isinstance(node, ast.UnaryOp):
                open_.append(node.operand)
            else:
                own = _without_number(node)
                found.append((ast.unparse(node), _parsed(own, known, ast.unparse(node), 0)))
        return found

    return _read(text, parts)


def _without_number(node: ast.expr) -> ast.expr:
    """A product without its first factor where that is a number, which may be 0."""
    if not isinstance(node, ast.BinOp) or not isinstance(node.op, (ast.Mult, ast.Div)):
        return node
    first = node.left.operand if isinstance(node.left, ast.UnaryOp) else node.left
    if not isinstance(first, ast.Constant):
        return ast.BinOp(_without_number(node.left), node.op, node.right)
    return (
        node.right
        if isinstance(node.op, ast.Mult)
        else ast.BinOp(ast.Constant(1), node.op, node.right)
    )


def names_in(text: str) -> tuple[str, ...]:
    """The names of variables in an expression, in the order in which they appear."""
    nodes = _read(text, lambda tree: list(ast.walk(tree)))
    called = {id(node.func) for node in nodes if isinstance(node, ast.Call)}
    found = [n for n in nodes if isinstance(n, ast.Name) and id(n) not in called]
    found.sort(key=lambda node: node.col_offset)
    return tuple(dict.fromkeys(node.id for node in found if node.id not in _CONSTANTS))


def _read(text: str, use: Callable[[ast.expr], Any]) -> Any:
    """Apply ``use`` to the syntax tree of a text. Raises InputError where there is none."""
    if len(text) > _LONGEST_TEXT:
        raise InputError(f"expected a term of at most {_LONGEST_TEXT} characters, got {len(text)}")
    try:
        return use(ast.parse(plain(text.strip()), mode="eval").body)
    except (SyntaxError, ValueError, RecursionError, MemoryError, OverflowError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"the term '{text}' is no expression that can be read: {error}") from None


def _parsed(node, names, text, depth) -> Expression:
    def refuse(what: str) -> InputError:
        return InputError(
            f"the term '{text}' has {what}: expected numbers, + - * / **, "
            f"{', '.join(names)} and {', '.join(known_functions())}"
        )

    def inner(child) -> Expression:
        return _parsed(child, names, text, depth + 1)

    if depth > _DEEPEST:
        raise refuse(f"more than {_DEEPEST} levels")
    value = node.value if isinstance(node, ast.Constant) else None
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        if not math.isfinite(value):
            raise refuse("a number that is beyond float64")
        return number(float(value))
    if isinstance(node, ast.Name):
        if node.id in names:
            return names[node.id]
        if node.id in _CONSTANTS:
            return number(_CONSTANTS[node.id])
        raise refuse(f"the name '{node.id}'")
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, (ast.UAdd, ast.USub)):
        operand = inner(node.operand)
        return -operand if isinstance(node.op, ast.USub) else operand
    if isinstance(node, ast.Call):
        name = node.func.id if isinstance(node.func, ast.Name) else "?"
        name = OTHER_NAMES.get(name, name)
        known = name in known_functions() or CHEBYSHEV.fullmatch(name)
        if not known or node.keywords or len(node.args) != 1:
            raise refuse(f"a call of '{ast.unparse(node.func)}' with {len(node.args)} arguments")
        return call(name, inner(node.args[0]))
    if isinstance(node, ast.BinOp):
        addends = _addends(node)
        if len(addends) > _DEEPEST:
            return inner(balanced(addends))
        left, right = inner(node.left), inner(node.right)
        match node.op:
            case ast.Add():
                return left + right
            case ast.Sub():
                return left - right
            case ast.Mult():
                return left * right
            case ast.Div():
                return left / right
            case ast.Pow():
                if right.value is None:
                    raise refuse("an exponent that is not a number")
                return power(left, right.value)
            case ast.BitXor():
                raise refuse("a ^, where a power is written **")
    raise refuse(f"'{ast.unparse(node)}'")


def _addends(node: ast.expr) -> list[ast.expr]:
    """Addends of a sum that is written without brackets."""
    found = []
    while isinstance(node, ast.BinOp) and isinstance(node.op, (ast.Add, ast.Sub)):
        minus = isinstance(node.op, ast.Sub)
        found.append(ast.UnaryOp(ast.USub(), node.right) if minus else node.right)
        node = node.left
    return [node, *reversed(found)]


_SUM, _PRODUCT, _POWER, _ATOM = range(4)


def to_text(tree: Expression, dim: int, parameters: tuple[str, ...] = ()) -> str:
    """Write the tree as text that `parse` reads back, every number to its last digit."""
    return _text(tree, (*coordinate_names(dim), *parameters), 2 * dim)[0]


def to_named_text(
    tree: Expression,
    names: Sequence[str],
    parameters: Sequence[str] = (),
    as_factor: bool = False,
) -> str:
    """Write a tree of coordinates and parameters of these names as text that `parse_named` reads
    back; a sum in brackets where other factors will stand before it."""
    text, binds = _text(tree, (*names, *parameters), len(names))
    return f"({text})" if as_factor and binds < _PRODUCT else text


def _text(tree: Expression, names, width: int) -> tuple[str, int]:
    def inside(operand, least: int) -> str:
        text, binds = _text(operand, names, width)
        return text if binds >= least else f"({text})"

    operation, operands = tree.operation, tree.operands
    if operation == "number":
        text = repr(operands[0])
        text = text.removesuffix(".0")
        return text, _ATOM if operands[0] >= 0 and "e" not in text else _SUM
    if operation == "coordinate":
        return names[operands[0]], _ATOM
    if operation == "parameter":
        return names[width + operands[0]], _ATOM
    if operation == "power":
        exponent = repr(operands[1]).removesuffix(".0")
        return f"{inside(operands[0], _ATOM)}**{exponent}", _POWER
    if operation == "+":
        left, right = inside(operands[0], _SUM), inside(operands[1], _SUM)
        return added((left, right)), _SUM
    if operation == "*":
        factor = operands[0].value
        if factor is not None and factor < 0:
            positive = _product(number(-factor), operands[1])
            return f"-{inside(positive, _PRODUCT)}", _SUM
        return f"{inside(operands[0], _PRODUCT)}*{inside(operands[1], _PRODUCT)}", _PRODUCT
    if operation == "/":
        return f"{inside(operands[0], _PRODUCT)}/{inside(operands[1], _POWER)}", _PRODUCT
    return f"{operation}({_text(operands[0], names, width)[0]})", _ATOM


def leaves(tree: Expression) -> Iterator[Expression]:
    """The numbers, coordinates and parameters of an expression, as often as they stand in it."""
    inner = [o for o in tree.operands if isinstance(o, Expression)]
    yield from (leaf for o in inner for leaf in leaves(o)) if inner else (tree,)


def with_leaves(tree: Expression, new: Callable[[Expression], Expression]) -> Expression:
    """An expression with other numbers, coordinates and parameters in place of its own."""
    if not any(isinstance(o, Expression) for o in tree.operands):
        return new(tree)
    inner = (with_leaves(o, new) if isinstance(o, Expression) else o for o in tree.operands)
    return Expression(tree.operation, tuple(inner))


def depends_on(tree: Expression) -> set[int]:
    """Indices of the coordinates in the expression; parameters do not count."""
    return {leaf.operands[0] for leaf in leaves(tree) if leaf.operation == "coordinate"}


def has_parameters(tree: Expression) -> bool:
    """Return whether a parameter is in the expression."""
    return any(leaf.operation == "parameter" for leaf in leaves(tree))


def whole_multiples(tree: Expression) -> tuple[dict[int, int], float] | None:
    """Multiples {i: m} and the number c of a tree Σ m_i z_i + c; None for another tree."""
    operation, operands = tree.operation, tree.operands
    if operation == "number":
        return {}, operands[0]
    if operation == "coordinate":
        return {operands[0]: 1}, 0.0
    if operation == "*":
        m, inner = operands[0].value, whole_multiples(operands[1])
        if m is None or not m.is_integer() or inner is None:
            return None
        return {i: int(m) * k for i, k in inner[0].items()}, m * inner[1]
    if operation == "+":
        left, right = map(whole_multiples, operands)
        if left is not None and right is not None:
            both = {i: left[0].get(i, 0) + right[0].get(i, 0) for i in (*left[0], *right[0])}
            return both, left[1] + right[1]
    return None


def factors_of(tree: Expression) -> dict[Expression, float]:
    """The factors of a product with their exponents, but for numbers."""
    operation, operands = tree.operation, tree.operands
    if operation == "number":
        return {}
    if operation in ("*", "/"):
        found = factors_of(operands[0])
        for base, exponent in factors_of(operands[1]).items():
            sign = 1 if operation == "*" else -1
            found[base] = found.get(base, 0.0) + sign * exponent
        return found
    if operation == "power" and operands[1].is_integer():
        return {base: operands[1] * e for base, e in factors_of(operands[0]).items()}
    return {operands[0]: operands[1]} if operation == "power" else {tree: 1.0}


def product_of(factors: Mapping[Expression, float]) -> Expression:
    """The product of these powers, those of negative exponents as a denominator."""
    above, below = number(1.0), number(1.0)
    for base, exponent in factors.items():
        if exponent > 0:
            above = above * power(base, exponent)
        elif exponent < 0:
            below = below * power(base, -exponent)
    return above / below


def count_operations(tree: Expression) -> int:
    """Count the floating-point operations of the value; a function counts as ten."""
    inner = sum(count_operations(o) for o in tree.operands if isinstance(o, Expression))
    cost = {"number": 0, "coordinate": 0, "parameter": 0, "+": 1, "*": 1, "/": 4, "power": 4}
    return inner + cost.get(tree.operation, 10)
