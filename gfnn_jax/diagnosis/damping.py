"""Pairs that lose area: Z = D_b ∘ Φ, the factor b found together with the S of Φ.

D_b: (q, p) -> (q, b p) multiplies the symplectic form by b, and Φ keeps it, so that the map's
Jacobians A obey AᵀJA = b J. For a given b the pairs (z, D_b⁻¹ Z) are those of a symplectic map, and
its S is linear in its coefficients; b is one more unknown of the same least-squares problem, solved
by Gauss–Newton. The drift c of an angle's momentum, which no periodic S has, is another. Where
pairs have args, b and c are polynomials in them, of the degree of S at first.

Local Jacobians say where to begin. What decides is how much less S and b leave over together than
S alone: a constant determinant is not enough, which two oscillators of different friction have too.

`diagnosed` is the whole diagnosis by the pairs' local Jacobians: whether they are symplectic, and
which charts cover them.
"""

import dataclasses
from collections.abc import Iterator
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg

from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.dataset.rows import rows_of
from gfnn_jax.dataset.varied import given_by
from gfnn_jax.diagnosis.local_jacobians import (
    Charts,
    centres,
    choose_charts,
    data_defect,
    local_jacobians,
    look_symplectic,
    sampled_dimension,
)
from gfnn_jax.errors import FitError
from gfnn_jax.families.expressions import coordinate_names
from gfnn_jax.families.inputs import box_inputs
from gfnn_jax.families.products import Products
from gfnn_jax.fitting.least_squares import ROWS_PER_TERM
from gfnn_jax.fitting.significance import CERTAIN
from gfnn_jax.generating.charts import AnyChart
from gfnn_jax.maps.piece import Affine, Damping, FunctionsOfArgs
from gfnn_jax.phase_space import split, symplectic_form


class Options:
    """Options of the search for a loss of area (benchmarks/damped_maps.py)."""

    # Of many more than these training pairs, so many tell whether D_b gains anything: neighbours
    # of a million clean pairs are so close together that what their fits are off by, not
    # friction, makes a change of areas certain.
    sample: int = 1_000
    plenty: int = 20
    # of S, that are tried in turn
    degrees: tuple[int, ...] = (2, 3, 4, 5, 6, 7, 8, 9, 10, 12, 14, 16, 20, 24, 28)
    # Rows × terms² of one solve: a quarter of a second on one core, and of a sample a fortieth.
    most_operations: float = 1000000000.0
    of_sample: float = 100000000.0
    updates: int = 10  # of Gauss–Newton, which converges in four or five
    close: float = 0.01  # standard errors: an update that is smaller is the last
    # of a coefficient's unit, in which an update that is smaller is the last too
    changed: float = 1e-13
    # of the held-out rows' residual: degrees in a row that leave more end it
    better: float = 0.9
    worse: int = 2
    gain: float = 0.5  # of the held-out residual: what another unknown must lower it to
    # of the spread: reached, and as good as reached
    roundoff: float = 1e-15
    at_roundoff: float = 1e-14
    fewer: float = 1.1  # of the held-out residual: what fewer functions of the args may leave
    explained: float = 0.3  # of the factors' variance, by one coordinate that is named
    errors: float = 3.0  # of the Jacobians, above which what D_b leaves of their defect is real


@dataclasses.dataclass(frozen=True)
class LearnedDamping:
    """The factor b of a step, (), or (d,) where degrees of freedom have their own, its standard
    error, and the drift c (d,) of the momenta, which is 0 but for those of angles.

    Where b depends on the args, factor, std and shift have an axis of coefficients before these,
    one for each of the ``functions``. names: of the args. extremes: the lowest and the highest b at
    the pairs' own args. differs: what is known of where b differs, if it is no constant but a mean.
    """

    factor: np.ndarray
    std: np.ndarray
    shift: np.ndarray
    functions: FunctionsOfArgs | None = None
    names: tuple[str, ...] = ()
    extremes: tuple[np.ndarray, ...] = ()
    differs: str = ""

    @property
    def piece(self) -> Damping:
        if self.functions is None:
            return Damping(self.factor, self.shift)
        return Damping(self.factor.reshape(len(self.factor), -1), self.shift, self.functions)

    @property
    def uniform(self) -> bool:
        """Return whether all degrees of freedom have one factor."""
        return self.factor.ndim == (self.functions is not None)

    def undone(self, jacobians, args=None):
        """The Jacobians (n, 2d, 2d) of the map without D_b, at states of these args (n, k)."""
        b = self.piece.of(args)[0]
        b = b[:, None, :] if self.functions is not None else b
        linear = Damping(b, np.zeros(self.shift.shape[-1])).inverse()
        return np.swapaxes(linear.image(np.swapaxes(jacobians, 1, 2)), 1, 2)

    def __str__(self) -> str:
        """Line about what was learned."""
        if self.functions is None:
            each = zip(self.factor.ravel(), self.std.ravel(), strict=True)
            factors = [f"{b:.12g} ± {s:.1g}" for b, s in each]
        else:
            each = zip(*map(np.ravel, self.extremes), strict=True)
            factors = [f"{low:.6g} to {high:.6g}" for low, high in each]
        by = f", depending on {', '.join(self.names)}" if self.names else ""
        if self.differs:
            means = ", ".join(f"{b:.4g}" for b in self.factor.ravel())
            return f"steps multiply areas by {means} in the mean, not everywhere.{self.differs}"
        if self.uniform:
            return f"every step multiplies areas by {factors[0]}{by}, one factor for all states"
        planes = [f"{factor} in (q{i}, p{i})" for i, factor in enumerate(factors, 1)]
        areas = f"every step multiplies areas by {', '.join(planes)}{by}"
        return f"{areas}: no multiple of the symplectic form is kept"

    def line(self, dt: float) -> str:
        """Line about what was learned, with the rate γ of p' = −γ p where one factor b = e^(−γ dt)
        shrinks all areas."""
        if self.differs:
            return f"{self}. The map has the mean"
        if self.functions is not None or not self.uniform or not self.factor < 1:
            return f"{self}. The map has it"
        rate, std = -float(np.log(self.factor)) / dt, float(self.std / self.factor) / dt
        return f"{self}: uniform friction of rate γ = {rate:.6g} ± {std:.1g} is in the map"


def area_factors(jacobians, scale) -> np.ndarray:
    """(n,): the μ for which μ J is nearest to AᵀJA, of Jacobians A (n, 2d, 2d), in coordinates
    of unit size."""
    unit = symplectic_form(len(scale) // 2)
    inner = jacobians * scale[None, None, :] / scale[None, :, None]
    pulled = np.swapaxes(inner, 1, 2) @ unit @ inner
    return np.sum(pulled * unit, axis=(1, 2)) / np.sum(unit**2)


def learn_damping(
    data: Dataset,
    jacobians,
    error: float,
    chart: str,
    reversor,
    most: float = Options.most_operations,
) -> LearnedDamping | None:
    """The D_b behind these pairs; None where areas are kept, or no D_b explains what is lost.

    data: without a base map. jacobians: (n, 2d, 2d) local ones, known to the error.
    most: rows × terms² of one solve.
    """
    factors, dim = area_factors(jacobians, data.scale), data.dim
    b = float(np.median(factors))
    deviation = 1.5 * float(np.median(np.abs(factors - b))) / np.sqrt(len(factors))
    if not b > 0 or not abs(b - 1) > max(3 * error, CERTAIN * deviation):
        return None
    if len(data.training) > Options.plenty * Options.sample:
        parts = (data.training, data.validation)
        some = data.take(np.concatenate([part[: Options.sample] for part in parts]))
        if learn_damping(some, jacobians, error, chart, reversor, Options.of_sample) is None:
            return None
    start = LearnedDamping(np.asarray(b), np.asarray(np.inf), np.zeros(dim))
    undamped = data.without(None, start.piece)
    try:
        charts = choose_charts(chart, undamped, reversor, start.undone(jacobians))
    except FitError:  # no chart covers the rest
        return None
    problems = [_Problem(data, each, charts.half, most) for each in charts.charts]

    def best(spread: np.ndarray) -> tuple[_Fitted, _Problem]:
        first = np.full((1, len(spread)), b)
        found = [(problem.best(spread, first), problem) for problem in problems]
        return min(found, key=lambda each: each[0].held_out)

    found, problem = best(np.ones((1, dim)))
    if dim > 1:
        own, its = best(np.eye(dim))
        if own.held_out < Options.gain * found.held_out:
            found, problem = own, its
    if found.family is None or not problem.is_certain(found):
        return None
    none = np.zeros((0, dim))
    kept = problem.fitted(found.family, found.functions, none, np.zeros((1, 0)))  # areas are
    if not found.held_out < Options.gain * kept.held_out:
        return None
    found = problem.with_fewer_functions(found)
    return problem.as_learned(found)


def where_areas_differ(centres, scale, parameters: tuple[str, ...], jacobians) -> str:
    """Along which coordinate the factor of areas differs, as a sentence; "" where along none.

    centres: (n, 2d + k), the states at which the Jacobians are, and the ``parameters`` there.
    """
    factors = area_factors(jacobians, scale)
    explained, sentence = Options.explained, ""
    names = (*coordinate_names(len(scale) // 2), *parameters)
    for name, x in zip(names, np.asarray(centres).T, strict=True):
        fitted = np.polyval(np.polyfit(x - x.mean(), factors, 2), x - x.mean())
        share = 1 - np.var(factors - fitted) / np.var(factors)
        if share > explained:
            explained, ends = share, (np.argmin(fitted), np.argmax(fitted))
            low, high = (f"{fitted[i]:.3g} at {name} = {x[i]:.3g}" for i in ends)
            span = f"from {low} to {high}"
            sentence = f" Areas change by a factor that differs over phase space, {span}"
    return sentence


class _Fitted(NamedTuple):
    """b (t, k) by t functions of the args (one, 1, where there are none) and k degrees of freedom,
    with a root (t k, u) of its covariance, c (t, d), the RMS residual of held-out rows, which
    momentum has which factor (k, d), and which S."""

    factor: np.ndarray
    root: np.ndarray
    shift: np.ndarray
    held_out: float
    spread: np.ndarray
    family: Products | None = None
    functions: FunctionsOfArgs | None = None


@dataclasses.dataclass(frozen=True)
class _Problem:
    """The pairs, chart and half base map of the symplectic part, and rows × terms² of the largest
    solve."""

    data: Dataset
    chart: AnyChart
    half: Affine | None
    most_operations: float

    def best(self, spread: np.ndarray, factor: np.ndarray) -> _Fitted:
        """Degree of S, and of b in the args, which leaves least of the held-out rows.

        spread: (k, d), which of the k factors multiplies each momentum. factor: (1, k), the first
        guess.
        """
        unknown = np.full((factor.size, 0), np.inf)
        best, worse = _Fitted(factor, unknown, self._drift(np.zeros((1, 0))), np.inf, spread), 0
        for family in self._families(spread, factor):
            found = self.fitted(family, self._functions(family.degree), spread, best.factor)
            worse = 0 if found.held_out < Options.better * best.held_out else worse + 1
            best = found if worse == 0 else best
            if worse == Options.worse or best.held_out < Options.roundoff:
                break
        return best

    def with_fewer_functions(self, found: _Fitted) -> _Fitted:
        """The fewest functions of the args that leave as much of the held-out rows."""
        if found.functions is None:
            return found
        assert found.family is not None
        best, degree, enough = found, 0, found.family.degree
        as_little = max(Options.fewer * found.held_out, Options.at_roundoff)
        while degree < enough:
            middle = (degree + enough) // 2
            functions = self._functions(middle)
            fewer = self.fitted(found.family, functions, found.spread, found.factor)
            if fewer.held_out <= as_little:
                best, enough = fewer, middle
            else:
                degree = middle + 1
        return best

    def is_certain(self, found: _Fitted) -> bool:
        """Return whether some b, at the args of some pair, certainly is not 1."""
        t, k = found.factor.shape
        values = self._values(found.functions)
        error = np.linalg.norm(np.tensordot(values, found.root.reshape(t, k, -1), axes=1), axis=-1)
        return bool((np.abs(values @ found.factor - 1) > CERTAIN * error).any())

    def as_learned(self, found: _Fitted) -> LearnedDamping:
        """Damping that was found, without axes of length 1."""
        factor = found.factor
        std = np.linalg.norm(found.root, axis=1).reshape(factor.shape)
        b = self._values(found.functions) @ factor
        if factor.shape[1] == 1:
            factor, std, b = factor[:, 0], std[:, 0], b[:, 0]
        if len(factor) == 1:
            return LearnedDamping(
                np.asarray(factor[0]), np.asarray(std[0]), np.asarray(found.shift[0])
            )
        names, extremes = (
            self.data.parameters,
            (np.asarray(b.min(axis=0)), np.asarray(b.max(axis=0))),
        )
        return LearnedDamping(factor, std, found.shift, found.functions, names, extremes)

    def _families(self, spread, factor) -> Iterator[Products]:
        """Families by rising degree, those that the training rows determine in reasonable time."""
        undamped = self._undamped(_momenta(spread, factor), np.zeros(self.data.dim))
        rows = self.data.training
        w = rows_of(undamped, self.chart, rows)[0][0]
        angles, args = tuple(self._angles), undamped.given(rows)[1]
        inputs = box_inputs(w, angles=angles, cyclic=undamped.coordinates.cyclic, args=args)
        for degree in Options.degrees:
            family = Products(inputs, degree)
            terms = family.num_parameters
            if degree > Options.degrees[0] and (
                ROWS_PER_TERM * terms > w.size or w.size * terms**2 > self.most_operations
            ):
                return
            yield family

    def fitted(
        self,
        family: Products,
        functions: FunctionsOfArgs | None,
        spread: np.ndarray,
        factor: np.ndarray,
    ) -> _Fitted:
        """b, c and S by Gauss–Newton, from this b, as far as it has these functions, and c = 0."""
        values, k = self._values(functions), len(spread)
        t, a = values.shape[1], len(self._angles)
        known = factor[:t]
        factor = np.concatenate([known, np.zeros((t - len(known), k))])
        shift, unknown = np.zeros((t, a)), np.full((t * k, 0), np.inf)
        for _ in range(Options.updates):
            b, c = _momenta(spread, values @ factor), self._drift(values @ shift)
            if not (b > 0).all():
                return _Fitted(factor, unknown, self._drift(shift), np.inf, spread)
            undamped = self._undamped(b, c)
            terms, target = self._design(family, undamped, self.data.training)
            # By a pivoted QR, which takes a quarter of the time of singular values.
            solved: Any = scipy.linalg.lstsq(
                terms, target, lapack_driver="gelsy", check_finite=False
            )
            solved = solved[0]
            columns = self._columns(family, solved, undamped, spread, (b, c, values))
            # The unknowns of b and c, and a root of their covariance for independent residuals.
            rows = np.column_stack([terms, columns, target])
            triangle = np.asarray(np.linalg.qr(rows, mode="r"))
            own = triangle[terms.shape[1] :, terms.shape[1] :]
            inverse = np.linalg.pinv(own[:-1, :-1])
            deviation = abs(own[-1, -1]) / np.sqrt(max(1, len(rows) - len(triangle) + 1))
            change, root = inverse @ own[:-1, -1], deviation * inverse
            least = np.maximum(Options.close * np.linalg.norm(root, axis=1), Options.changed)
            if not (np.abs(change) > least).any():
                break
            factor = factor + change[: t * k].reshape(t, k)
            shift = shift + change[t * k :].reshape(t, a)
        held, wanted = self._design(family, undamped, self.data.validation)
        rms = float(np.sqrt(np.mean((held @ solved - wanted) ** 2)))
        drift = self._drift(shift)
        return _Fitted(factor, root[: t * k], drift, rms, spread, family, functions)

    def _design(self, family: Products, undamped: Dataset, rows) -> tuple[np.ndarray, np.ndarray]:
        """The terms' gradients (n, m) and what they must add up to (n,), each row without unit."""
        (w, target, *args), weight = rows_of(undamped, self.chart, rows)
        terms = family.term_gradients(w, *args) * weight[:, None]
        return terms.reshape(-1, terms.shape[-1]), (target * weight).ravel()

    def _columns(self, family: Products, solved, undamped: Dataset, spread, of_pairs) -> np.ndarray:
        """(n, t (k + a)): the derivatives of the residuals of ∇S in the coefficients of b and c,
        which move the momenta of D_b⁻¹Z = (Q, (P − c)/b). of_pairs: b, c and the functions of the
        args at the pairs."""
        dim, chart, dt, rows = self.data.dim, self.chart, undamped.dt, self.data.training
        (w, _, *args), weight = rows_of(undamped, chart, rows)
        b, c, values = (np.broadcast_to(x, (len(self.data), x.shape[-1]))[rows] for x in of_pairs)
        p = (split(self.data.y1[rows])[1] - c) / b
        each, angles = values[:, :, None, None], np.eye(dim)[self._angles]
        by_factor = -(p / b)[:, None, None, :] * each * spread
        by_shift = -each * angles / b[:, None, None, :]
        moved = np.concatenate([x.reshape(len(p), -1, dim) for x in (by_factor, by_shift)], axis=1)
        moved = np.concatenate([np.zeros_like(moved), moved], axis=-1)
        if self.half is not None:
            moved = moved @ np.linalg.inv(self.half.matrix).T
        none = np.zeros_like(moved)
        hessian = family.gradient_and_hessian(family.unflatten(solved), w, *args)[1]
        of_gradient = chart.evaluation_point(none, moved) @ hessian  # symmetric
        columns = weight * (of_gradient - chart.target_gradient(none, moved, dt))
        return np.swapaxes(columns, 1, 2).reshape(w.size, moved.shape[1])

    @property
    def _angles(self) -> list[int]:
        """The angles that S is periodic in: their momenta may drift."""
        coordinates, dim = self.data.coordinates, self.data.dim
        return [a for a in coordinates.angles if a < dim and a not in coordinates.cyclic]

    def _functions(self, degree: int) -> FunctionsOfArgs | None:
        """Functions of the pairs' args, where they have some."""
        args = self.data.args
        return None if args is None else FunctionsOfArgs.within(args, degree)

    def _values(self, functions: FunctionsOfArgs | None) -> np.ndarray:
        """(N, t) of the functions at the args of each pair; (1, 1) where there are none."""
        return np.ones((1, 1)) if functions is None else functions(self.data.args)

    def _drift(self, shift) -> np.ndarray:
        """(..., d) of the drifts (..., a) of the angles' momenta."""
        drift = np.zeros((*shift.shape[:-1], self.data.dim))
        drift[..., self._angles[: shift.shape[-1]]] = shift
        return drift

    def _undamped(self, b, c) -> Dataset:
        """The pairs of the symplectic part, without its base map."""
        found = self.data.without(None, Damping(b, c))
        return found if self.half is None else found.without(self.half, self.half)


def _momenta(spread, factor) -> np.ndarray:
    """b (..., d) of every momentum, of the factors (..., k); 1 where there are none."""
    return factor @ spread if len(spread) else np.ones((*factor.shape[:-1], spread.shape[1]))


NOT_SYMPLECTIC = "the pairs do not look symplectic"


class Diagnosis(NamedTuple):
    """data: without what was factored out. plain: without base map and law, yet without a
    ``damping`` of areas, where one was found."""

    data: Dataset
    plain: Dataset
    charts: Charts
    data_defect: float
    messages: list[str]
    damping: LearnedDamping | None = None


def lossy(data: Dataset, chart: str, reversor, seed: int) -> Diagnosis:
    """Diagnose whether pairs that differ in their args lose area; no chart is chosen yet."""
    jacobians, error = local_jacobians(data.y0, data.y1, data.scale, given_by(data), seed=seed)
    damping = learn_damping(data, jacobians, error, chart, reversor)
    return undiagnosed(data if damping is None else data.without(None, damping.piece), damping)


def undiagnosed(data: Dataset, damping: LearnedDamping | None = None) -> Diagnosis:
    """Data of which no chart is chosen yet: H, or a sum of terms, is looked for first."""
    return Diagnosis(data, data, Charts([], None, {}, []), float("nan"), [], damping)


def diagnosed(data: Dataset, chart: str, reversor, seed: int, may_lose: bool = False) -> Diagnosis:
    """Diagnose by the local Jacobians whether the pairs look symplectic, and which charts cover
    them; the base map is factored out where one is needed.

    may_lose: whether a map that loses area is looked for: its D_b is factored out too.
    """
    plain = data
    jacobians, error = local_jacobians(plain.y0, plain.y1, plain.scale, given_by(plain), seed=seed)
    defect, messages, damping = data_defect(jacobians, plain.scale), _thin(plain), None
    if may_lose:
        damping = learn_damping(plain, jacobians, error, chart, reversor)
    at = plain.y0 if plain.args is None else np.concatenate([plain.y0, plain.args], axis=1)
    places = centres(at, jacobians, seed)
    differing = partial(where_areas_differ, places, plain.scale, plain.parameters)
    if damping is not None:
        undone = damping.undone(jacobians)
        if data_defect(undone, plain.scale) > Options.errors * error:
            where = differing(jacobians) or " No coordinate tells where by itself"
            damping = dataclasses.replace(damping, differs=where)
        jacobians, plain = undone, plain.without(None, damping.piece)
        data = plain
    elif not look_symplectic(jacobians, error, plain.scale):
        messages.append(
            f"{NOT_SYMPLECTIC}: ‖MᵀJM − J‖ is {defect:.2g} ± {error:.1g} (M: local "
            "Jacobians, coordinates in units of their spread) where a symplectic map has 0. Check "
            "the order q1…qd, p1…pd, and look for friction or a drive. If p are velocities, learn "
            "the law of a recording (--positions, --velocities; gfnn.Recording)."
            + differing(jacobians)
        )
    charts = choose_charts(chart, data, reversor, jacobians)
    if charts.half is not None:
        data = data.without(charts.half, charts.half)
    return Diagnosis(data, plain, charts, defect, [*messages, *charts.messages], damping)


def _thin(data: Dataset) -> list[str]:
    """A warning where the states lie on a curve, or on the torus of an orbit."""
    entering = [i for i in range(2 * data.dim) if i not in data.coordinates.cyclic]
    dimension = sampled_dimension(data.y0[:, entering], data.scale[entering])
    if dimension > min(data.dim, len(entering) - 1):
        return []
    where = "a curve" if dimension == 1 else f"a surface of dimension {dimension}"
    return [
        f"the pairs lie on {where} of the {len(entering)}-dimensional phase space, as those of one "
        "orbit do. The map is learned there only: other initial states widen it"
    ]
