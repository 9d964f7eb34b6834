"""Libraries of terms for an H that depends on parameters, or on the time of a drive:
H = Σ c_jm φ_j(z) f_m(parameters).

φ_j are those of a library of the state. f_m are first the products of small whole powers of the
parameters, which most laws are made of (p²/(m l²), g l cos q), then Chebyshev polynomials, which
any smooth dependence is. A parameter that keeps its sign enters these by its logarithm: every power
of it is entire in that, where a pole near the data would slow the series in the parameter itself.
The time of a drive enters by the harmonics of its period.
"""

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from itertools import product
from typing import Any

import numpy as np

from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.families.expressions import coordinate_names
from gfnn_jax.families.modes import modes
from gfnn_jax.families.terms import Terms, joined, multiplied, polynomial_terms
from gfnn_jax.phase_space import TIME


class Options:
    """Tuned on pendulums of varied length, or driven, and on Kepler's problem of varied mass.

    harmonics: of a drive, the largest, in turn.
    powers: the largest exponent of a parameter, total: of them all together. degrees: of the
    Chebyshev polynomials, in turn. boxes: (order, degree) of the libraries with angles;
    polynomials: degrees of those without; features: of a scene's. gained: a library that lowers
    the error by less has not helped; leap: one that lowers it by more is taken at once.
    apart: the ratio of the largest to the smallest value from which on logarithms are taken.
    far_from_zero: of the largest value; nearer to it a parameter has no negative powers.
    """

    harmonics: tuple[int, ...] = (1, 2, 4)
    powers: int = 2
    total: int = 3
    degrees: tuple[int, ...] = (3, 6, 10, 15, 20, 26, 32)
    boxes: tuple[tuple[int, int], ...] = ((1, 2), (2, 2), (2, 4), (4, 4), (6, 6))
    polynomials: tuple[int, ...] = (2, 3, 4, 6, 8, 10, 12, 14)
    features: tuple[int, ...] = (2, 3)
    gained: float = 0.5
    leap: float = 0.03
    apart: float = 1.2
    far_from_zero: float = 0.02


def angles_and_others(data: Dataset) -> tuple[tuple[int, ...], tuple[str, ...]]:
    """The angles that enter by themselves, and the names of the coordinates that are none."""
    dim, coordinates = data.dim, data.coordinates
    angles = tuple(i for i in coordinates.angles if i < dim and i not in coordinates.cyclic)
    left = (*angles, *coordinates.cyclic)
    names = coordinate_names(dim)
    return angles, tuple(name for i, name in enumerate(names) if i not in left)


def states_and_functions(
    data: Dataset, rows: np.ndarray, *, features=None, reversor=None, own: Terms | None = None
) -> tuple[list[Terms], list[list[Terms]]]:
    """Libraries of the state alone, by rising size, and functions of the args of these rows, which
    multiply them. own: a user's terms, which stand in all libraries, at first alone. features,
    reversor: of a scene."""
    dim, parameters = data.dim, data.parameters
    angles, plain = angles_and_others(data)
    if angles and features is None:
        # A torque that the args say, −∂H/∂θ of θ f(args), is one for all turns of θ.
        names = tuple(coordinate_names(dim)[i] for i in angles)
        turned = Terms(dim, names, tuple(map(tuple, np.eye(len(names), dtype=int).tolist())))
        found = [joined(modes(dim, angles, plain, *box), turned) for box in Options.boxes]
    else:
        degrees = Options.polynomials if features is None else Options.features
        cyclic = data.coordinates.cyclic
        found = [
            polynomial_terms(dim, d, cyclic=cyclic, features=features, reversor=reversor)
            for d in degrees
        ]
    found = [dataclasses.replace(family, parameters=parameters) for family in found]
    states = found if own is None else [own, *(joined(own, family) for family in found)]
    args, alone = data.given(rows)[1], own is not None
    return states, functions_of_parameters(dim, parameters, args, alone, data.period)


def functions_of_parameters(
    dim: int,
    parameters: tuple[str, ...],
    args: np.ndarray,
    own: bool,
    period: float | None = None,
) -> list[list[Terms]]:
    """Rows of sets of functions of the parameters, whose values args are (N, k); in each row every
    set spans those before it. own: whether none at all is the first. period: of a drive, whose
    time is the last of them."""
    none = [Terms(dim, (), ((),), parameters)] if own else []
    if period is None:
        powers = _powers(dim, parameters, args)
        series = [_chebyshev(dim, parameters, args, degree) for degree in Options.degrees]
        return [[*none, powers], series]
    in_time = [_harmonics(dim, parameters, most, period) for most in Options.harmonics]
    if len(parameters) == 1:
        return [[*none, *in_time]]
    others = functions_of_parameters(dim, parameters[:-1], args[:, :-1], False)
    of_all = [
        [
            multiplied(dataclasses.replace(functions, parameters=parameters), harmonics)
            for functions, harmonics in _beside(row, in_time)
        ]
        for row in others
    ]
    return [[*none, *of_all[0]], *of_all[1:]]


def _beside(row: list[Terms], harmonics: list[Terms]) -> Iterator[tuple[Terms, Terms]]:
    """Functions of parameters with harmonics: both rise, the shorter row stays at its last."""
    for i in range(max(len(row), len(harmonics))):
        yield row[min(i, len(row) - 1)], harmonics[min(i, len(harmonics) - 1)]


def _harmonics(dim: int, parameters: tuple[str, ...], most: int, period: float) -> Terms:
    """1 and cos, sin of the drive's harmonics up to ``most``."""
    rates = (2 * np.pi * m / period for m in range(1, most + 1))
    turns = [TIME if rate == 1 else f"{rate!r}*{TIME}" for rate in map(float, rates)]
    variables = tuple(f"{f}({turn})" for turn in turns for f in ("cos", "sin"))
    rows = np.concatenate([np.zeros((1, len(variables)), int), np.eye(len(variables), dtype=int)])
    return Terms(dim, variables, tuple(map(tuple, rows.tolist())), parameters)


def _powers(dim: int, parameters: tuple[str, ...], args) -> Terms:
    """Products of whole powers, negative ones where a parameter keeps away from 0."""
    inverse = [keeps_away(column) for column in args.T]
    ranges = [range(-Options.powers if i else 0, Options.powers + 1) for i in inverse]
    exponents = [e for e in product(*ranges) if sum(map(abs, e)) <= Options.total]
    variables = (*parameters, *(f"1/{name}" for name in parameters))
    rows = tuple((*(max(a, 0) for a in e), *(max(-a, 0) for a in e)) for e in exponents)
    return Terms(dim, variables, rows, parameters)


def keeps_away(values) -> bool:
    """Return whether a parameter with these values keeps its sign and away from 0."""
    size = np.abs(values)
    return bool(np.ptp(np.sign(values)) == 0 and size.min() > Options.far_from_zero * size.max())


def _chebyshev(dim: int, parameters: tuple[str, ...], args, degree: int) -> Terms:
    """Products of Chebyshev polynomials, of total degree up to ``degree``."""
    arguments = []
    for name, values in zip(parameters, args.T, strict=True):
        if (
            values.min() > 0
            and keeps_away(values)
            and np.ptp(np.log(values)) > np.log(Options.apart)
        ):
            name, values = f"log({name})", np.log(values)
        centre, half = 0.5 * (values.max() + values.min()), 0.5 * np.ptp(values)
        arguments.append(f"({name} - {centre:.6g})/{half * (1 + 1e-5):.6g}")
    variables = tuple(f"T{n}({x})" for x in arguments for n in range(1, degree + 1))
    rows = []
    for each in product(range(degree + 1), repeat=len(parameters)):
        if sum(each) <= degree:
            rows.append(tuple(int(n == m) for m in each for n in range(1, degree + 1)))
    return Terms(dim, variables, tuple(sorted(rows, key=sum)), parameters)


def walked(
    states: Sequence[Terms],
    functions: Sequence[Sequence[Terms]],
    attempt: Callable[[Terms], Any],
    error_of: Callable[[Any], float],
    *,
    bound: float,
    most: float,
) -> Iterator[Any]:
    """Iterate over what ``attempt`` finds for products of a library of the state and one of the
    parameters, as they are tried: of each row of functions, both grow, whichever lowers the error,
    until it is within the bound or neither does. most: terms at most."""
    at, best = 0, np.inf
    for row in functions:
        level, here = 0, np.inf
        moves: list[tuple[int, int]] = [(0, 0)]
        while moves:
            tried: list[tuple[int, float, tuple[int, int]]] = []
            for more, further in moves:
                if at + more >= len(states) or level + further >= len(row):
                    continue
                family = multiplied(states[at + more], row[level + further])
                if family.num_parameters > most:
                    continue
                found = attempt(family)
                yield found
                error = error_of(found)
                best = min(best, error)
                tried.append((family.num_parameters, error, (more, further)))
                if best <= bound:
                    return
                if error < Options.leap * here:
                    break
            # The smallest of those that are hardly worse than the best.
            lowest = min((error for _, error, _ in tried), default=np.inf)
            near = [entry for entry in tried if Options.gained * entry[1] <= lowest]
            _, error, move = min(near, default=(0, np.inf, (0, 0)))
            if error < Options.gained * here:
                at, level, here = at + move[0], level + move[1], error
                moves = [(0, 1), (1, 0), (1, 1)]
                if move[0] and not move[1]:  # what has helped may help again
                    moves = [(1, 0), (0, 1), (1, 1)]
            else:  # of an even function no odd degree helps
                moves = [(2, 0)] if moves != [(2, 0)] else []
