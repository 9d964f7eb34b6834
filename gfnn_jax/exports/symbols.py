"""Symbols: numbers that record their operations, so that NumPy code run on them becomes C.

Families, charts and domains are written once against the array namespace of their input. On an
object array of symbols, the lines that a fit runs in NumPy record their arithmetic. Products with
zero and sums with zero are left out, a repeated operation is computed once, factors that are
numbers are multiplied beforehand, and a division is a product with the reciprocal: it takes as long
as ten products, and many numbers are divided by the same one. All other operations keep their
order, so that the C code rounds nearly as NumPy does.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

_LONGEST = 90  # characters of an expression that is written where it is used
_SUM, _PRODUCT, _ATOM = range(3)  # how tightly an operation binds
_BINDS = {"+": _SUM, "-": _SUM, "*": _PRODUCT, "/": _PRODUCT}
_ARITHMETIC: dict[str, Callable] = {"+": operator.add, "-": operator.sub, "*": operator.mul}
_ARITHMETIC |= {"/": operator.truediv, "negative": operator.neg}
# NumPy's names of functions, which it calls as methods of objects, and those of C.
FUNCTIONS = {n: n for n in ("cos", "sin", "tan", "exp", "log", "sqrt", "sinh", "cosh", "tanh")}
FUNCTIONS["arctan"] = "atan"


class Symbol:
    """Number of the C function that ``tape`` records: one operation with its operands.

    Operands are symbols or floats. NumPy's object arrays hold symbols.
    """

    __slots__ = ("number", "operands", "operation", "tape")

    def __init__(self, tape: Tape, operation: str, operands: tuple, number: int):
        self.tape, self.operation, self.operands, self.number = tape, operation, operands, number

    def __add__(self, other):
        return _sum(self, other)

    def __radd__(self, other):
        return _sum(other, self)

    def __sub__(self, other):
        return _difference(self, other)

    def __rsub__(self, other):
        return _difference(other, self)

    def __mul__(self, other):
        return _product(self, other)

    def __rmul__(self, other):
        return _product(other, self)

    def __truediv__(self, other):
        if isinstance(other, Symbol):
            return self * self.tape.made("/", 1.0, other)
        return self * (1.0 / other)

    def __rtruediv__(self, other):
        return self.tape.made("/", other, self)

    def __neg__(self):
        negated = self.operation == "negative"
        return self.operands[0] if negated else self.tape.made("negative", self)

    def __abs__(self):
        return self.tape.made("fabs", self)

    def __pow__(self, exponent):
        if exponent in (0, 1):
            return self if exponent else 1.0
        return self * self if exponent == 2 else self.tape.made("pow", self, exponent)

    def clipped(self, low: float, high: float) -> Symbol:
        """Clip this number to [low, high]; NaN stays."""
        return self.tape.made("clip", self, low, high)


for _name, _function in FUNCTIONS.items():
    setattr(Symbol, _name, lambda self, function=_function: self.tape.made(function, self))


def _sum(a, b):
    if not isinstance(a, Symbol) and a == 0:
        return b
    if not isinstance(b, Symbol) and b == 0:
        return a
    tape = a.tape if isinstance(a, Symbol) else b.tape
    if isinstance(b, Symbol) and b.operation == "negative":
        return _difference(a, b.operands[0])
    if isinstance(a, Symbol) and a.operation == "negative":
        return _difference(b, a.operands[0])
    return tape.made("+", a, b)


def _difference(a, b):
    if not isinstance(b, Symbol):
        return _sum(a, -b)
    if not isinstance(a, Symbol) and a == 0:
        return -b
    if b.operation == "negative":
        return _sum(a, b.operands[0])
    return b.tape.made("-", a, b)


def _product(a, b):
    for one, other in ((a, b), (b, a)):
        if not isinstance(one, Symbol) and one in (0, 1, -1):
            return 0.0 if one == 0 else (other if one == 1 else -other)
    if not isinstance(b, Symbol):  # a constant stands first
        a, b = b, a
    if not isinstance(a, Symbol) and b.operation == "*" and not isinstance(b.operands[0], Symbol):
        return _product(a * b.operands[0], b.operands[1])
    return b.tape.made("*", a, b)


class Tape:
    """Operations of one C function, each once, in an order in which they can be computed."""

    def __init__(self):
        self._known: dict[tuple, Symbol] = {}
        self._made: list[Symbol] = []
        self._inputs: dict[str, int] = {}

    def inputs(self, name: str, *shape: int) -> np.ndarray:
        """Declare an input of the function, a C array; return it as an object array (1, *shape)."""
        size = int(np.prod(shape))
        self._inputs[name] = size
        values = [self.made("input", f"{name}[{i}]") for i in range(size)]
        return np.array(values, dtype=object).reshape(1, *shape)

    @property
    def made_so_far(self) -> tuple[Symbol, ...]:
        """List its operations, in their order."""
        return tuple(self._made)

    def made(self, operation: str, *operands: Any) -> Symbol:
        """Return the symbol of this operation, a known one or a new one."""
        operands = tuple(o if isinstance(o, (Symbol, str)) else float(o) for o in operands)
        names = tuple(("t", o.number) if isinstance(o, Symbol) else o for o in operands)
        key = (operation, *sorted(names, key=str)) if operation in "+*" else (operation, *names)
        if key not in self._known:
            self._known[key] = Symbol(self, operation, operands, len(self._made))
            self._made.append(self._known[key])
        return self._known[key]

    def function(self, name: str, outputs: Mapping[str, Any]) -> str:
        """Write ``static void name(inputs, outputs)`` in C; outputs: name -> values, any shape."""
        flat = {n: np.ravel(np.asarray(of, dtype=object)).tolist() for n, of in outputs.items()}
        results = {f"{n}[{i}]": value for n, of in flat.items() for i, value in enumerate(of)}
        sizes = {output: np.size(values) for output, values in outputs.items()}
        given = [f"const double {n}[{size}]" for n, size in self._inputs.items()]
        taken = [f"double {n}[{size}]" for n, size in sizes.items()]
        uses = self._uses(results.values())
        read = [s for s in self._made if s.operation == "input" and s.number in uses]
        used = {s.operands[0].partition("[")[0] for s in read}
        lines = [f"(void)({n});" for n in self._inputs if n not in used] + self.lines(results)
        body = [f"    {line}" for line in lines]
        return "\n".join([f"static void {name}({', '.join([*given, *taken])})", "{", *body, "}\n"])

    def lines(self, results: Mapping[str, Any]) -> list[str]:
        """Write the lines that compute the results, which are named as C assigns to them."""
        uses = self._uses(results.values())
        texts: dict[int, tuple[str, int]] = {}
        lines = []
        for symbol in self._made:
            if symbol.number not in uses:
                continue
            text, binds = _text(symbol, texts)
            inline = uses[symbol.number] == 1 and len(text) <= _LONGEST
            if symbol.operation == "input" or inline:
                texts[symbol.number] = text, binds
            else:
                lines.append(f"const double t{symbol.number} = {text};")
                texts[symbol.number] = f"t{symbol.number}", _ATOM
        return lines + [f"{n} = {_operand(value, texts, _SUM)};" for n, value in results.items()]

    def evaluated(
        self, results: Sequence[Any], inputs: Mapping[str, Any], functions: Mapping[str, Any]
    ) -> list[Any]:
        """Compute the results with numbers of another kind: those of a library, or symbols.

        inputs: name -> numbers, of each input. functions: name in C -> function of these numbers,
        "pow" and "clip" with theirs.
        """
        uses, found = self._uses(results), dict[int, Any]()
        for symbol in self._made:
            if symbol.number not in uses:
                continue
            own, operation = symbol.operands, symbol.operation
            if operation == "input":
                name, _, place = own[0].partition("[")
                found[symbol.number] = inputs[name][int(place[:-1])]
                continue
            values = [found[o.number] if isinstance(o, Symbol) else o for o in own]
            found[symbol.number] = (_ARITHMETIC.get(operation) or functions[operation])(*values)
        return [found[r.number] if isinstance(r, Symbol) else r for r in results]

    def _uses(self, results) -> dict[int, int]:
        """Number of uses of each symbol that the results depend on."""
        uses: dict[int, int] = {}
        ahead = [value for value in results if isinstance(value, Symbol)]
        while ahead:
            symbol = ahead.pop()
            uses[symbol.number] = uses.get(symbol.number, 0) + 1
            if uses[symbol.number] == 1:
                ahead += [o for o in symbol.operands if isinstance(o, Symbol)]
        return uses


def literal(value: Any) -> str:
    """Write a number so that C reads it back, a float64 to the last bit."""
    return repr(float(value))


def table(values) -> str:
    """Write numbers as the initialiser of a C array, four in a line."""
    texts = [literal(v) for v in np.ravel(np.asarray(values)).tolist()]
    lines = [", ".join(texts[i : i + 4]) for i in range(0, len(texts), 4)]
    return "{\n    " + ",\n    ".join(lines) + "\n}"


def _operand(value, texts, least: int) -> str:
    if not isinstance(value, Symbol):
        text = literal(value)
        return f"({text})" if text.startswith("-") and least > _SUM else text
    text, binds = texts[value.number]
    return text if binds >= least else f"({text})"


def _text(symbol: Symbol, texts) -> tuple[str, int]:
    operation, operands = symbol.operation, symbol.operands
    if operation == "input":
        return operands[0], _ATOM
    if operation == "negative":
        return f"-{_operand(operands[0], texts, _ATOM)}", _SUM
    if operation in _BINDS:
        binds = _BINDS[operation]
        left, right = (_operand(o, texts, binds + i) for i, o in enumerate(operands))
        return f"{left}{'*' if operation == '*' else f' {operation} '}{right}", binds
    return f"{operation}({', '.join(_operand(o, texts, _SUM) for o in operands)})", _ATOM
