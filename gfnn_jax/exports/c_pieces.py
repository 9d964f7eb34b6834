"""Pieces of a map in C: ``int PIECE_step(double *z)``, and ``PIECE_back``, its inverse.

The args follow the state in z and in w: parameters, the time of a drive, coefficients of inputs. A
piece does not change them. Polynomials of many terms are arranged by Horner's scheme.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from functools import cache
from itertools import product
from typing import Any

import numpy as np

from gfnn_jax.errors import InputError
from gfnn_jax.exports.symbols import Tape, table
from gfnn_jax.families.displacements import OfDisplacement
from gfnn_jax.families.family import at_time
from gfnn_jax.families.inputs import Inputs
from gfnn_jax.families.jets import jets
from gfnn_jax.families.products import Products
from gfnn_jax.families.terms import Terms
from gfnn_jax.families.traced import traced
from gfnn_jax.flows.flow import Flow
from gfnn_jax.flows.forces import Forced
from gfnn_jax.flows.legendre import Legendre
from gfnn_jax.flows.systems import OfSystems
from gfnn_jax.flows.uniform import Uniform, without_forces
from gfnn_jax.generating.generated import Generated, ImplicitStep
from gfnn_jax.generating.predictor import PolynomialModel
from gfnn_jax.maps.domain import Domain
from gfnn_jax.maps.piece import Affine, Damping
from gfnn_jax.solve.linear import COFACTORS_UP_TO, by_cofactors


def christoffel(domain: Domain, y: np.ndarray) -> Any:
    """Christoffel function of a domain at y (2d,): a polynomial of degree 4 in the scaled
    coordinates, of fewer terms than the squares that it is the sum of.

    Its factor has a condition of at most 1e3: the sum's rounding is below 1e-9 of its limit.
    """
    x = [(y[i] - c) / s for i, c, s in zip(domain.keep, domain.centre, domain.scale, strict=True)]
    unit = np.eye(len(x), dtype=int)
    i, j = np.triu_indices(len(x))
    powers = np.concatenate([0 * unit[:1], unit, unit[i] + unit[j]])  # as `maps.domain` has them
    squared = domain.factor.T @ domain.factor
    terms: dict[tuple[int, ...], float] = {}
    for a, b in product(range(len(powers)), repeat=2):
        power = tuple((powers[a] + powers[b]).tolist())
        terms[power] = terms.get(power, 0.0) + float(squared[a, b])
    return horner(terms, x)


def horner(terms: Mapping[tuple[int, ...], float], x: Sequence[Any]) -> Any:
    """Polynomial Σ c Π x_i^n_i, of terms n -> c, by Horner's scheme in each variable in turn."""
    if not x:
        return sum(terms.values())
    of_power: list[dict] = [{} for _ in range(1 + max(n[0] for n in terms))]
    for n, c in terms.items():
        of_power[n[0]][n[1:]] = c
    total: Any = 0.0
    for inner in reversed(of_power):
        total = total * x[0] + (horner(inner, x[1:]) if inner else 0.0)
    return total


def variables(model: PolynomialModel, x: Sequence[Any]) -> list[Any]:
    """Variables of a model's polynomials at its family's own x, symbols: within its reach, cosine
    and sine of an angle."""
    found = []
    for value, reach, angle in zip(x, model.reach, model.family.inputs.is_angle, strict=True):
        found += [value.cos(), value.sin()] if angle else [value.clipped(-reach, reach)]
    return found


def side_by_side(name: str, model: PolynomialModel) -> str:
    """Write ``NAME(x, y)``, which adds the polynomials of a model at its `variables` x to y.

    All are computed by the same lines, whose lanes a compiler puts into vectors. Powers in place of
    Chebyshev's polynomials cost digits, of degree 20 half of them: a guess has some to spare.
    """
    terms = in_powers(model)
    count, many, width = len(model.matrices), len(terms), len(next(iter(terms)))
    tape = Tape()
    x = tape.inputs("x", width)[0].tolist()
    c = tape.inputs("c", 1 + count * (many - 1))[0, ::count]
    lane = tape.lines({"const double more": horner(dict(zip(terms, c, strict=True)), x)})
    lines = "\n".join(f"        {line}" for line in lane)
    return f"""\
static void {name}(const double *restrict x, double *restrict y)
{{
    static const double coefficients[{count * many}] = {table(np.array(list(terms.values())))};
    for (int k = 0; k < {count}; k++) {{
        const double *c = coefficients + k;
{lines}
        y[k] += more;
    }}
}}
"""


def in_powers(model: PolynomialModel) -> dict[tuple[int, ...], np.ndarray]:
    """Terms n -> coefficients (k,) of Π x_i^n_i, of the k polynomials of a model."""
    halves, degree = model.basis.halves, model.family.degree
    indices = [half.indices.tolist() for half in halves]
    angles = [angle for half in halves for angle in half.is_angle]
    found: dict[tuple[int, ...], np.ndarray] = {}
    for a, b in np.argwhere(np.any(model.matrices != 0, axis=0)).tolist():
        functions = [*indices[0][a], *indices[1][b]]
        each = [_powers(k, degree, angle) for k, angle in zip(functions, angles, strict=True)]
        for factors in product(*each):
            n = tuple(power for powers, _ in factors for power in powers)
            value = model.matrices[:, a, b] * math.prod(c for _, c in factors)
            found[n] = found.get(n, 0.0) + value
    return found


@cache
def _powers(k: int, degree: int, angle: bool) -> list[tuple[tuple[int, ...], float]]:
    """Terms (powers, coefficient) of the k-th function of one variable in `families.products`."""
    if k <= degree:  # T_k of x, or of the cosine
        last = (0,) if angle else ()
        coefficients = np.polynomial.chebyshev.cheb2poly(np.eye(degree + 1)[k])
        return [((n, *last), float(c)) for n, c in enumerate(coefficients) if c]
    # sin jx = sin x T_j'(cos x) / j
    j = k - degree
    slope = np.polynomial.polynomial.polyder(np.polynomial.chebyshev.cheb2poly(np.eye(j + 1)[j]))
    return [((n, 1), float(c) / j) for n, c in enumerate(slope) if c]


_EXPLICIT = (Affine, Damping)  # pieces whose image is a formula


def why_not_piece(piece: Any) -> str | None:
    """Reason why a piece cannot be written in C; None where it can."""
    if isinstance(piece, _EXPLICIT):
        return None
    if not isinstance(piece, (Generated, Flow)):
        return f"the map has a piece {type(piece).__name__}"
    family = piece.family
    inner = family.family if isinstance(family, OfDisplacement) else without_forces(family)
    if isinstance(inner, Legendre) and inner.dim > COFACTORS_UP_TO:
        return f"its Legendre transform has more than {COFACTORS_UP_TO} degrees of freedom"
    if not isinstance(inner, (Products, Terms, Legendre)):
        return f"the map is one of {getattr(family, 'label', type(family).__name__)}"
    try:
        on_symbols(family)
    except InputError as error:
        return str(error)
    return None


def unknowns(piece: Generated, dim: int) -> int:
    """Number of unknowns of the implicit step."""
    free = piece.chart.free(dim)
    return free.stop - free.start


def piece_functions(name: str, piece: Any, back: Any, width: int, more: int = 0) -> list[str]:
    """The functions of a piece and of its inverse ``back``, for states (width,), which ``more``
    args follow."""
    if isinstance(piece, _EXPLICIT):
        ways = (("step", piece), ("back", back))
        return [part for way, one in ways for part in _explicit(f"{name}_{way}", one, width, more)]
    family, params = on_symbols(piece.family), np.asarray(piece.params)
    tape = Tape()
    w, args = _with_args(tape, "w", width, more)
    parts = [tape.function(f"{name}_gradient", {"g": family.gradient(params, w, args)})]
    tape = Tape()
    w, args = _with_args(tape, "w", width, more)
    gradient, hessian = family.gradient_and_hessian(params, w, args)
    parts.append(tape.function(f"{name}_hessian", {"g": gradient, "h": hessian}))
    for way, one in (("step", piece), ("back", back)):
        parts += _generated(f"{name}_{way}", name, one, width, more)
    return parts


def _with_args(tape: Tape, name: str, width: int, more: int) -> tuple[np.ndarray, Any]:
    """Make an input (1, width), and the args (1, more) that follow it, or None."""
    both = tape.inputs(name, width + more)
    return both[:, :width], both[:, width:] if more else None


def _explicit(name: str, piece: Any, width: int, more: int) -> list[str]:
    tape = Tape()
    z, args = _with_args(tape, "z", width, more)
    image = tape.function(f"{name}_image", {"Z": piece.image(z, args)[0]})
    return [
        image,
        f"""\
static int {name}(double *z)
{{
    double Z[{width}];
    {name}_image(z, Z);
    memcpy(z, Z, sizeof Z);
    return OK;
}}
""",
    ]


class _Given:
    """Family whose derivatives are inputs of a C function and do not depend on w."""

    operations = (0, 0)

    def __init__(self, gradient, hessian=None):
        self._gradient, self._hessian = gradient, hessian

    def value(self, params, w, args=None):
        raise NotImplementedError  # an implicit step asks for derivatives only

    def gradient(self, params, w, args=None):
        return self._gradient

    def gradient_and_hessian(self, params, w, args=None):
        return self._gradient, self._hessian


def _generated(name: str, family: str, piece: Generated, width: int, more: int) -> list[str]:
    """Write the step of a generated piece, or of its inverse.

    family: name of the piece whose functions in C compute the derivatives of S."""
    chart, n = piece.chart, unknowns(piece, width // 2)
    dt, scale = float(np.asarray(piece.dt)), np.asarray(piece.scale)
    equation = ImplicitStep(chart)

    def state_and_args(tape: Tape) -> tuple[np.ndarray, Any]:
        z, args = _with_args(tape, "z", width, more)
        return z, args if args is None else at_time(piece.family, args, 0.5 * dt)

    tape = Tape()
    z, args = state_and_args(tape)
    guess: dict[str, Any] = {"x": chart.first_guess(z)[:, chart.free(width // 2)]}
    parts, begin = [], f"{name}_guess(z, x);"
    if piece.predictor is not None:
        model = piece.predictor.forward
        within = on_symbols(model.family).inputs(z, args)[0]
        guess["v"] = variables(model, within)
        begin = f"double v[{len(guess['v'])}];\n    {name}_guess(z, x, v);"
        begin += f"\n    {name}_predict(v, x);"
        parts.append(side_by_side(f"{name}_predict", model))
    parts.append(tape.function(f"{name}_guess", guess))

    tape = Tape()
    (z, args), x = state_and_args(tape), tape.inputs("x", n)
    w = chart.complete(chart.first_guess(z), x)
    if args is not None:
        w = np.concatenate([w, args], axis=1)
    parts.append(tape.function(f"{name}_point", {"w": w}))

    for linear in (False, True):
        tape = Tape()
        z, x, g = tape.inputs("z", width), tape.inputs("x", n), tape.inputs("g", width)
        h = tape.inputs("h", width, width) if linear else None
        shared, lanes = (_Given(g, h), None, dt, scale), (z, chart.first_guess(z), None)
        if linear:
            at, matrix = equation.linearise(shared, lanes, x)
            outputs = {"r": at.residual, "s": at.size, "m": matrix}
            parts.append(tape.function(f"{name}_linear", outputs))
        else:
            at = equation.evaluate(shared, lanes, x)
            parts.append(tape.function(f"{name}_residual", {"r": at.residual, "s": at.size}))

    tape = Tape()
    z, x, g = tape.inputs("z", width), tape.inputs("x", n), tape.inputs("g", width)
    image = chart.image(z, chart.complete(chart.first_guess(z), x), g, dt)
    parts.append(tape.function(f"{name}_image", {"Z": image}))

    solve = f"return eliminated({n}, m, r, x);"
    if n <= COFACTORS_UP_TO:
        tape = Tape()
        solution, determinant = by_cofactors(tape.inputs("m", n, n), tape.inputs("r", n))
        parts.append(tape.function(f"{name}_cofactors", {"x": solution, "d": determinant}))
        solve = f"double d[1];\n    {name}_cofactors(m, r, x, d);\n    return sign_of(d[0]);"
    parts.append(f"""\
static void {name}_evaluate(const double *z, const double *x, struct point *at)
{{
    double w[{width + more}];
    {name}_point(z, x, w);
    {family}_gradient(w, at->gradient);
    {name}_residual(z, x, at->gradient, at->residual, at->size);
}}

static void {name}_linearise(const double *z, const double *x, struct point *at, double *m)
{{
    double w[{width + more}], h[{width * width}];
    {name}_point(z, x, w);
    {family}_hessian(w, at->gradient, h);
    {name}_linear(z, x, at->gradient, h, at->residual, at->size, m);
}}

static double {name}_solve(const double *m, const double *r, double *x)
{{
    {solve}
}}

static int {name}(double *z)
{{
    static const struct equation of = {{{n}, {name}_evaluate, {name}_linearise, {name}_solve}};
    double x[{n}], g[{width}], Z[{width}];
    {begin}
    const int status = newton(&of, z, x, g);
    {name}_image(z, x, g, Z);
    memcpy(z, Z, sizeof Z);
    return status;
}}
""")
    return parts


def moves_args(piece: Any, more: int) -> bool:
    """Return whether what a piece depends on changes during a step."""
    return isinstance(piece, Flow) and args_later("", on_symbols(piece.family), more) is not None


def args_later(name: str, family: Any, more: int) -> str | None:
    """Write the args of a family a time ``after`` later; None where they stay as they are."""
    if not more:
        return None
    tape = Tape()
    args, after = tape.inputs("args", more), tape.inputs("after", 1)
    later = at_time(family, args, after[0])
    if all(a is b for a, b in zip(np.ravel(args), np.ravel(later), strict=True)):
        return None
    return tape.function(name, {"later": later})


_NARROWEST = 1e-150  # width of dry friction that no speed is below, and whose square is a number


class Formulas(Inputs):
    """Inputs whose features are formulas, for symbols, which JAX cannot take."""

    def feature_tables(self, w, order: int) -> tuple:
        """Features (1, k) and derivatives up to ``order`` at w (1, 2d), an array of symbols."""
        width = w.shape[-1]
        assert self.features is not None
        found = jets(traced(self.features, width // 2), w, order)
        shapes = ((1, len(found), *[width] * n) for n in range(order + 1))
        tables: list[np.ndarray] = [np.zeros(shape, dtype=object) for shape in shapes]
        for k, jet in enumerate(found):
            tables[0][:, k] = jet.value
            for i, slope in jet.slope.items():
                tables[1][:, k, i] = slope
            for (i, j), curvature in jet.curvature.items():
                tables[2][:, k, i, j] = tables[2][:, k, j, i] = curvature
        return tuple(tables)


class _Phase(float):
    """Number whose cosine NumPy finds in an object array, as it finds that of a symbol."""

    def __radd__(self, other):
        total = other + float(self)
        return _Phase(total) if isinstance(total, float) else total

    def cos(self) -> float:
        return math.cos(self)

    def sin(self) -> float:
        return math.sin(self)


def on_symbols(family: Any) -> Any:
    """Make the family run on symbols. Raises InputError for a feature that is no formula."""
    if isinstance(family, Legendre):
        phases = np.array([_Phase(phase) for phase in family.terms.phases], dtype=object)
        return Legendre(dataclasses.replace(family.terms, phases=phases))
    if isinstance(family, Forced):  # of no width, friction would ask whether a symbol is 0
        widths = np.maximum(family.friction.widths, _NARROWEST)
        friction = dataclasses.replace(family.friction, widths=widths)
        family = dataclasses.replace(family, friction=friction)
    if isinstance(family, (OfDisplacement, Forced, OfSystems, Uniform)):
        return dataclasses.replace(family, family=on_symbols(family.family))
    if not isinstance(family, Products) or family.inputs.features is None:
        return family
    inputs = family.inputs
    assert inputs.features is not None
    traced(inputs.features, inputs.width // 2)
    fields = {f.name: getattr(inputs, f.name) for f in dataclasses.fields(inputs)}
    return dataclasses.replace(family, inputs=Formulas(**fields))
