"""The rates of a law as one expression graph, which every printer of a law reads.

    ż = f(z, u, p, σ)

z = (q, p); u: the args of `map.step` (parameters, the time of a drive, inputs); p: the coefficients
of the law. Friction whose force has a kink or a jump where its speed turns depends on σ, the sign
of that speed: with σ as a number, f is analytic. The package's own lines run on symbols
(`exports.symbols`); no formula is written a second time.
"""

import dataclasses
from typing import Any

import jax
import numpy as np

from gfnn_jax.brackets import Bracket, Log
from gfnn_jax.coordinates import CARTESIAN, LOG
from gfnn_jax.errors import InputError
from gfnn_jax.exports.c_pieces import on_symbols, why_not_piece
from gfnn_jax.exports.symbols import Symbol, Tape
from gfnn_jax.families import friction
from gfnn_jax.families.expressions import coordinate_names
from gfnn_jax.families.family import at_time
from gfnn_jax.flows.damped import DampedFlow
from gfnn_jax.flows.flow import Flow
from gfnn_jax.flows.forces import Forced
from gfnn_jax.flows.legendre import Legendre, law_of
from gfnn_jax.flows.lie import LieFlow
from gfnn_jax.flows.uniform import without_forces
from gfnn_jax.maps.laws import is_of_law
from gfnn_jax.maps.symplectic_map import SymplecticMap


@dataclasses.dataclass(frozen=True)
class LawGraph:
    """The graph of a law, with what its printers say about it.

    tape: its operations, on inputs ``z``, ``u``, ``p`` and ``sigma``. rates: (2d,) of them ż.
    speeds: (F,) the speeds of the friction that σ belongs to; limits: (F,) the forces at which
    these hold, 0 of friction that has a kink alone; directions: (F, d) of the speeds. names,
    arguments, terms: of z, u and p; values: of p. series: for each of u the places of its
    coefficients of 1, τ, …, τ the time since a step began; time: which of u is the time, or None.
    dt, scale: of a step, and of z.
    """

    tape: Tape
    rates: list[Any]
    speeds: list[Any]
    limits: list[Any]
    directions: np.ndarray
    names: tuple[str, ...]
    arguments: tuple[str, ...]
    terms: tuple[str, ...]
    values: np.ndarray
    series: tuple[tuple[int, ...], ...]
    time: int | None
    dt: float
    scale: np.ndarray

    @property
    def dim(self) -> int:
        return len(self.rates) // 2

    @property
    def sticks(self) -> bool:
        """Return whether bodies stick: dry friction acts that has no width."""
        return any(isinstance(limit, Symbol) or limit != 0 for limit in self.limits)

    @property
    def num_given(self) -> int:
        """The numbers of u that a step takes: those that the graph reads, and the coefficients of
        τ, τ², … of inputs."""
        return sum(map(len, self.series))


def _pulls(own: friction.Friction, q: Any, v: np.ndarray, signs: np.ndarray) -> np.ndarray:
    """∂r_k/∂v (F, d) at q, v (d,) on symbols: the signs of speeds are given, 0 of friction that
    needs none. |v| of isotropic friction is that of speeds above 1e-8: it has no series at 0."""
    pulls = []
    for c, kind, width, sign in zip(own.directions, own.kinds, own.widths, signs, strict=True):
        if kind == friction.ISOTROPIC:
            size = (c @ (v * v) + 1e-16).sqrt()
            pulls.append(c * v * size ** (float(width) - 1))
        else:
            place = (c @ q - width) * (c @ q - width) if kind == friction.PLACED else 1.0
            pulls.append(c * friction.TABLE[kind].signed(c @ v, sign, width) * place)
    return np.array(pulls, dtype=object)


def graph_of(map_: SymplecticMap, sharp: bool = True) -> LawGraph:
    """The graph of the law whose flow a map is; with dry friction that is ``sharp`` where bodies
    stick in forecasts, else as the map smooths it.

    Raises InputError for a map that is no flow of a law in Cartesian coordinates, or whose law is
    no formula.
    """
    piece, bracket = map_.pieces[0], map_.bracket
    if len(map_.pieces) != 1 or not isinstance(piece, Flow | LieFlow | DampedFlow):
        raise InputError("this map has no law with rates to export: use --to c or --to stablehlo")
    if map_.coordinates.forward not in (CARTESIAN.forward, LOG.forward):
        raise InputError(f"a law in {map_.coordinates.name} coordinates: --to c or --to stablehlo")
    sensors = map_.sensors
    map_ = jax.tree.map(np.asarray, map_)  # drops the sensors
    piece: Any = map_.pieces[0]
    reason = why_not_piece(piece) if bracket is None else None
    if reason is not None:
        raise InputError(f"this law cannot be written as formulas: {reason}")
    dim, params = map_.dim, np.asarray(piece.params)
    base = map_.parameters.names if map_.parameters is not None else ()
    inputs, degree = ((), 0) if map_.signals is None else (map_.signals.names, map_.signals.degree)
    tape = Tape()
    z, u = tape.inputs("z", map_.width), tape.inputs("u", len(base) + len(inputs))
    plain = params.ndim == 1
    p = tape.inputs("p", params.size)[0] if plain else params
    args = u if u.size else None
    family = on_symbols(_held(piece.family))
    speeds, limits, directions = [], [], np.zeros((0, dim), int)
    if bracket is not None:
        rates = _of_bracket(bracket, piece, p, z, args)
    elif is_of_law(map_):
        creep = getattr(sensors, "creep", 0.0) if sharp else -1.0
        rates, speeds, limits, directions = _of_lagrangian(tape, family, p, z, args, creep)
    else:
        gradient = family.gradient(p, z, args)[0]
        rates = [*gradient[dim:], *(-gradient[:dim])]
    count = len(inputs)
    series = [(i,) for i in range(len(base))]
    series += [tuple(len(base) + n * count + j for n in range(degree + 1)) for j in range(count)]
    none = np.zeros(len(base) + count)
    # Whether the family depends on time, the last of its args but for the inputs.
    advances = none.size and np.any(at_time(_held(piece.family), none, 1.0) != none)
    time = len(base) - 1 if advances else None
    names = coordinate_names(dim) if bracket is None else bracket.labels
    of_terms = piece.family if bracket is None else getattr(piece.family, "family", piece.family)
    terms = tuple(of_terms.term_names) if plain or bracket is not None else ()
    of_friction, values = (speeds, limits, directions), params if plain else np.zeros(0)
    named, scales = (
        (names, (*base, *inputs), terms),
        (float(map_.dt), np.asarray(map_.scale, float)),
    )
    return LawGraph(tape, list(rates), *of_friction, *named, values, tuple(series), time, *scales)


def _of_bracket(bracket: Bracket, piece: Any, p, z, args) -> list[Any]:
    """B∇H − Ez, of log z where the bracket is log-canonical."""
    if isinstance(bracket, Log):
        return list(bracket.form @ piece.family.gradient(p, z, args)[0])
    family = piece.family.family if isinstance(piece, Flow) else piece.family
    count = family.num_parameters
    rates = list(bracket.matrix(z)[0] @ family.gradient(p[:count], z, args)[0])
    drags = piece.frame.dilations.matrices if isinstance(piece, DampedFlow) else ()
    for c, matrix in zip(p[count:], drags, strict=True):
        rates = [rate - c * drag for rate, drag in zip(rates, matrix @ z[0], strict=True)]
    return rates


def _held(family: Any) -> Any:
    """The family whose inputs are their values alone: a printer has its own series of them."""
    if isinstance(family, Forced):
        return dataclasses.replace(family, degree=0)
    inner = getattr(family, "family", None)
    if inner is None or without_forces(family) is family:
        return family
    return dataclasses.replace(family, family=_held(inner))


def _of_lagrangian(tape: Tape, family: Any, p, z, args, creep: float) -> tuple:
    """Rates of a Lagrangian with its forces, and the speeds, limits and directions of the friction
    whose sign is given; dry friction of no width beyond ``creep`` is sharp."""
    law = law_of(family, p)
    own, dim = law.friction, law.dim
    if np.any(own.loaded):
        raise InputError(
            "this law has friction by the size of an input, which has no series where that is 0, "
            "and is in no format yet: forecast it here (gfnn predict)"
        )
    sharp = own.dry & (own.widths <= creep)
    kinked = np.isin(own.kinds, (friction.QUADRATIC, friction.ONE_SIDED, friction.STRIBECK))
    kinked |= (own.kinds == friction.POWER) & (own.widths % 2 != 1)  # odd powers are smooth
    signed = np.flatnonzero(sharp | kinked)
    signs = np.zeros(own.count, dtype=object)
    signs[signed] = tape.inputs("sigma", len(signed))[0] if len(signed) else []
    if law.powers is not None:
        law = law.at(args[..., : len(law.powers[0])])
    gains = np.asarray(law.gains, dtype=object).reshape(dim, law.num_inputs)
    losses = np.asarray(law.losses, dtype=object).ravel()
    u = args[..., -law.num_inputs :] if law.num_inputs else None
    gradient = Legendre(law.terms).gradient(law.coefficients, z, u)[0]
    v = gradient[dim:]
    forces = -gradient[:dim] - z[0, dim:] * law.uniform
    if own.count:
        forces = forces - losses @ _pulls(own, z[0, :dim], v, signs)
    if law.num_inputs:
        forces = forces + gains @ args[0, -law.num_inputs :]
    speeds = [own.directions[k] @ v for k in signed]
    limits = [losses[k] if sharp[k] else 0.0 for k in signed]
    return [*v, *forces], speeds, limits, own.directions[signed]
