"""A law as a plain JAX function in a file of its own, which needs nothing of this package.

The step is the map's: Gauss collocation of as many stages and substeps. Its stages are solved by
Newton's method, whose last iteration carries the derivative of the implicit function, forward and
backward.
"""

import re
from collections.abc import Mapping
from typing import Any

from gfnn_jax.exports.graph import LawGraph, graph_of
from gfnn_jax.exports.symbols import FUNCTIONS, Tape
from gfnn_jax.flows.gauss import gauss
from gfnn_jax.maps.symplectic_map import SymplecticMap

IN_NUMPY = {own: name for name, own in FUNCTIONS.items()}  # of functions of C
IN_NUMPY |= {"fabs": "abs", "pow": "power", "clip": "clip", "sign": "sign"}


def rates_of(graph: LawGraph, inputs: Mapping[str, Any], functions: Mapping[str, Any]) -> list[Any]:
    """The rates with numbers of another kind, friction of a kink by the signs of its speeds."""
    inputs = {"sigma": (), **inputs}
    speeds = graph.tape.evaluated(graph.speeds, inputs, functions)
    inputs["sigma"] = [functions["sign"](speed) for speed in speeds]
    return graph.tape.evaluated(graph.rates, inputs, functions)


def rates_on_tape(graph: LawGraph) -> tuple[Tape, list[Any]]:
    """The rates on a tape of their own, whose inputs are z, u and p."""
    tape = Tape()
    sizes = {"z": len(graph.rates), "u": len(graph.arguments), "p": len(graph.values)}
    inputs = {name: tape.inputs(name, max(size, 1))[0] for name, size in sizes.items()}
    functions = {own: (lambda *a, own=own: tape.made(own, *a)) for own in IN_NUMPY}
    return tape, rates_of(graph, inputs, functions)


def jax_source(map_: SymplecticMap, name: str, about: Mapping[str, Any]) -> str:
    """Write a module with ``step(z, u, p, h)`` and ``rates(z, u, p)``, z (2d,) = (q, p).

    u: parameters, the time of a drive, inputs and the coefficients of τ, τ², … of these, as
    ``map.step`` has them; p: the coefficients of the law, by default as learned; h: the time, by
    default dt. Dry friction is smoothed, as under ``jit`` in this package. Raises InputError for a
    map without a law, or with one that is no formula.
    """
    graph, piece = graph_of(map_, sharp=False), map_.pieces[0]
    tape, found = rates_on_tape(graph)
    lines = tape.lines({f"r{i}": rate for i, rate in enumerate(found)})
    lines = (line.removeprefix("const double ").removesuffix(";") for line in lines)
    named = (re.sub(r"\b([a-z]+)\(", lambda n: f"jnp.{IN_NUMPY[n[1]]}(", line) for line in lines)
    body = "\n".join(f"    {line}" for line in named)
    rule = gauss(piece.stages)
    comment = "\n".join(f"{key}: {value}" for key, value in about.items())
    tables = {"COUPLING": rule.coupling, "WEIGHTS": rule.weights, "NODES": rule.nodes}
    tables |= {"SCALE": graph.scale, "COEFFICIENTS": graph.values}
    numbers = "\n".join(f"{key} = np.array({value.tolist()})" for key, value in tables.items())
    # u as the graph has it: the polynomials of inputs at a time τ, and the time of a drive.
    at_time = [
        " + ".join(f"u[{place}]" + (f"*t**{n}" if n else "") for n, place in enumerate(places))
        + (" + t" if graph.time == i else "")
        for i, places in enumerate(graph.series)
    ]
    return f'''\
"""Law {name} of a motion: step(z, u, p, h) is z = (q, p) a time h later.

z: {", ".join(graph.names)}; u: {", ".join(graph.arguments) or "nothing"}.
p: the coefficients of {", ".join(graph.terms)}.

{comment}
"""

import jax
import jax.numpy as jnp
import numpy as np

DT, SUBSTEPS = {graph.dt!r}, {piece.substeps}
{numbers}


def rates(z, u=(), p=COEFFICIENTS):
    """dz/dt (2d,) of a state (2d,)."""
{body}
    return jnp.stack([{", ".join(f"jnp.asarray(r{i}, z.dtype)" for i in range(len(found)))}])


def at_time(u, t):
    """u a time t after a step began."""
    return jnp.array([{", ".join(at_time)}], float)


def step(z, u=(), p=COEFFICIENTS, h=DT):
    """z a time h later, (2d,): for jit, vmap, jvp and grad. Float64 has to be switched on."""
    h = h / SUBSTEPS
    weights = jnp.asarray(h * WEIGHTS, z.dtype)[:, None]

    def substep(n, z):
        inputs = jax.vmap(at_time, (None, 0))(u, (n + NODES) * h)

        def residual(stages):
            inside = z[None] + jnp.matmul(COUPLING, stages, precision="highest")
            return stages - weights * jax.vmap(rates, (0, 0, None))(inside, inputs, p)

        def newton(stages):
            matrix = jax.jacfwd(residual)(stages).reshape(stages.size, stages.size)
            matrix = jax.lax.stop_gradient(matrix)
            moved = jnp.linalg.solve(matrix, residual(stages).ravel())
            return stages - moved.reshape(stages.shape)

        def goes_on(carried):
            stages, change, count = carried
            return (change > 1e-12) & (count < 30)

        def iterate(carried):
            stages, _, count = carried
            new = newton(stages)
            return new, jnp.max(jnp.abs(new - stages) / (jnp.abs(z) + SCALE)[None]), count + 1

        begun = weights * rates(z, inputs[0], p)[None]
        stages = jax.lax.stop_gradient(
            jax.lax.while_loop(goes_on, iterate, jax.lax.stop_gradient((begun, jnp.inf, 0)))[0]
        )
        return z + jnp.sum(newton(stages), axis=0)

    count = jnp.arange(SUBSTEPS, dtype=z.dtype)
    return jax.lax.scan(lambda z, n: (substep(n, z), None), z, count)[0]
'''
