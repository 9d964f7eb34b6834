"""Floating-point operations of a compiled function, counted in its program.

The count is the same on every machine and whatever else it does, so that a training that it bounds
ends at the same iteration.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

# A number that is no sum of products takes as long as so many of these, memory and transcendental
# functions included; an operation on arrays at least as long as so many. With both, trainings of
# eight kinds of networks count 3e10 to 6e10 in a second of one core.
EACH, LEAST = 10.0, 5_000.0


def operations_of(jaxpr: Any) -> float:
    """Operations of a run of this program: two for each product that a contraction adds up, EACH
    for every number that another operation makes, LEAST at least; those of a scan as often as it
    runs. Of a while loop, whose length the data decide, one turn is counted."""
    return sum(_of_equation(equation) for equation in jaxpr.eqns)


def _of_equation(equation: Any) -> float:
    inner = sum(map(operations_of, _inner(equation)))
    if inner:
        return inner * equation.params.get("length", 1)
    made = sum(math.prod(variable.aval.shape) for variable in equation.outvars)
    if equation.primitive.name == "dot_general":
        (contracted, _), _ = equation.params["dimension_numbers"]
        shape = equation.invars[0].aval.shape
        return max(2.0 * made * math.prod(shape[axis] for axis in contracted), LEAST)
    return max(EACH * made, LEAST)


def _inner(equation: Any) -> Iterator[Any]:
    """Programs that an operation runs: the body of a scan, a jitted function."""
    for value in equation.params.values():
        for part in value if isinstance(value, (tuple, list)) else (value,):
            part = getattr(part, "jaxpr", part)
            if hasattr(part, "eqns"):
                yield part
