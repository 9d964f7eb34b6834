"""Expressions in the coordinates of a state: trees made of text or of a Python function.

Text is parsed with `ast` against a list of allowed names; nothing is ever evaluated as code, so
that a term a user gives is data. A Python function is traced by JAX, once, into the same tree.
Values and first and second derivatives are those of truncated Taylor arithmetic: the same lines
compute in NumPy and are traced by JAX.
"""

from __future__ import annotations

import ast
import dataclasses
import keyword
import math
import operator
import re
from collections.abc import Callable, Sequence
from functools import cache, cached_property, reduce
from typing import Any

import numpy as np

from gfnn_jax.arrays import as_row, namespace
from gfnn_jax.errors import InputError

_LONGEST_TEXT, _DEEPEST = 2_000, 60


def _squared(xp, v):
    return v * v


# name -> f, f', f'' of a value v with f(v) = y: functions of (xp, v, y).
_FUNCTIONS: dict[str, tuple[Callable, Callable, Callable]] = {
    "tan": (
        lambda xp, v: xp.tan(v),
        lambda xp, v, y: 1 + y * y,
        lambda xp, v, y: 2 * y * (1 + y * y),
    ),
    "exp": (lambda xp, v: xp.exp(v), lambda xp, v, y: y, lambda xp, v, y: y),
    "log": (lambda xp, v: xp.log(v), lambda xp, v, y: 1 / v, lambda xp, v, y: -1 / (v * v)),
    "sqrt": (
        lambda xp, v: xp.sqrt(v),
        lambda xp, v, y: 0.5 / y,
        lambda xp, v, y: -0.25 / (y * v),
    ),
    "sinh": (lambda xp, v: xp.sinh(v), lambda xp, v, y: xp.cosh(v), lambda xp, v, y: y),
    "cosh": (lambda xp, v: xp.cosh(v), lambda xp, v, y: xp.sinh(v), lambda xp, v, y: y),
    "tanh": (
        lambda xp, v: xp.tanh(v),
        lambda xp, v, y: 1 - y * y,
        lambda xp, v, y: -2 * y * (1 - y * y),
    ),
    "arctan": (
        lambda xp, v: xp.arctan(v),
        lambda xp, v, y: 1 / (1 + v * v),
        lambda xp, v, y: -2 * v / _squared(xp, 1 + v * v),
    ),
}  # fmt: skip
_CHEBYSHEV = re.compile(r"T\d{1,2}")
_CIRCULAR = ("sin", "cos")  # which share their values
FUNCTIONS = (*_CIRCULAR, *_FUNCTIONS)
_OTHER_NAMES = {"atan": "arctan", "ln": "log"}
_CONSTANTS = {"pi": math.pi, "e": math.e}


@dataclasses.dataclass(frozen=True, eq=True)
class Expression:
    """A node: ``operation`` with its ``operands``.

    "number" holds a float, "coordinate" an index of z, "parameter" one of the args, "power" a base
    and a float; "+", "*", "/" have two nodes, the name of a function one, as has "T3", a Chebyshev
    polynomial.
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
        """The number that a constant is, else None."""
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
    """q1..qd, p1..pd."""
    return tuple(f"{letter}{i + 1}" for letter in "qp" for i in range(dim))


def check_names(dim: int, names: Sequence[str]) -> None:
    """Raises InputError where parameters of these names could not stand in an expression."""
    taken = {*coordinate_names(dim), *FUNCTIONS, *_OTHER_NAMES, "q", "p", "t"}
    for name in names:
        if not name.isidentifier() or keyword.iskeyword(name):
            raise InputError(f"expected letters, digits and _ as a parameter's name, got '{name}'")
        if name in taken or _CHEBYSHEV.fullmatch(name):
            raise InputError(
                f"expected a name for a parameter that has no meaning yet, got '{name}'"
            )


@cache
def parse(text: str, dim: int, parameters: tuple[str, ...] = ()) -> Expression:
    """The tree of an expression in q1..qd, p1..pd (q, p where d = 1) and the parameters.

    Raises InputError, in one line, for anything but numbers, + - * / **, the coordinates and the
    functions of the list.
    """
    if len(text) > _LONGEST_TEXT:
        raise InputError(f"expected a term of at most {_LONGEST_TEXT} characters, got {len(text)}")
    names = {name: coordinate(i) for i, name in enumerate(coordinate_names(dim))}
    if dim == 1:
        names.update(q=coordinate(0), p=coordinate(1))
    names.update({name: parameter(i) for i, name in enumerate(parameters)})
    try:
        tree = ast.parse(text.strip(), mode="eval").body
        return _parsed(tree, names, text, 0)
    except (SyntaxError, ValueError, RecursionError, MemoryError, OverflowError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"the term '{text}' is no expression: {error}") from None


def _parsed(node, names, text, depth) -> Expression:
    def refuse(what: str) -> InputError:
        return InputError(
            f"the term '{text}' has {what}: expected numbers, + - * / **, "
            f"{', '.join(names)} and {', '.join(FUNCTIONS)}"
        )

    def inner(child) -> Expression:
        return _parsed(child, names, text, depth + 1)

    if depth > _DEEPEST:
        raise refuse(f"more than {_DEEPEST} levels")
    value = node.value if isinstance(node, ast.Constant) else None
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        if not math.isfinite(value):
            raise refuse("a number that is beyond float64")
        return number(value)
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
        name = _OTHER_NAMES.get(name, name)
        known = name in FUNCTIONS or _CHEBYSHEV.fullmatch(name)
        if not known or node.keywords or len(node.args) != 1:
            raise refuse(f"a call of '{ast.unparse(node.func)}' with {len(node.args)} arguments")
        return call(name, inner(node.args[0]))
    if isinstance(node, ast.BinOp):
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


_SUM, _PRODUCT, _POWER, _ATOM = range(4)


def to_text(tree: Expression, dim: int, parameters: tuple[str, ...] = ()) -> str:
    """The tree as text that `parse` reads back, every number to its last digit."""
    return _text(tree, (*coordinate_names(dim), *parameters), 2 * dim)[0]


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
        return (f"{left} - {right[1:]}" if right.startswith("-") else f"{left} + {right}"), _SUM
    if operation == "*":
        factor = operands[0].value
        if factor is not None and factor < 0:
            positive = _product(number(-factor), operands[1])
            return f"-{inside(positive, _PRODUCT)}", _SUM
        return f"{inside(operands[0], _PRODUCT)}*{inside(operands[1], _PRODUCT)}", _PRODUCT
    if operation == "/":
        return f"{inside(operands[0], _PRODUCT)}/{inside(operands[1], _POWER)}", _PRODUCT
    return f"{operation}({_text(operands[0], names, width)[0]})", _ATOM


def depends_on(tree: Expression) -> set[int]:
    """Indices of the coordinates that the expression holds; parameters are none."""
    if tree.operation == "coordinate":
        return {tree.operands[0]}
    return set().union(*(depends_on(o) for o in tree.operands if isinstance(o, Expression)))


def count_operations(tree: Expression) -> int:
    """Floating-point operations of its value, a function counted as ten."""
    inner = sum(count_operations(o) for o in tree.operands if isinstance(o, Expression))
    cost = {"number": 0, "coordinate": 0, "parameter": 0, "+": 1, "*": 1, "/": 4, "power": 4}
    return inner + cost.get(tree.operation, 10)


# Values and derivatives.


@dataclasses.dataclass(frozen=True)
class Jet:
    """An expression's value, its slopes {i: ∂/∂z_i} and curvatures {(i, j): ∂²/∂z_i∂z_j}, i ≤ j,
    those that are not identically zero; each an array of the lanes' shape, or a number."""

    value: Any
    slope: dict[int, Any]
    curvature: dict[tuple[int, int], Any]


def jets(trees: Sequence[Expression], w, order: int, args=None) -> list[Jet]:
    """The expressions at states w (..., 2d), with derivatives in w up to ``order`` (0, 1, 2). args:
    the parameters' values (k,) or, for lanes of w, (..., k)."""
    known: dict[Any, Any] = {}
    if args is not None:
        for i in range(args.shape[-1]):
            known[parameter(i)] = Jet(as_row(args[..., i], w[..., 0]), {}, {})
    return [_jet(tree, w, order, known) for tree in trees]


def _jet(tree: Expression, w, order: int, known) -> Jet:
    if tree not in known:
        known[tree] = _jet_of(tree, w, order, known)
    return known[tree]


def _jet_of(tree: Expression, w, order, known) -> Jet:
    xp = namespace(w)
    operation, operands = tree.operation, tree.operands
    if operation == "number":
        return Jet(operands[0], {}, {})
    if operation == "coordinate":
        return Jet(w[..., operands[0]], {operands[0]: 1.0} if order else {}, {})
    if operation == "parameter":
        raise ValueError("expected the values of the parameters (args), got none")
    first = _jet(operands[0], w, order, known)
    if _CHEBYSHEV.fullmatch(operation):
        return _chebyshev(first, operands[0], int(operation[1:]), order, known)
    if operation == "power":
        return _composed(first, order, *_power_derivatives(xp, first.value, operands[1], order))
    if operation in _CIRCULAR:
        cos, sin = _circle(*_multiple(operands[0]), w, order, known)
        y, slope = (sin, cos) if operation == "sin" else (cos, -sin)
        return _composed(first, order, y, slope, -y if order > 1 else 0.0)
    if operation in _FUNCTIONS:
        f, df, ddf = _FUNCTIONS[operation]
        v = first.value if not isinstance(first.value, float) else xp.asarray(first.value)
        y = f(xp, v)
        return _composed(
            first, order, y, df(xp, v, y) if order else 0.0, ddf(xp, v, y) if order > 1 else 0.0
        )
    second = _jet(operands[1], w, order, known)
    if operation == "+":
        return Jet(
            first.value + second.value,
            _added(first.slope, second.slope), _added(first.curvature, second.curvature),
        )  # fmt: skip
    if operation == "/":
        inverse = 1.0 / second.value
        slope = -inverse * inverse if order else 0.0
        curvature = -2 * slope * inverse if order > 1 else 0.0
        second = _composed(second, order, inverse, slope, curvature)
    return _multiplied(first, second, order)


def _chebyshev(x: Jet, part: Expression, n: int, order: int, known) -> Jet:
    """T_n(x) of the jet x of an expression: T_n = 2x T_n−1 − T_n−2."""
    if n < 2:
        return x if n else Jet(1.0, {}, {})
    if ("T", part, n) not in known:
        last, before = (_chebyshev(x, part, k, order, known) for k in (n - 1, n - 2))
        twice = _multiplied(Jet(2.0, {}, {}), _multiplied(x, last, order), order)
        less = _multiplied(Jet(-1.0, {}, {}), before, order)
        known["T", part, n] = Jet(
            twice.value + less.value,
            _added(twice.slope, less.slope), _added(twice.curvature, less.curvature),
        )  # fmt: skip
    return known["T", part, n]


def _circle(part: Expression, n: int, w, order: int, known):
    """cos and sin of n times an expression: of a multiple by products of those of smaller ones."""
    if (part, n) not in known:
        if n > 1:
            c, s = _circle(part, n // 2, w, order, known)
            d, t = _circle(part, n - n // 2, w, order, known)
            known[part, n] = c * d - s * t, s * d + c * t
        else:
            xp, v = namespace(w), _jet(part, w, order, known).value
            v = xp.asarray(v) if isinstance(v, float) else v
            known[part, n] = xp.cos(v), xp.sin(v)
    return known[part, n]


@cache
def _multiple(tree: Expression) -> tuple[Expression, int]:
    """(part, n) with tree = n · part, n the greatest common divisor of a sum of whole multiples of
    coordinates; (tree, 1) for anything else."""
    found = _whole_multiples(tree)
    if not found or (n := math.gcd(*found.values())) < 2:
        return tree, 1
    parts = [coordinate(i) * (m // n) for i, m in sorted(found.items())]
    return reduce(operator.add, parts), n


def _whole_multiples(tree: Expression) -> dict[int, int] | None:
    """{i: m} of Σ m_i z_i, None for another tree."""
    operation, operands = tree.operation, tree.operands
    if operation == "coordinate":
        return {operands[0]: 1}
    if operation == "*":
        m, inner = operands[0].value, _whole_multiples(operands[1])
        if m is None or not m.is_integer() or inner is None:
            return None
        return {i: int(m) * k for i, k in inner.items()}
    if operation == "+":
        left, right = (_whole_multiples(o) for o in operands)
        if left is not None and right is not None and not left.keys() & right.keys():
            return left | right
    return None


def _power_derivatives(xp, v, exponent: float, order: int):
    whole = exponent == int(exponent) and abs(exponent) <= 32

    def raised(k: float):
        return _whole_power(v, int(k)) if whole else v**k

    if whole and exponent == 2:
        return v * v, 2 * v, 2.0
    return (
        raised(exponent),
        exponent * raised(exponent - 1) if order else 0.0,
        exponent * (exponent - 1) * raised(exponent - 2) if order > 1 else 0.0,
    )


def _whole_power(v, k: int):
    if k < 0:
        return 1.0 / _whole_power(v, -k)
    if k == 0:
        return 1.0
    half = _whole_power(v, k // 2)
    square = half * half
    return square * v if k % 2 else square


def _added(a: dict, b: dict) -> dict:
    return {k: a[k] + b[k] if k in a and k in b else a.get(k, b.get(k)) for k in {**a, **b}}


def _composed(inner: Jet, order, value, slope, curvature) -> Jet:
    """f(inner), f's value, slope and curvature there."""
    slopes = {i: slope * s for i, s in inner.slope.items()} if order else {}
    if order < 2:
        return Jet(value, slopes, {})
    bent = {k: slope * c for k, c in inner.curvature.items()}
    outer = {
        (i, j): curvature * a * b
        for i, a in inner.slope.items() for j, b in inner.slope.items() if i <= j
    }  # fmt: skip
    return Jet(value, slopes, _added(bent, outer))


def _multiplied(a: Jet, b: Jet, order) -> Jet:
    def scaled(entries, factor):
        return {k: factor * v for k, v in entries.items()}

    slopes = _added(scaled(a.slope, b.value), scaled(b.slope, a.value)) if order else {}
    if order < 2:
        return Jet(a.value * b.value, slopes, {})
    mixed: dict = {}
    for i, left in a.slope.items():
        for j, right in b.slope.items():
            entry = {(min(i, j), max(i, j)): (2.0 if i == j else 1.0) * left * right}
            mixed = _added(mixed, entry)
    curvature = _added(scaled(a.curvature, b.value), scaled(b.curvature, a.value))
    return Jet(a.value * b.value, slopes, _added(curvature, mixed))


# A Python function of z (2d,) as trees.


def traced(function: Callable, dim: int) -> list[Expression]:
    """The trees of ``function(z)``, z (2d,), a scalar or a vector made by JAX or by plain
    arithmetic.

    Raises InputError where the function branches on its values or uses what has no tree here.
    """
    import jax

    z = jax.ShapeDtypeStruct((2 * dim,), np.float64)
    closed = jax.make_jaxpr(function)(z)
    symbols = np.array([coordinate(i) for i in range(2 * dim)], dtype=object)
    results = _run(closed.jaxpr, closed.consts, [symbols])
    return [tree for out in results for tree in np.ravel(_trees(out)).tolist()]


_ELEMENTWISE: dict[str, Callable] = {
    "add": lambda a, b: a + b, "add_any": lambda a, b: a + b, "sub": lambda a, b: a - b,
    "mul": lambda a, b: a * b, "div": lambda a, b: a / b, "neg": lambda a: -a,
    "square": lambda a: power(a, 2), "rsqrt": lambda a: 1.0 / call("sqrt", a),
    "sqrt": lambda a: power(a, 0.5), "atan": lambda a: call("arctan", a),
    "copy": lambda a: a, "copy_p": lambda a: a, "stop_gradient": lambda a: a,
    **{name: (lambda a, name=name: call(name, a)) for name in FUNCTIONS if name != "sqrt"},
}  # fmt: skip
_REARRANGE = {
    "slice", "squeeze", "reshape", "broadcast_in_dim", "transpose", "rev", "gather",
    "dynamic_slice", "expand_dims",
}  # fmt: skip


def _trees(values):
    """An object array of expressions of an array of numbers or expressions."""
    values = np.asarray(values, dtype=object)
    return _elementwise(as_expression, values) if values.size else values


def _run(jaxpr, constants, arguments) -> list:
    """The results of a jaxpr on object arrays of expressions; integers stay numbers."""
    known: dict = dict(zip(jaxpr.constvars, map(np.asarray, constants), strict=True))
    known.update(zip(jaxpr.invars, arguments, strict=True))

    def read(atom):
        return np.asarray(atom.val) if hasattr(atom, "val") else known[atom]

    for equation in jaxpr.eqns:
        values = [read(atom) for atom in equation.invars]
        results = _applied(equation.primitive, equation.params, values)
        known.update(zip(equation.outvars, map(np.asarray, results), strict=True))
    return [read(atom) for atom in jaxpr.outvars]


def _applied(primitive, params, values) -> list:
    import jax

    name = primitive.name
    inner = params.get("jaxpr", params.get("call_jaxpr"))
    if inner is not None and hasattr(inner, "jaxpr"):
        return _run(inner.jaxpr, inner.consts, values)
    if all(v.dtype != object for v in values):  # numbers only
        with jax.enable_x64(True):
            out = primitive.bind(*values, **params)
        return [np.asarray(o) for o in (out if primitive.multiple_results else [out])]
    if name == "convert_element_type":
        return values
    if name in _REARRANGE:
        place = np.arange(values[0].size).reshape(values[0].shape)
        moved = np.asarray(primitive.bind(place, *values[1:], **params))
        return [values[0].ravel()[moved]]
    if name == "concatenate":
        return [np.concatenate([_trees(v) for v in values], axis=params["dimension"])]
    values = [_trees(v) for v in values]
    if name == "stack":
        return [np.stack(values, axis=params["axis"])]
    if name in _ELEMENTWISE:
        return [_elementwise(_ELEMENTWISE[name], *values)]
    if name == "integer_pow":
        return [_elementwise(lambda a: power(a, params["y"]), *values)]
    if name == "pow":
        exponents = {e.value for e in values[1].ravel().tolist()}
        if len(exponents) == 1 and None not in exponents:
            return [_elementwise(lambda a: power(a, exponents.copy().pop()), values[0])]
    if name == "reduce_sum":
        return [np.sum(values[0], axis=tuple(params["axes"]))]
    if name == "dot_general":
        contract, batch = params["dimension_numbers"]
        if not any(batch):
            return [np.tensordot(*values, axes=contract)]
    raise InputError(
        f"a term uses '{name}', which has no formula here: expected sums, products, quotients, "
        f"constant powers and {', '.join(FUNCTIONS)}"
    )


def _elementwise(function, *values):
    return np.asarray(np.frompyfunc(function, len(values), 1)(*values), dtype=object)
