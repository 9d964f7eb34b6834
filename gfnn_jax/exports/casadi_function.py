"""A law as a CasADi function, for optimal control: the home of CasADi, an extra."""

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from gfnn_jax.errors import InputError
from gfnn_jax.exports.graph import graph_of
from gfnn_jax.exports.jax_source import IN_NUMPY, rates_of
from gfnn_jax.flows.gauss import gauss
from gfnn_jax.maps.symplectic_map import SymplecticMap

_FLOOR = 1e-12  # of the stages' residual, relative to scales: two more iterations reach roundoff


def casadi_function(map_: SymplecticMap, name: str, about: Mapping[str, Any]) -> bytes:
    """Serialise the step of a map as a CasADi function, which ``casadi.Function.load`` reads.

    Its inputs are z (2d,) = (q, p), u as `exports.jax_source` has it, ``dp``, what is added to the
    coefficients as learned, by default 0, and h, by default dt; its output is Z: the map's Gauss
    collocation, by CasADi's Newton, which differentiates the implicit function. Dry friction is
    smoothed. Raises InputError without CasADi, for a map without a law,
    or with one that is no formula. about: is not held by the format.
    """
    try:
        import casadi  # an extra
    except ImportError:
        raise InputError("expected CasADi: pip install 'gfnn-jax[machines]'") from None
    graph, piece = graph_of(map_, sharp=False), map_.pieces[0]
    rule, width = gauss(piece.stages), len(graph.rates)
    functions = {own: getattr(casadi, other, None) for own, other in IN_NUMPY.items()}
    functions["fabs"] = casadi.fabs
    functions["clip"] = lambda x, low, high: casadi.fmin(casadi.fmax(x, low), high)
    functions["pow"] = lambda x, exponent: x**exponent
    z, u = casadi.SX.sym("z", width), casadi.SX.sym("u", graph.num_given)
    dp, t = casadi.SX.sym("dp", len(graph.values)), casadi.SX.sym("t")
    after = [sum(u[place] * t**n for n, place in enumerate(places)) for places in graph.series]
    now = [x + (t if graph.time == i else 0) for i, x in enumerate(after)]
    values = [dp[k] + value for k, value in enumerate(graph.values.tolist())]
    inputs = {"z": casadi.vertsplit(z), "u": now, "p": values}
    found = casadi.vertcat(*rates_of(graph, inputs, functions))
    rates = casadi.Function("rates", [z, u, dp, t], [found])
    scale = casadi.DM(np.asarray(graph.scale))
    stages, h = casadi.SX.sym("stages", width, rule.nodes.size), casadi.SX.sym("h")
    inside = casadi.repmat(z, 1, rule.nodes.size) + stages @ casadi.DM(rule.coupling.T)
    slopes = casadi.horzcat(
        *(
            h * weight * rates(inside[:, i], u, dp, t + node * h)
            for i, (weight, node) in enumerate(zip(rule.weights, rule.nodes, strict=True))
        )
    )
    off = casadi.vec((stages - slopes) / casadi.repmat(scale, 1, rule.nodes.size))
    given = casadi.vertcat(z, u, dp, t, h)
    equation = {"x": casadi.vec(stages), "p": given, "g": off}
    solver = casadi.rootfinder("stages", "newton", equation, {"abstol": _FLOOR, "max_iter": 40})
    again = casadi.Function("again", [casadi.vec(stages), given], [casadi.vec(slopes)])
    shapes = {"z": width, "u": u.numel(), "dp": dp.numel(), "h": 1}
    Z, U, D, H = (casadi.MX.sym(name, size) for name, size in shapes.items())
    state, part = Z, H / piece.substeps
    for n in range(piece.substeps):
        args = casadi.vertcat(state, U, D, n * part, part)
        begun = part * rates(state, U, D, n * part) / rule.nodes.size
        begun = casadi.repmat(begun, rule.nodes.size, 1)
        found = solver(begun, args)
        if not piece.newton:  # iterations contract
            found = again(again(found, args), args)
        state = state + casadi.sum2(casadi.reshape(found, width, rule.nodes.size))
    names, default = ["z", "u", "dp", "h"], {"default_in": [0.0, 0.0, 0.0, graph.dt]}
    step = casadi.Function(name, [Z, U, D, H], [state], names, ["Z"], default)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "step.casadi"
        step.save(str(path))
        return path.read_bytes()
