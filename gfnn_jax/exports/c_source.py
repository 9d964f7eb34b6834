"""Export of a map as one C99 file: step, inverse and status, of one state at a time.

All formulas come from the package's own lines, run on symbols. S is solved by Newton's method
(`c_parts`), and the flow of a law is a Taylor series (`taylor`). The code allocates nothing and
keeps no state, so that several threads may call it at once.
"""

import dataclasses
import re
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np

from gfnn_jax.coordinates import CARTESIAN, LOG, polar
from gfnn_jax.errors import InputError
from gfnn_jax.exports import c_parts, c_pieces
from gfnn_jax.exports.graph import LawGraph, graph_of
from gfnn_jax.exports.symbols import Tape, literal, table
from gfnn_jax.exports.taylor import c_of_flow
from gfnn_jax.families.expressions import coordinate_names
from gfnn_jax.generating.generated import Generated
from gfnn_jax.maps.domain import Domain
from gfnn_jax.maps.inputs import Signals
from gfnn_jax.maps.piece import FLOWS
from gfnn_jax.maps.symplectic_map import SymplecticMap
from gfnn_jax.solve.linear import COFACTORS_UP_TO

_POLAR = polar(cyclic=True).forward


def why_not(map_: SymplecticMap) -> str | None:
    """Reason why a map cannot be written in C; None where it can."""
    if np.dtype(map_.scale.dtype) != np.float64:
        return f"the map is of {np.dtype(map_.scale.dtype)}, not of float64"
    if map_.coordinates.forward not in (CARTESIAN.forward, LOG.forward, _POLAR):
        return f"the map has the {map_.coordinates.name} coordinates of its scene"
    if not isinstance(map_.domain, Domain):
        return "the map is a sum over equal sites"
    pieces = map_.pieces if map_.bracket is None else ()  # its rates are formulas
    return next((why for piece in pieces if (why := c_pieces.why_not_piece(piece))), None)


def c_source(map_: SymplecticMap, name: str, about: Mapping[str, Any]) -> str:
    """Write a map as C: ``int NAME_step(const double z[2d], double Z[2d])`` and ``NAME_inverse``.

    For a map with parameters, a drive or inputs both take ``const double args[k]`` after z; where
    inputs change during a step, ``NAME_inputs`` makes their part of the args of samples. about:
    entries of the comment at the top, name -> text. The flow of a law is made to roundoff. Raises
    InputError, in one line, for a map that cannot be written in C.
    """
    if (reason := why_not(map_)) is not None:
        raise InputError(
            f"this map cannot be written in C: {reason}. C takes polynomials, Fourier harmonics "
            "and formulas: use --to stablehlo"
        )
    inner = dataclasses.replace(map_, coordinates=CARTESIAN)  # what pieces move
    laws = [isinstance(piece, FLOWS) for piece in map_.pieces]
    alone = [dataclasses.replace(inner, pieces=(piece,)) for piece in map_.pieces]
    graphs = [graph_of(own) if law else None for own, law in zip(alone, laws, strict=True)]
    sticks = any(graph is not None and graph.sticks for graph in graphs)
    map_ = jax.tree.map(np.asarray, map_)
    pieces, width, domain = map_.pieces, map_.width, map_.domain
    more = num_args(map_)
    assert isinstance(domain, Domain)
    parts = [_comment(map_, name, about, sticks), c_parts.INCLUDES, c_parts.COMMON]
    if map_.coordinates.angles:
        parts.append(c_parts.ANGLES)
    if map_.coordinates.forward is _POLAR:
        parts.append(c_parts.POLAR)
    if map_.coordinates.forward is LOG.forward:
        parts.append(c_parts.logarithms(width))
    generated = (piece for piece in pieces if isinstance(piece, Generated))
    most = max((c_pieces.unknowns(piece, map_.dim) for piece in generated), default=0)
    if most:
        parts.append(c_parts.newton_solver(most, width))
    if most > COFACTORS_UP_TO:
        parts.append(c_parts.ELIMINATION)
    if domain.keep:
        tape = Tape()
        y = tape.inputs("y", width)
        parts.append(tape.function("christoffel", {"kappa": c_pieces.christoffel(domain, y[0])}))
    for i, piece in enumerate(pieces):
        graph, back = graphs[i], map_.reversed().pieces[-1 - i]
        if graph is None:
            parts += c_pieces.piece_functions(f"piece{i}", piece, back, width, more)
        else:
            parts += _flow(f"piece{i}", piece, graph, width, 0 if map_.signals is None else more)
    order = range(len(map_.pieces))
    ahead = args_after(map_)
    parts.append(_whole(map_, f"{name}_step", [f"piece{i}_step" for i in order], []))
    back = [f"piece{i}_back" for i in reversed(order)]
    parts.append(_whole(map_, f"{name}_inverse", back, ahead))
    if of_samples(map_):
        parts.append(inputs_of_samples(map_, name))
    return "\n".join(parts)


def _flow(name: str, piece: Any, graph: LawGraph, width: int, inputs: int) -> list[str]:
    """Write the flow of a law as a Taylor series. ``inputs`` of the args are those of inputs, which
    an inverse needs at the step's end."""
    dt = float(np.asarray(piece.dt))
    flow = c_of_flow(graph)
    # Names that no other piece has.
    own = re.findall(r"^static (?:const )?\w+ (\w+)\W", flow, re.M)
    own += re.findall(r"(\w+) = \d", flow.partition("\n")[0])
    flow = re.sub(rf"\b({'|'.join(own)})\b", rf"{name}_\1", flow)
    later = c_pieces.args_later(f"{name}_later", c_pieces.on_symbols(piece.family), inputs)
    ways = (("step", dt), ("back", -dt))
    found = [flow, later] if later else [flow]
    for way, h in ways:
        answer = f"{name}_flow(z, {literal(h)}, z + {width}, NULL)"
        found.append(f"static int {name}_{way}(double *z)\n{{\n    return {answer};\n}}\n")
    return found


def _signature(map_: SymplecticMap, name: str) -> str:
    width, more = map_.width, num_args(map_)
    args = f"const double args[{more}], " if more else ""
    return f"int {name}(const double z[{width}], {args}double Z[{width}])"


def _whole(map_: SymplecticMap, name: str, pieces: Sequence[str], ahead: Sequence[str]) -> str:
    """Write the function: `maps.programs.applied` of one state; args follow it in y, moved by
    the lines ``ahead``."""
    width, angles, domain = map_.width, map_.coordinates.angles, map_.domain
    more = num_args(map_)
    changed = map_.coordinates.forward is not CARTESIAN.forward
    centres = np.ravel(np.asarray(map_.angle_centre))
    turns = f", turns[{len(angles)}]" if angles else ""
    lines = [
        f"double y[{width + more}]{turns};",
        "to_inner(z, y);" if changed else f"memcpy(y, z, {width}*sizeof *y);",
        *([f"memcpy(y + {width}, args, {more}*sizeof *y);"] if more else []),
        *ahead,
        *(
            f"y[{a}] = reduced(y[{a}], {literal(centre)}, &turns[{k}]);"
            for k, (a, centre) in enumerate(zip(angles, centres, strict=True))
        ),
        f"int inside = all_finite({width}, y);",
    ]
    assert isinstance(domain, Domain)
    if domain.keep:
        limit = literal(float(np.asarray(domain.limit)))
        lines += ["double kappa[1];", "christoffel(y, kappa);"]
        lines.append(f"inside = inside && kappa[0] <= {limit};")
    lines += inside_ranges(map_)
    lines += [
        "int status = OK;",
        *(f"status = worse(status, {piece}(y));" for piece in pieces),
        "if (status == OK && !inside)",
        "    status = LEFT_DOMAIN;",
        f"if (!all_finite({width}, y))",
        "    status = NON_FINITE;",
        *(f"y[{a}] = unreduced(y[{a}], turns[{k}]);" for k, a in enumerate(angles)),
        "to_user(y, Z);" if changed else f"memcpy(Z, y, {width}*sizeof *y);",
        "return status;",
    ]
    body = "\n".join(f"    {line}" for line in lines)
    return f"{_signature(map_, name)}\n{{\n{body}\n}}\n"


def _comment(map_: SymplecticMap, name: str, about: Mapping[str, Any], sticks: bool) -> str:
    backwards = (
        ""
        if not sticks
        else """
   Bodies stick and slide. What sticks does not tell where it came from: the inverse answers 3."""
    )
    names = coordinate_names(map_.dim) if map_.bracket is None else map_.bracket.labels
    sizes = ", ".join(f"{n} {s:.3g}" for n, s in zip(names, map_.scale, strict=True))
    angles = [names[i] for i in map_.coordinates.angles if map_.coordinates.forward is not _POLAR]
    turned = f" {', '.join(angles)}: period 2 pi, any number of turns." if angles else ""
    given = about_args(map_, name)
    outside = "z or args are" if map_.parameters is not None else "z lies"
    numbers = {k: f"{v:.3g}" if isinstance(v, float) else v for k, v in about.items()}
    comment = "\n".join(f"   {key}: {value}" for key, value in numbers.items())
    text = f"""\
 One step of a learned symplectic map, and its inverse.

       {_signature(map_, f"{name}_step")};
       {_signature(map_, f"{name}_inverse")};

   z = ({", ".join(names)}), in the units of the data; z and Z may be the same array.{turned}{given}
   Sizes of the coordinates in the data: {sizes}.
   A step is dt = {literal(np.asarray(map_.dt))} in the data's unit of time.{backwards}

   Answer: {c_parts.STATUSES}.
   1: {outside} outside the data's domain; the image is in Z all the same. 3, 4: Z is of no use.

   cc -O3 -std=c99 -c {name}.c, and -lm for the linker. No -ffast-math: it takes away the tests for
   numbers that are not finite. Nothing is allocated or remembered: threads may call at once.

{comment}
"""
    return f"/*{text.replace('*/', '* /')}*/\n"


# Args of a map in C follow the state: parameters, the time of a drive, inputs. These are
# polynomials in the time since a step began (`maps.inputs`).


def num_args(map_: SymplecticMap) -> int:
    parameters = 0 if map_.parameters is None else len(map_.parameters.names)
    return parameters + (0 if map_.signals is None else _num_coefficients(map_.signals))


def _num_coefficients(signals: Signals) -> int:
    return (signals.degree + 1) * len(signals.names)


def args_after(map_: SymplecticMap) -> list[str]:
    """Lines that move the args in y from a step's begin to its end, where the inverse begins."""
    width, more, dt = map_.width, num_args(map_), float(map_.dt)
    if map_.parameters is not None and map_.parameters.period is not None:
        names, period = map_.parameters.names, float(map_.parameters.period)
        later = map_.parameters.after(np.zeros((1, len(names))), 1, dt)[0, -1]
        time = f"y[{width + len(names) - 1}]"
        return [f"{time} = fmod({time} + {literal(later)}, {literal(period)});"]
    if map_.signals is not None and c_pieces.moves_args(map_.pieces[0], more):
        return [f"const double after = {literal(dt)};", f"piece0_later(args, &after, y + {width});"]
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
    given, lines = [f"y[{map_.width + k}]" for k in range(len(low))], []
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
        rows = zip(parameters.names, parameters.low, parameters.high, strict=True)
        ranges = ", ".join(f"{n} from {low:.6g} to {high:.6g}" for n, low, high in rows)
        comment = f"\n   args = ({', '.join(parameters.names)}), in the data {ranges}."
        if parameters.period is not None:
            comment += (
                f"\n   {parameters.names[-1]}: the time of the drive at z, of the step and of its "
                f"inverse; period {float(parameters.period):.6g}."
            )
    return comment if map_.signals is None else comment + _about_inputs(map_, name)


def _about_inputs(map_: SymplecticMap, name: str) -> str:
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
