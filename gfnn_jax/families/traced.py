"""Python functions of a state as expressions: JAX traces them once, their jaxpr runs on trees."""

from collections.abc import Callable

import numpy as np

from gfnn_jax.errors import InputError
from gfnn_jax.families.expressions import (
    Expression,
    as_expression,
    call,
    coordinate,
    number,
    power,
)
from gfnn_jax.families.functions import known_functions


def traced(function: Callable, dim: int) -> list[Expression]:
    """Trace ``function(z)``, z (2d,), a scalar or a vector, into expressions, one per entry.

    Raises InputError where the function uses an operation that has no expression here, or branches
    on its values.
    """
    import jax

    z = jax.ShapeDtypeStruct((2 * dim,), np.float64)
    closed = jax.make_jaxpr(function)(z)
    symbols = np.array([coordinate(i) for i in range(2 * dim)], dtype=object)
    results = _run(closed.jaxpr, closed.consts, [symbols])
    return [tree for out in results for tree in np.ravel(_trees(out)).tolist()]


def traced_pieces(functions: Callable) -> list[Expression]:
    """Trace ``functions(x)``, several of one number x, into expressions of the coordinate 0, which
    may have pieces: nodes ">" (1 or 0), "max" and "select" (by a condition, of two).

    Raises InputError where a function uses an operation that has no expression here.
    """
    import jax

    closed = jax.make_jaxpr(functions)(jax.ShapeDtypeStruct((), np.float64))
    x = np.asarray(coordinate(0), dtype=object)
    results = _run(closed.jaxpr, closed.consts, [x], _ELEMENTWISE | _PIECES)
    return [_trees(out).item() for out in results]


_ELEMENTWISE: dict[str, Callable] = {
    "add": lambda a, b: a + b,
    "add_any": lambda a, b: a + b,
    "sub": lambda a, b: a - b,
    "mul": lambda a, b: a * b,
    "div": lambda a, b: a / b,
    "neg": lambda a: -a,
    "square": lambda a: power(a, 2),
    "rsqrt": lambda a: 1.0 / call("sqrt", a),
    "sqrt": lambda a: power(a, 0.5),
    "atan": lambda a: call("arctan", a),
    "copy": lambda a: a,
    "copy_p": lambda a: a,
    "stop_gradient": lambda a: a,
    **{name: (lambda a, name=name: call(name, a)) for name in known_functions() if name != "sqrt"},
}
_PIECES: dict[str, Callable] = {
    "gt": lambda a, b: Expression(">", (a, b)),
    "lt": lambda a, b: Expression(">", (b, a)),
    "ge": lambda a, b: 1.0 - Expression(">", (b, a)),
    "le": lambda a, b: 1.0 - Expression(">", (a, b)),
    "max": lambda a, b: Expression("max", (a, b)),
    "min": lambda a, b: -Expression("max", (-a, -b)),
    "sign": lambda a: Expression(">", (a, number(0))) - Expression(">", (number(0), a)),
    "select_n": lambda which, no, yes: Expression("select", (which, yes, no)),
    "log1p": lambda a: call("log", 1.0 + a),
    "expm1": lambda a: call("exp", a) - 1.0,
    "logistic": lambda a: 1.0 / (1.0 + call("exp", -a)),
}
_MOVED = ("slice", "squeeze", "reshape", "broadcast_in_dim", "transpose", "rev")
_REARRANGE = (*_MOVED, "gather", "dynamic_slice", "expand_dims")


def _trees(values):
    """Convert an array of numbers or expressions into an object array of expressions."""
    values = np.asarray(values, dtype=object)
    return _elementwise(as_expression, values) if values.size else values


def _run(jaxpr, constants, arguments, elementwise=_ELEMENTWISE) -> list:
    """Evaluate a jaxpr on object arrays of expressions; integers stay numbers."""
    known: dict = dict(zip(jaxpr.constvars, map(np.asarray, constants), strict=True))
    known.update(zip(jaxpr.invars, arguments, strict=True))

    def read(atom):
        return np.asarray(atom.val) if hasattr(atom, "val") else known[atom]

    for equation in jaxpr.eqns:
        values = [read(atom) for atom in equation.invars]
        results = _applied(equation.primitive, equation.params, values, elementwise)
        known.update(zip(equation.outvars, map(np.asarray, results), strict=True))
    return [read(atom) for atom in jaxpr.outvars]


def _applied(primitive, params, values, elementwise) -> list:
    import jax

    name = primitive.name
    inner = params.get("jaxpr", params.get("call_jaxpr"))
    if inner is not None and hasattr(inner, "jaxpr"):
        return _run(inner.jaxpr, inner.consts, values, elementwise)
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
    if name in elementwise:
        return [_elementwise(elementwise[name], *values)]
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
        f"constant powers and {', '.join(known_functions())}"
    )


def _elementwise(function, *values):
    return np.asarray(np.frompyfunc(function, len(values), 1)(*values), dtype=object)
