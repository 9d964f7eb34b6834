"""The law ż = B(z)∇H(z) of pairs, the bracket B found too or given.

field of rising degree through its flow → is it determined by these runs? → brackets by kinds →
H modulo Casimirs → H once more through the flow. NumPy.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Iterator
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from scipy.integrate import cumulative_simpson

from gfnn_jax.brackets import Bracket, canonical
from gfnn_jax.errors import FitError
from gfnn_jax.families.terms import Terms
from gfnn_jax.fitting.triangle import Spectrum
from gfnn_jax.models.brackets.arcs import arcs_of, equal_arcs, fit_arcs, lagged
from gfnn_jax.models.brackets.beside import NOTHING, Beside
from gfnn_jax.models.brackets.fields import (
    Field,
    FieldFit,
    FreeField,
    Partials,
    fit_field,
    flow,
    substeps_of,
    undetermined,
)
from gfnn_jax.models.brackets.find import Found, brackets_of, library_of, polynomials, upright
from gfnn_jax.models.brackets.null_space import (
    CONSTANT,
    LINEAR,
    LOG,
    NullSpace,
    null_spaces,
    shrinking,
)
from gfnn_jax.models.brackets.poisson_field import PoissonField, hamiltonian_of, with_shapes
from gfnn_jax.phase_space import sizes
from gfnn_jax.signals.noise import noise


class Options:
    """Options of the search for a bracket (benchmarks/brackets.py)."""

    degrees: tuple[int, ...] = (1, 2, 3, 4)  # of the field
    given_degrees: tuple[int, ...] = (1, 2, 3, 4, 6)  # of H, where the bracket is given
    rows_per_term: float = 1.5  # pairs for each function of the library, at least
    exact: float = 1e-10  # of the spread: what a field without noise or misfit leaves at most
    printed: float = 1e-6  # the same of numbers that were printed, of pairs with parameters
    solved: float = 1e-5  # the same of states whose errors are a solver's, smooth and no noise
    better: float = 0.9  # of the error on held-out pairs: what a higher degree must lower it to
    partly: float = 1e-2  # of the spread: an error of a field that is a start at all
    states: int = 400  # at which the field is analysed
    draws: int = 12  # of the field's coefficients, by their covariance
    # standard errors of the field, that what is no bracket or no term may have
    errors: float = 3.0
    # of sequences with noise: h‖f'‖ of the steps that the field is fitted over, the fewest states,
    # and times the residual of one step, that those steps may leave
    long: float = 0.6
    fewest: int = 8
    grown: float = 1.6
    # of states with noise: parts of a run, and χ² per degree of freedom of H in these, at most
    parts: int = 8
    # of the square of what H changes by across the states: a variance of H that is none
    level: float = 1e-4
    uneven: float = 4.0
    most_terms: int = 40  # of a richer H, that arcs with noise are asked about
    dependent: float = 1e-3  # singular value of unit gradients: of functions of one another
    hidden: float = 2.0  # times what noise makes of a relation: one that noise may hide
    standard: int = 1  # brackets of which H is looked for among shapes
    # times the error of the free field, that a Poisson field may leave
    worse: float = 3.0
    seed: int = 0


ONE_LEVEL = (
    "H has one value along all runs, and every function of H with the same slope there moves them "
    "so: add runs that start at other values of H"
)


class Data(NamedTuple):
    """Pairs: states z0, z1 (N, n), with what H depends on beside them behind them, dt a number or
    (N,), their run and place along it (N,). spread: (n,) of all pairs, of which these are some.
    beside: what H depends on, of all of them."""

    z0: np.ndarray
    z1: np.ndarray
    dt: Any
    run: np.ndarray
    place: np.ndarray
    spread: np.ndarray
    beside: Beside = NOTHING

    def take(self, rows) -> Data:
        """The pairs of these rows."""
        dt = self.dt[rows] if np.ndim(self.dt) else self.dt
        z0, z1, run, place = (a[rows] for a in (self.z0, self.z1, self.run, self.place))
        return Data(z0, z1, dt, run, place, self.spread, self.beside)


class PoissonLaw(NamedTuple):
    """ż = B∇H. field: with the terms of H that count. fit: of their coefficients. error: RMS on
    held-out pairs ÷ spread. name: of the bracket's kind. notes: lines about what was found. sigma:
    (n,) noise of the states, where sequences were fitted; of their logarithms where ``relative``.
    several: why other laws may have made the pairs too, else "".
    """

    field: PoissonField
    fit: FieldFit
    error: float
    name: str
    notes: tuple[str, ...]
    sigma: np.ndarray | None = None
    several: str = ""
    relative: bool = False

    def noise_of(self, z: np.ndarray) -> np.ndarray:
        """Noise (N, n) of states z (N, n); zeros where no sequences were fitted."""
        if self.sigma is None:
            return np.zeros_like(z)
        return self.sigma * (np.abs(z) if self.relative else np.ones_like(z))

    @property
    def bracket(self) -> Bracket:
        return self.field.bracket


def error_on(field: Field, c: np.ndarray, held: Data) -> float:
    """RMS of the images' errors on held-out pairs ÷ their spread."""
    images = flow(field, c, held.z0, held.dt, substeps_of(field, c, held.z0, held.dt)).images
    error = np.sqrt(np.mean(((images - held.z1) / held.spread) ** 2))
    return float(error) if np.isfinite(error) else np.inf


def law_of(
    train: Data,
    held: Data,
    names: tuple[str, ...],
    *,
    bracket: Bracket | None = None,
    terms: Terms | None = None,
    on_progress: Callable[[str], Any] = lambda message: None,
) -> PoissonLaw:
    """The law of these pairs. held: pairs that choose the degree of the field. names: of the n
    coordinates.

    bracket: a known one; None: it is found. terms: of H, where they are known; None: polynomials,
    and logarithms for log-canonical brackets.

    Raises FitError where the runs do not determine a field, no field has the pairs' flow, or it has
    no bracket: with a verdict, and the nearest singular value.
    """
    if bracket is None:
        law = _of_field(train, held, names, terms, on_progress)
    else:
        law = _of_bracket(bracket, train, held, terms, on_progress)
    if not train.beside.names and law.field.friction is None and _one_level(law, train.z0):
        level = ONE_LEVEL.replace("H has", "H + a Casimir has", bool(law.bracket.casimirs))
        law = law._replace(several=level)
    return law


def _one_level(law: PoissonLaw, z: np.ndarray) -> bool:
    """Return whether H, with Casimirs added, has the same value at all states z (N, n), to their
    noise."""
    h, by_noise = _energies(law, z)
    slopes, casimirs = law.field.library.gradient(law.fit.c, z), law.bracket.casimirs
    if casimirs:
        values = np.stack([c(z) for c in casimirs], axis=1)
        weights = np.linalg.lstsq(values - values.mean(axis=0), h - h.mean(), rcond=1e-9)[0]
        h = h - values @ weights
        parts = (w * c.gradient(z) for w, c in zip(weights, casimirs, strict=True))
        by_noise = np.sqrt(np.sum(((slopes - sum(parts)) * law.noise_of(z)) ** 2, axis=1))
    return on_one_level(h, by_noise, slopes, sizes(z))


def on_one_level(
    h: np.ndarray, by_noise: np.ndarray, slopes: np.ndarray, spread: np.ndarray
) -> bool:
    """Return whether H (N,) is one value but for its noise (N,), beside what slopes (N, n) make
    along the spread (n,) of each coordinate: every f(H) of the same slope there moves alike."""
    across = np.mean(np.sum((slopes * spread) ** 2, axis=-1))
    return bool(np.var(h) - np.mean(by_noise**2) <= Options.level * across)


def _energies(law: PoissonLaw, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """H (N,) at states z (N, n), and what their noise makes of it."""
    library, c = law.field.library, law.field.of_h(law.fit.c)
    return library.value(c, z), of_noise(*library.gradient_and_hessian(c, z), law.noise_of(z))


def of_noise(slopes: np.ndarray, bends: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """Return what noise (N, n) of states makes of H, (N,), to second order: near an equilibrium H
    has no slope."""
    first = np.sum((slopes * sigma) ** 2, axis=-1)
    second = 0.5 * np.sum((bends * sigma[:, :, None] * sigma[:, None]) ** 2, axis=(-2, -1))
    return np.sqrt(first + second)


def _of_field(train: Data, held: Data, names, terms: Terms | None, on_progress) -> PoissonLaw:
    """The law of a field whose bracket is found."""
    n, more = len(names), train.beside.names
    field, fit, error, notes, factors = _free_field(train, held, names, terms, on_progress)
    degree = _degree(field, n)
    if error > Options.printed and more:
        raise FitError(
            f"the field of degree {degree} with {', '.join(more)} leaves {error:.1e} of the "
            "spread, which is misfit or noise; only pairs without noise tell how a law with a "
            "bracket depends on parameters or a drive. Where H has other terms, give them and the "
            "bracket: gfnn.fit(pairs, bracket=…, terms=[…])",
            f"no law: the field with {', '.join(more)} leaves {error:.1e} of the spread",
        )
    if error > Options.exact and terms is None and not more:
        sigma = _noise_of(train, fit)
        law = _of_populations(train, held, names, sigma, error)
        if law is not None:
            return law
        hidden = _hidden_relations(train, names, sigma)
        if hidden:
            raise _too_few_runs(hidden + 1, 2, len(np.unique(train.run)))
    noisy = None if more else _noise(field, fit, error, train)
    free = terms is None and not more and error > Options.exact and not np.ndim(train.dt)
    free = free and _several_steps(field, fit, train) >= Options.fewest
    while free and noisy is None and degree < Options.degrees[-1]:
        try:  # terms that one step does not show
            higher = _free_field(train, held, names, None, on_progress, degree + 1)
        except FitError:
            break
        degree, noisy = _degree(higher[0], n), _noise(*higher[:3], train)
        field, fit, error, notes, _ = higher if noisy else (field, fit, error, notes, None)
    fit = fit if noisy is None else noisy.fit
    if noisy is None and error > Options.exact and terms is None and not more:
        law = _without_polynomials(train, held, names, on_progress)
        if law is not None:
            return law._replace(notes=notes)
    some = train.z0[:: max(1, len(train.z0) // Options.states)]
    f, slope = _at(field, fit.c, some, n)
    rng = np.random.default_rng(Options.seed)
    drawn = [rng.normal(size=len(fit.root)) @ fit.root for _ in range(Options.draws)]
    draws = [_at(field, c, some, n) for c in drawn]
    off = [np.mean((one[0] / sizes(f)) ** 2) for one in draws]
    unsure = float(np.sqrt(np.mean(off)))
    nearest: dict[str, float] = {}
    missed: list[str] = []  # brackets whose laws do not leave noise alone
    shrunk: list[str] = []
    for null in _nulls(some[:, :n], f, slope, draws, noisy is None):
        kind = null.tensors.kind
        if not null.rate:
            nearest[kind] = null.nearest
        elif len(null.vectors) and null.rate > 0:
            shrunk.append(f"{null.rate:.4g}")
        on_progress(f"{kind} brackets: {len(null.vectors)}, the nearest at {null.nearest:.1e}")
        if not len(null.vectors) or (null.rate and kind == LOG):
            continue
        library = library_of(kind, names, degree, terms, factors)
        for found in brackets_of(null, some, f, library, Options.errors * unsure):
            missed.append(found.name)
            try:
                law = _through_flow(found, train, held, notes, noisy)
            except FitError:
                continue
            law = law if noisy is None else _richer(law, noisy, train, held)
            close = law.error <= max(Options.worse * error, Options.exact)
            if close and (noisy is None or _leaves_noise(law, noisy.sigma, train, held)):
                return law
    if missed:
        raise FitError(
            f"no law: within its errors the field has a bracket ({', '.join(dict.fromkeys(missed))}"
            "), but no H of it leaves noise alone and is constant along the runs. Other forces may "
            "act, or more runs are needed",
            "no law: no H of a bracket leaves noise alone",
        )
    more = "" if noisy is None else ". With noise more runs may show one"
    if shrunk:
        more = (
            f". Bivectors shrink at the rates {', '.join(dict.fromkeys(shrunk))}, as by uniform "
            "friction, but no H of this library goes with them: name its terms (--terms)"
        )
    values = ", ".join(f"{value:.2g} ({kind})" for kind, value in nearest.items())
    raise FitError(
        f"no bracket: L_f B = 0 has no solution among these, the nearest singular value being "
        f"{values}, where 0 is a bracket. The field of degree {degree} leaves {error:.1e} "
        f"of the spread{more}",
        f"no law: no bracket, nearest singular value {min(nearest.values()):.2g}",
    )


def _nulls(z, f, slope, draws, clean: bool) -> Iterator[NullSpace]:
    """Null spaces of L_f, and those of uniform friction."""
    yield from null_spaces(z, f, slope, draws)
    for rate in shrinking(z, f, slope, clean):
        yield from null_spaces(z, f, slope, draws, rate)


def _at(field: FreeField, c: np.ndarray, z: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Rates (N, n) of the coordinates, and their derivatives in these (N, n, n)."""
    return field.rate(c, z)[:, :n], field.jacobian(c, z)[:, :n, :n]


def _degree(field: FreeField, n: int) -> int:
    """Total degree in the coordinates, which are the first n variables, of a field of polynomials;
    1 of others."""
    own = field.library
    return 1 if isinstance(own, Partials) else max(sum(row[:n]) for row in own.powers)


def _free_field(train, held, names, terms, on_progress, least: int = 1):
    """(field, its fit, its error on held-out pairs, notes, functions of what is beside the state):
    of the smallest degree from ``least`` on that a higher one does not beat."""
    best, notes = None, ()
    if terms is not None:
        field = FreeField(Partials.of(terms, train.z0))
        fit = fit_field(field, *train[:3])
        best = field, fit, error_on(field, fit.c, held)
        if best[2] <= Options.exact:
            return (*best, (), None)
    kept = None
    degrees = [degree for degree in Options.degrees if degree >= least]
    for degree, factors in product(degrees, tuple(train.beside.factors(names))):
        library = polynomials(names, degree, constant=True, factors=factors)
        if library.num_parameters * Options.rows_per_term > len(train.z0):
            continue
        field, missing = FreeField(library), ()
        relations = undetermined(field, train.z0)
        if len(relations):
            field = FreeField(library.take(range(1, library.num_parameters)))
            missing = undetermined(field, train.z0)
        if len(missing):
            if best is not None and best[2] <= Options.partly:
                break
            functions = _independent(library, relations, train.z0)
            raise _too_few_runs(functions, degree, len(np.unique(train.run)))
        on_progress(f"a field of degree {degree}, {field.num} coefficients")
        try:
            fit = fit_field(field, *train[:3])
        except FitError:
            continue
        error = error_on(field, fit.c, held)
        if best is None or error <= Options.better * best[2]:
            best, kept = (field, fit, error), factors
            notes = (_SHELL.format(count=len(relations)),) if len(relations) else ()
        if error <= Options.exact:
            break
    if best is None:
        raise FitError(
            f"{len(train.z0)} pairs gave no field of degree 1 or 2: add pairs, or take a shorter dt"
        )
    return (*best, notes, kept)


_SHELL = (
    "all states lie on one surface ({count} function of the state is the same in every run): off "
    "it the law is not determined by these data"
)


def _noise_of(train: Data, fit: FieldFit) -> np.ndarray:
    """Noise (n,) of the states, at most: what local polynomials and the field leave."""
    left = np.sqrt(np.mean(fit.residual**2, axis=0) / 2)
    return np.fmin(_white(arcs_of(train.z0, train.z1, train.run, train.place)), left)


def _white(sequences: list[np.ndarray]) -> np.ndarray:
    """Noise (n,) that local polynomials leave of sequences (L, n); NaN of short ones."""
    times = [np.arange(float(len(s))) for s in sequences]
    known = [one.sigma for one in noise(times, np.concatenate(sequences).T)]
    return np.array([np.nan if s is None else s for s in known])


def _hidden_relations(train: Data, names: tuple[str, ...], sigma: np.ndarray) -> int:
    """Number of relations, beyond one, among functions of degree 2 that noise hides."""
    library = polynomials(names, 2)
    values = library.term_values(train.z0)
    found = Spectrum.of(values, values[:, 0], 0.0, 0.0)
    slopes = np.einsum("njk,mk->nmj", library.term_gradients(train.z0), found.vt / found.column)
    by_noise = np.sqrt(np.sum((slopes * sigma) ** 2, axis=(0, 2)))
    return int(np.sum(found.s <= Options.hidden * by_noise))


def _of_populations(train: Data, held: Data, names, sigma, error: float) -> PoissonLaw | None:
    """The law of one kind of predators and one of prey: {x, y} = x y, and one orbit with noise
    determines H of x, y and their logarithms. The noise is of one size, or in proportion to the
    states, in whose logarithms the same H is fitted then: the likelier first. None of other states,
    and where it leaves more than their noise, or H is not the same in all parts of a run. error: of
    the field without structure, which a law that leaves a solver's errors alone does not exceed."""
    z = np.concatenate([train.z0, train.z1])
    if z.shape[1] != 2 or (z <= 0).any() or np.ndim(train.dt):
        return None
    bracket, library = Bracket.log([[0, 1], [-1, 0]], names), library_of(LOG, names, 1, None)
    field = PoissonField(bracket, library)
    sequences = arcs_of(train.z0, train.z1, train.run, train.place)
    middle, rate = 0.5 * (train.z0 + train.z1), (train.z1 - train.z0) / train.dt
    start = hamiltonian_of(field, middle, rate).c
    own = fit_arcs(field, start, equal_arcs(sequences), train.dt, sigma)
    logs = [np.log(states) for states in sequences]
    relative, places = _white(logs), library.term_names
    tried = [(np.log(own.left).sum(), own, sigma)]
    if np.isfinite(relative).all():
        start = np.zeros(len(places))
        start[[places.index(name) for name in own.field.library.term_names]] = own.c
        variables = (*(f"exp({name})" for name in names), *names)  # as those of H: z, log z
        in_logs = Terms(0, variables, library.powers, (), names)
        standard = PoissonField(canonical(1).named(names), in_logs)
        own = fit_arcs(standard, start, equal_arcs(logs), train.dt, relative)
        kept = [in_logs.term_names.index(name) for name in own.field.library.term_names]
        unit = np.log(z).mean(axis=0).sum()  # of the density of a state by that of its logarithm
        own = own._replace(field=field.take(kept))
        tried.append((np.log(own.left).sum() + unit, own, relative))
    for _, own, sigma in sorted(tried, key=lambda one: one[0]):
        if not own.field.library.gradient(own.c, z).any(axis=0).all():
            continue  # one of the populations would never change
        fit = FieldFit(own.c, np.zeros(0), np.nan, own.root, own.field)
        fits = own.field, fit, error_on(own.field, own.c, held)
        law = PoissonLaw(*fits, bracket.name, (), own.sigma, relative=sigma is relative)
        left = law.noise_of(train.z0)
        part = float(np.mean(np.sqrt(np.mean(left**2, axis=0)) / train.spread))
        law = law._replace(fit=law.fit._replace(residual=left, relative=part))
        close = law.error <= min(Options.solved, Options.worse * error)
        if close or _leaves_noise(law, sigma, train, held):
            return law
    return None


def _leaves_noise(law: PoissonLaw, sigma: np.ndarray, train: Data, held: Data) -> bool:
    """Return whether a law leaves no more than the noise (n,) of the states, and has the same H in
    all parts of a run, to the errors of its coefficients, with what its friction took added. Arcs
    tell no drift of H: each has an H of its own."""
    if law.sigma is None or (law.sigma > Options.grown * sigma).any():
        return False
    z, run, place = (
        np.concatenate([getattr(data, key) for data in (train, held)])
        for key in ("z0", "run", "place")
    )
    total, count, damped = 0.0, 0, law.field.friction is not None
    for own in (run == r for r in np.unique(run)):
        order = np.argsort(place[own])
        states, breaks = z[own][order], np.flatnonzero(np.diff(place[own][order]) != 1) + 1
        for stretch in np.split(states, breaks) if damped else (states,):
            if len(stretch) < 2 * Options.parts * damped:
                continue
            _, errors = _energies(law, stretch)
            parts = np.array_split(np.arange(len(stretch)), min(Options.parts, len(stretch)))
            weights = [errors[part] ** -2.0 for part in parts]
            terms, kept = _kept(law, stretch, train.dt)
            means = np.array(
                [np.average(terms[i], 0, w) for i, w in zip(parts, weights, strict=True)]
            )
            by_law = (means - means.mean(axis=0)) @ law.fit.root[:, : terms.shape[1]].T
            covariance = np.diag([1 / np.sum(w) for w in weights]) + by_law @ by_law.T
            both = np.stack([means @ kept, np.ones(len(parts))], axis=1)
            h, one = np.linalg.solve(np.linalg.cholesky(covariance), both).T
            total += h @ h - (h @ one) ** 2 / (one @ one)
            count += len(parts) - 1
    return total <= Options.uneven * max(count, 1)


def _kept(law: PoissonLaw, z: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """H and what friction took since the first of states z (N, n), as terms (N, J) and their
    coefficients (J,): c_j (φ_j + ∫ ∇φ_j·Ez dt), and ∫ ∇H·E_k z dt whose coefficients are 0, for it
    is in the others."""
    field, c = law.field, law.fit.c
    library, own = field.library, field.of_h(c)
    terms = library.term_values(z)
    if field.friction is None:
        return terms, own
    forces = -field.columns(z)[..., len(own) :]  # E_k z
    slopes = library.term_gradients(z)
    lost = np.einsum("nij,nik,k->nj", slopes, forces, c[len(own) :])
    by_rate = np.einsum("nij,j,nik->nk", slopes, own, forces)
    taken = cumulative_simpson(np.hstack([lost, by_rate]), dx=dt, axis=0, initial=0.0)
    terms = np.hstack([terms, np.zeros_like(by_rate)]) + taken
    return terms, np.append(own, np.zeros(by_rate.shape[1]))


def _too_few_runs(missing: int, degree: int, runs: int) -> FitError:
    named = f"{runs} run{'s' * (runs > 1)}"
    return FitError(
        f"fewer orbits than determine the law: {missing} functions of degree {degree} are constant "
        f"on all of {named}, as energies and Casimirs are. Add {missing} or "
        "more runs that start at other values of these",
        f"no law: {named} do{'es' * (runs == 1)} not determine it",
    )


def _independent(library: Terms, relations: np.ndarray, z: np.ndarray) -> int:
    """Number of independent functions among relations (m, K) of the library at states z (N, n)."""
    some = z[:: max(1, len(z) // Options.states)]
    slopes = library.term_gradients(some) @ relations.T * sizes(z)[:, None]
    slopes = slopes / np.linalg.norm(slopes, axis=1, keepdims=True)
    ranks = np.linalg.matrix_rank(slopes, tol=Options.dependent)
    return int(np.median(ranks))


class _Noisy(NamedTuple):
    """Sequences with noise: their states, the pairs that lie several steps apart, the free field of
    these, and the noise (n,)."""

    sequences: list[np.ndarray]
    long: tuple[np.ndarray, np.ndarray, float]
    fit: FieldFit
    sigma: np.ndarray


def _noise(field: FreeField, fit: FieldFit, error: float, train: Data) -> _Noisy | None:
    """Noise of sequences: residuals that do not grow with the time between states.
    None of pairs without noise, of single pairs, and where the field itself misses."""
    if error <= Options.exact or np.ndim(train.dt):
        return None
    sequences = arcs_of(train.z0, train.z1, train.run, train.place)
    steps = _several_steps(field, fit, train)
    sequences = [s for s in sequences if len(s) >= Options.fewest]
    steps = min(steps, max(map(len, sequences), default=4) // 2)
    if not sequences:
        return None
    z0, z1 = lagged(sequences, steps)
    long = z0, z1, steps * train.dt
    again = fit_field(field, *long, fit.c)
    if again.relative > Options.grown * fit.relative:
        return None
    sigma = np.sqrt(np.mean(fit.residual**2, axis=0) / 2)
    return _Noisy(sequences, long, again, sigma)


def _several_steps(field: FreeField, fit: FieldFit, train: Data) -> int:
    """Number of steps over which the field is fitted to states with noise."""
    some = train.z0[:: max(1, len(train.z0) // Options.states)]
    rates = np.abs(field.jacobian(fit.c, some)).sum(axis=2).max(axis=1) * train.dt
    return max(2, int(Options.long / np.median(rates)))


def _richer(law: PoissonLaw, noisy: _Noisy, train: Data, held: Data) -> PoissonLaw:
    """The law with terms of two more degrees, where whole arcs show them: the noise of a step, by
    which the field's degree was chosen, hides a period that changes with the energy. Of brackets
    without Casimirs, which would hide such terms, and of few terms."""
    bracket, own = law.bracket, law.field.library
    degree = max(map(sum, own.powers))
    library = library_of(_kind_of(bracket), bracket.labels, degree + 1, None)
    if bracket.casimirs or library.num_parameters > Options.most_terms:
        return law
    places = dict(zip(library.term_names, range(library.num_parameters), strict=True))
    if not set(own.term_names) <= set(places):
        return law
    field = PoissonField(bracket, library, law.field.friction)
    c, arcs = np.zeros(field.num), equal_arcs(noisy.sequences)
    kept = [*(places[name] for name in own.term_names), *range(len(places), field.num)]
    c[kept] = law.fit.c
    rich = fit_arcs(field, c, arcs, train.dt, noisy.sigma)
    more = rich.field.num - law.field.num
    gain = arcs.shape[0] * arcs.shape[1] * np.sum(np.log(law.sigma / rich.sigma))
    if gain <= 0.5 * max(more, 1) * np.log(arcs.size) + np.log(len(c)):
        return law
    fit = law.fit._replace(c=rich.c, root=rich.root)
    error = error_on(rich.field, rich.c, held)
    several = f"its terms of degree {degree + 1} or more may be the series of another function"
    return PoissonLaw(rich.field, fit, error, law.name, law.notes, rich.sigma, several)


def _through_flow(
    found: Found, train: Data, held: Data, notes: tuple[str, ...], noisy: _Noisy | None
) -> PoissonLaw:
    """The law with the coefficients of H fitted through the flow of B∇H; with noise along arcs, the
    constants of the bracket too. Raises FitError where no fit is found."""
    kept = np.flatnonzero(found.hamiltonian.c).tolist()
    field, sigma = found.field.take(kept), None
    if not field.library.num_parameters:
        raise FitError(f"no H of the {found.name} bracket is told from none")
    pairs = train[:3] if noisy is None else noisy.long
    fit = fit_field(field, *pairs, found.hamiltonian.c[kept])
    if noisy is not None:
        arcs = equal_arcs(noisy.sequences)
        own = fit_arcs(field, fit.c, arcs, train.dt, noisy.sigma)
        field, sigma = own.field, own.sigma
        fit = fit._replace(c=own.c, root=own.root)
    if found.several > 1:
        note = f"one of a family of {found.several}"
        bracket: Any = field.bracket
        field = dataclasses.replace(field, bracket=dataclasses.replace(bracket, note=note))
        notes = (
            *notes,
            f"one of a family of {found.several} brackets, each of which makes the same motion "
            f"with an H of its own: {found.rule} was taken",
        )
    if field.friction is not None:
        shrinks = float(fit.c[field.library.num_parameters :] @ field.friction.rates)
        rate = f"{shrinks:.8g}" if noisy is None else f"{shrinks:.3g}"
        notes = (
            *notes,
            f"uniform friction: the flow multiplies the bracket by exp(−{rate} t), t in the unit "
            "of dt; Casimirs, which friction alone moves, change too",
        )
    return PoissonLaw(field, fit, error_on(field, fit.c, held), found.name, notes, sigma)


def _kind_of(bracket: Bracket) -> str:
    if hasattr(bracket, "constants"):
        return LINEAR
    return LOG if bracket.name == "log-canonical" else CONSTANT


def _of_bracket(bracket, train, held, terms, on_progress) -> PoissonLaw:
    """H of a known bracket: polynomials of the smallest degree that a higher one does not beat, or,
    where none is exact, shapes of single coordinates beside the quadratic terms."""
    best = None
    sizes_of_h = product(Options.given_degrees, tuple(train.beside.factors(bracket.labels)))
    for degree, factors in sizes_of_h if terms is None else ((1, None),):
        library = library_of(_kind_of(bracket), bracket.labels, degree, terms, factors)
        if library.num_parameters * Options.rows_per_term > train.z0.size:
            continue
        on_progress(f"H of {library.num_parameters} terms")
        try:
            law = _of_library(bracket, library, train, held)
        except FitError:
            continue
        if best is None or law.error <= Options.better * best.error:
            best = law
        if law.error <= Options.exact:
            return law
    if best is None:
        raise FitError(f"no H of the library has a flow near these {len(train.z0)} pairs")
    if terms is None and not train.beside.names:
        shaped = _of_shapes(bracket, train, held, on_progress)
        best = min((best, shaped), key=lambda law: law.error) if shaped else best
    return best


def _of_library(bracket: Bracket, library: Terms, train: Data, held: Data) -> PoissonLaw:
    """H of these terms, through the flow, without those that Casimirs make superfluous."""
    middle, h = 0.5 * (train.z0 + train.z1), np.reshape(train.dt, (-1, 1))
    field = PoissonField(bracket, library)
    start = hamiltonian_of(field, middle, (train.z1 - train.z0) / h)
    fit = fit_field(field, *train[:3], start.c)
    return _lean(bracket, library, fit.c, train, held)


def _lean(bracket, library, c, train: Data, held: Data) -> PoissonLaw:
    """The law of coefficients c, of all that differ by Casimirs the one of fewest terms."""
    some = train.z0[:: max(1, len(train.z0) // Options.states)]
    field = PoissonField(bracket, library)
    own = hamiltonian_of(field, some, field.rate(c, some))
    kept = np.flatnonzero(own.c).tolist()
    field = field.take(kept)
    fit = fit_field(field, *train[:3], own.c[kept])
    return PoissonLaw(field, fit, error_on(field, fit.c, held), bracket.name, ())


def _of_shapes(bracket, train: Data, held: Data, on_progress) -> PoissonLaw | None:
    """H of quadratic terms and shapes; None where there is none."""
    base = library_of(_kind_of(bracket), bracket.labels, 2, None)
    try:
        return _lean(bracket, *with_shapes(bracket, base, train[:3], on_progress), train, held)
    except FitError:
        return None


def _without_polynomials(train, held, names, on_progress) -> PoissonLaw | None:
    """The law of a standard bracket whose H is no polynomial: of the bracket whose quadratic H
    misses least. None where no H is exact."""
    tried = []
    n = len(names)
    standard: list[Bracket] = [Bracket.so3(n // 3, names=names)] if n % 3 == 0 else []
    standard += [Bracket.se3(names=names)] if n == 6 else []
    standard += [] if n % 2 else [canonical(n // 2).named(names)]
    for bracket in standard:
        base = library_of(_kind_of(bracket), names, 2, None)
        with contextlib.suppress(FitError):
            tried.append((_of_library(bracket, base, train, held).error, bracket))
    for _, bracket in sorted(tried, key=lambda one: one[0])[: Options.standard]:
        on_progress(f"{bracket.name}: an H that is no polynomial")
        law = _of_shapes(bracket, train, held, on_progress)
        if law is not None and law.error <= Options.exact:
            library = law.field.library
            turned, c = upright(bracket, library, law.fit.c, train.z0)
            return law._replace(field=PoissonField(turned, library), fit=law.fit._replace(c=c))
    return None
