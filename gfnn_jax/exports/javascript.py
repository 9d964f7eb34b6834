"""A law as JavaScript: the C of its Taylor series with other declarations."""

import json
import re
from collections.abc import Mapping
from typing import Any

from gfnn_jax.exports.graph import graph_of
from gfnn_jax.exports.symbols import literal
from gfnn_jax.exports.taylor import c_of_flow
from gfnn_jax.maps.symplectic_map import SymplecticMap

_DECLARED = (  # of C, and of JavaScript
    (r"\(void\)\(\w+\)(?:, \(void\)\(\w+\))*;\n *", ""),
    (r"static const (?:double|int) (\w+)\[[^]]*\] = \{([^}]*)\}", r"const \1 = [\2]"),
    (r"static const double (\w+ = )", r"const \1"),
    (r"static (?:double|int|void) (\w+)\(", r"function \1("),
    (r"enum \{ (.*) \};", r"const \1;"),
    (r"for \(int ", "for (let "),
    (r"const (?:double|int) (\w+ = )", r"const \1"),
    (r"\bf(max|min|abs)\(", r"Math.\1("),
    (r"\b(pow|sin|cos|exp|log|sqrt|sinh|cosh|atan)\(", r"Math.\1("),
    (r"\bisfinite\(", "Number.isFinite("),
    (r"\bINFINITY\b", "Infinity"),
)


def _in_javascript(text: str) -> str:
    """The C of this module with the declarations of JavaScript."""
    for pattern, by in _DECLARED:
        text = re.sub(pattern, by, text)

    def head(found: re.Match) -> str:
        return found[1] + re.sub(r"\b(?:const )?(?:double|int) \*?", "", found[2]) + ")"

    def declared(found: re.Match) -> str:
        arrays = re.sub(r"(\w+)\[([\w*]+)\](?=,|$)", r"\1 = new Float64Array(\2)", found[2])
        return f"{found[1]}let {arrays};"

    text = re.sub(r"(function \w+\()([^)]*)\)", head, text)
    return re.sub(r"(?m)^( +)(?:double|int) ([^;]*);", declared, text)


def javascript(map_: SymplecticMap, name: str, about: Mapping[str, Any]) -> str:
    """Write the law of a map as JavaScript, a constant of this name with a function ``step``:

        law.step(z, h, u, p)     z a time h later: an array of 2d numbers, NaN where no motion is

    z: (q, p) in the units of the data, named in ``law.variables``. h: any time, of either sign
    where nothing sticks. u: ``law.arguments``: parameters of the system, the time of a drive,
    inputs, which are held during the step; a longer u has the coefficients of τ, τ², … of the
    inputs behind them, τ the time since the step began. p: the coefficients of ``law.terms``, by
    default ``law.coefficients``, those that were learned. ``law.velocity(z, u, p)`` is q̇ (d
    numbers), ``law.dt`` the time of a sample. It is no module: a script to put into a page, and
    ``module.exports`` where there is such. about: entries of the comment at the top.

    Bodies stick and slide. A NaN is a motion that has no solution, or more events than can be
    followed. Raises InputError for a map without a law, or with one that is no formula.
    """
    graph = graph_of(map_)
    lists = {"variables": graph.names, "arguments": graph.arguments, "terms": graph.terms}
    shown = {key: json.dumps(names, ensure_ascii=False) for key, names in lists.items()}
    listed = "\n".join(f"    {key}: {names}," for key, names in shown.items())
    fewest = len(graph.series)
    signs = ", new Float64Array(FRICTIONS)" if graph.speeds else ""
    comment = "\n".join(f"   {key}: {value}" for key, value in {**about, **shown}.items())
    comment = comment.replace("*/", "* /")
    return f"""\
/* The law of a motion: {name}.step(z, h, u, p) is z a time h later, to roundoff.

{comment}
*/
const {name} = (() => {{
"use strict";
const OK = 0, NOT_CONVERGED = 3, NON_FINITE = 4;
const coefficients = [{", ".join(map(literal, graph.values))}];
{_in_javascript(c_of_flow(graph, coefficients=True, unrolled=False))}
function whole(u) {{
    const all = new Float64Array({max(graph.num_given, 1)});
    if (u.length < {fewest})
        throw new Error("expected {fewest} numbers: {", ".join(graph.arguments)}");
    all.set(u);
    return all;
}}

return {{
{listed}
    coefficients,
    dt: {literal(graph.dt)},
    step(z, h, u = [], p = coefficients) {{
        const later = Float64Array.from(z);
        const status = flow(later, h, whole(u), p);
        return Array.from(status === OK ? later : later.fill(NaN));
    }},
    velocity(z, u = [], p = coefficients) {{
        const T = new Float64Array(ROWS*SIZE);
        z.forEach((value, i) => {{ T[i*SIZE] = value; }});
        given(T, whole(u), 0.0);
        operations(T, 0, p{signs});
        return rates.slice(0, DIM).map((row) => T[row]);
    }},
}};
}})();
if (typeof module !== "undefined")
    module.exports = {name};
"""
