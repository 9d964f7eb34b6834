"""Args of a map in C, which follow the state: parameters, the time of a drive, inputs.

Inputs are polynomials in the time since a step began (`maps.inputs`).
"""

from __future__ import annotations

import numpy as np

from gfnn_jax.exports.c_pieces import moves_args
from gfnn_jax.exports.symbols import literal, table
from gfnn_jax.maps.inputs import Signals
from gfnn_jax.maps.symplectic_map import SymplecticMap


def num_args(map_: SymplecticMap) -> int:
    parameters = 0 if map_.parameters is None else len(map_.parameters.names)
    return parameters + (0 if map_.signals is None else _num_coefficients(map_.signals))


def _num_coefficients(signals: Signals) -> int:
    return (signals.degree + 1) * len(signals.names)


def args_after(map_: SymplecticMap) -> list[str]:
    """Lines that move the args in y from a step's begin to its end, where the inverse begins."""
    width, more, dt = 2 * map_.dim, num_args(map_), float(map_.dt)
    if map_.parameters is not None and map_.parameters.period is not None:
        names, period = map_.parameters.names, float(map_.parameters.period)
        later = map_.parameters.after(np.zeros((1, len(names))), 1, dt)[0, -1]
        time = f"y[{width + len(names) - 1}]"
        return [f"{time} = fmod({time} + {literal(later)}, {literal(period)});"]
    if map_.signals is not None and moves_args(map_.pieces[0], more):
        return [
            f"const double after = {literal(dt)};",
            f"piece0_later(args, &after, y + {width});",
        ]
    return []


def of_samples(map_: SymplecticMap) -> bool:
    """Return whether the args of inputs are more than their values at the step's begin."""
    if map_.signals is None:
        return False
    first, weights = map_.signals.stencil(float(map_.dt))
    return first != 0 or weights.shape != (1, 1)


def inputs_of_samples(map_: SymplecticMap, name: str) -> str:
    """Write the function that makes the coefficients of a step's inputs of their samples."""
    signals = map_.signals
    assert signals is not None
    first, weights = signals.stencil(float(map_.dt))
    count, (rows, columns) = len(signals.names), weights.shape
    return f"""\
{_of_inputs(name, signals)}
{{
    static const double weights[{weights.size}] = {table(weights)};
    for (int j = 0; j < {rows}; j++)
        for (int k = 0; k < {count}; k++) {{
            double sum = 0.0;
            for (int n = 0; n < {columns}; n++)
                sum += weights[j*{columns} + n]*u[(n + ({first}))*{count} + k];
            coefficients[j*{count} + k] = sum;
        }}
}}
"""


def inside_ranges(map_: SymplecticMap) -> list[str]:
    """Lines that let ``inside`` be true only where the args in y are in the ranges of the data."""
    if map_.parameters is None:
        return []
    low, high = map_.parameters.bounds
    given, lines = [f"y[{2 * map_.dim + k}]" for k in range(len(low))], []
    if map_.parameters.period is not None:
        time, period = given[-1], literal(float(map_.parameters.period))
        turns = f"floor(({time} - {literal(low[-1])})/{period})"
        lines = [f"const double phase = {time} - {turns}*{period};"]
        given[-1] = "phase"
    return lines + [
        f"inside = inside && {value} >= {literal(a)} && {value} <= {literal(b)};"
        for value, a, b in zip(given, low, high, strict=True)
    ]


def about_args(map_: SymplecticMap, name: str) -> str:
    """Write what the comment at the top says about the args."""
    comment, parameters = "", map_.parameters
    if parameters is not None:
        ranges = ", ".join(
            f"{n} from {low:.6g} to {high:.6g}"
            for n, low, high in zip(parameters.names, parameters.low, parameters.high, strict=True)
        )
        comment = f"\n   args = ({', '.join(parameters.names)}), in the data {ranges}."
        if parameters.period is not None:
            comment += (
                f"\n   {parameters.names[-1]}: the time of the drive at z, of the step and of its "
                f"inverse; period {float(parameters.period):.6g}."
            )
    return comment if map_.signals is None else comment + _about_inputs(map_, name)


def _about_inputs(map_: SymplecticMap, name: str) -> str:
    """Write what the comment says about inputs."""
    signals = map_.signals
    assert signals is not None
    named, count = ", ".join(signals.names), _num_coefficients(signals)
    if not of_samples(map_):
        return f"\n   The last {count} of args: the inputs {named} during the step."
    first, weights = signals.stencil(float(map_.dt))
    return f"""
   The last {count} of args: the inputs {named} as polynomials in the time since
   the step began, the coefficients of 1 first. They are made of samples a step apart by

       {_of_inputs(name, signals)};

   u: the sample at the step's begin, {len(signals.names)} number(s) each, of which {-first} stand
   before it and {first + weights.shape[1] - 1} behind it."""


def _of_inputs(name: str, signals: Signals) -> str:
    return f"void {name}_inputs(const double *u, double coefficients[{_num_coefficients(signals)}])"
