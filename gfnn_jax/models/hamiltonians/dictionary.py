"""Laws of physics, tried before libraries of terms: see `models.textbook.search`, `noisy_search`.

What the search finds behind clean pairs is fitted through its flow as any library is, and taken
where held-out pairs bear it out to the tolerance: an H of few terms, with the constants inside
them, or none at all. What it finds behind noisy sequences is fitted to whole ones: coefficients,
constants inside and latent states together, and behind noisy pairs, which are sequences of two
states, likewise. Among the laws within the noise the one of least
description length is taken,

    Σ_i n_i ln σ_i + ½ k ln n + what there is to say of its atoms,

σ_i what it leaves over of each coordinate (n_i numbers more than its latent states have), k its own
numbers (Rissanen 1978).
"""

import contextlib
import dataclasses
from functools import partial
from typing import NamedTuple

import numpy as np

from gfnn_jax.budget import FLOW, MATCHING
from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.dataset.rows import of_differences
from gfnn_jax.dataset.runs import next_of
from gfnn_jax.errors import InputError
from gfnn_jax.families.expressions import coordinate_names
from gfnn_jax.families.terms import Terms
from gfnn_jax.fitting.evidence import EVIDENCE, Rival
from gfnn_jax.fitting.significance import terms_with_constants
from gfnn_jax.flows.collocation import Steps, operations
from gfnn_jax.flows.uniform import Uniform, momenta
from gfnn_jax.models.hamiltonians.fitted_law import FittedLaw, PartialLaw, Term
from gfnn_jax.models.hamiltonians.fitted_law import formula as formula_of
from gfnn_jax.models.hamiltonians.problem import LawProblem
from gfnn_jax.models.hamiltonians.sequences import OPTIONS as ARCS
from gfnn_jax.models.hamiltonians.sequences import (
    Measured,
    Sequences,
    covariance_root_of,
    noise_of,
    summary_of,
    triangle_of,
)
from gfnn_jax.models.hamiltonians.symmetries import LawNumbers, restricted
from gfnn_jax.models.textbook.noisy_search import (
    Formula,
    NoisyTextbook,
    WeakGradients,
    gradients_of_pairs,
    weak_gradients,
)
from gfnn_jax.models.textbook.noisy_search import Options as Noisy
from gfnn_jax.models.textbook.search import Law, Textbook
from gfnn_jax.models.textbook.search import Options as Clean
from gfnn_jax.solve.latent_arcs import Fitted
from gfnn_jax.solve.linear import covariance_root
from gfnn_jax.solve.noise import robust


@dataclasses.dataclass(frozen=True)
class DictionaryOptions:
    """Tuned on the laws of benchmarks/textbook.py, and of textbook_noise.py.

    dictionaries: of clean pairs, name, contents, and operations of a search by degrees of freedom
    from 1, in the order in which they are tried: about the longest of the laws. fewest: pairs.
    nothing: of the largest term, one so small is roundoff. shown: of a coefficient of a partial
    law, what is not shown of it. exact: of the spread, the error of a law that is no approximation.

    Behind noise: operations: of a search, by degrees of freedom from 1. least: of the spread, less
    noise than that is not what weak gradients leave over. looked_at: rows by which laws are
    compared; compared: of pairs, by which atoms are. behind: natural logarithms of likelihood by
    which a law is behind that is not fitted; brought: that further terms must bring. fitted: laws.
    evaluations: of the flow at each state, that the fits of a law to sequences take together.
    screened, iterations: part of the cost from which one counts, and how many, while laws are
    compared. as_noise: times the noise, that a law may leave over.
    """

    dictionaries: tuple[tuple[str, tuple[str, ...], tuple[float, ...]], ...] = (
        ("laws of physics", (), (1e8, 1.5e8, 3e8, 5e8)),
        ("laws of physics with products", ("products",), (2e8, 3e8, 4e8, 5e8)),
        ("laws of physics with centres", ("centres",), (0.0, 2e8, 4e8, 0.0)),
    )
    fewest: int = 60
    nothing: float = 1e-9
    shown: float = 1e-5
    exact: float = 1e-9
    operations: tuple[float, ...] = (2e8, 4e8, 8e8, 1.6e9)
    least: float = 3e-6
    looked_at: int = 20_000
    compared: int = 1_000
    behind: float = 40.0
    brought: float = 3.0
    fitted: int = 4
    evaluations: int = 3
    screened: float = 3e-4
    iterations: int = 12
    as_noise: float = 1.1


OPTIONS = DictionaryOptions()
_STEPS = Steps(6, 1)


def law_of_physics(problem: LawProblem) -> FittedLaw | None:
    """The law, with uniform friction where that explains what laws without leave over, or None
    where none is found, or the pairs are of no autonomous flow of a few degrees of freedom in plain
    coordinates and angles. ``partly`` is called with the three laws that come closest, where none
    is exact."""
    data, rows, work = problem.data, problem.data.training, problem.work
    if not problem.simple or data.dim > Clean.most_dim or len(rows) < OPTIONS.fewest:
        return None
    allowance = dataclasses.replace(problem.flows.allowance, cap=None)
    own = dataclasses.replace(problem.flows, allowance=allowance)  # no part of what libraries take
    of_z = {
        "angles": tuple(a for a in data.coordinates.angles if a < data.dim),
        "cyclic": data.coordinates.cyclic,
        "on_progress": problem.on_progress,
    }
    search = Textbook(own, rows, **of_z)
    law = _searched(problem, search, OPTIONS.dictionaries)
    if law is None and search.asks_for(momenta):
        damped = Textbook(own, rows, forces=Uniform, **of_z)
        law = _searched(problem, damped, OPTIONS.dictionaries[:1])
    if law is None:
        for partial in search.partial:
            family, c = _without_nothing(partial, data.y0[rows], data.scale)
            named = zip(family.term_names, c.tolist(), strict=True)
            shown = formula_of([Term(name, x, OPTIONS.shown * abs(x)) for name, x in named])
            problem.partly(PartialLaw(shown, partial.left, "of the spread"))
        return None
    family, start = _without_nothing(law, data.y0[rows], data.scale)
    # Whatever it took to fit the libraries before, this law is close to its optimum.
    again = work.again(f"H of {family.num_parameters} terms", family, len(rows))
    with work.optional("the law of physics that was found"), again:
        found = problem.fitted(family, start, rows, rounds=False)
        if problem.met_by(found) and found.error.relative <= OPTIONS.exact:
            return found._replace(null=search.null, undetermined=search.null)
    return None


def _searched(problem: LawProblem, search: Textbook, dictionaries) -> Law | None:
    """The law that a search finds in these dictionaries, in turn, as far as the budget goes."""
    for name, contents, allowed in dictionaries:
        operations, law, searched = allowed[problem.data.dim - 1], None, False
        if not operations:
            continue
        with problem.work.optional(name), problem.budget.unit(name, MATCHING, operations):
            law, searched = search.law(**dict.fromkeys(contents, True)), True
        if law is not None or not searched:
            return law
    return None


def _without_nothing(law: Law, z: np.ndarray, scale: np.ndarray):
    """(family, coefficients) of the terms whose part in the gradients is not roundoff."""
    gradients = law.family.term_gradients(z) * scale[:, None]
    part = np.abs(law.coefficients) * np.sqrt(np.mean(gradients**2, axis=(0, 1)))
    kept = np.flatnonzero(part > OPTIONS.nothing * part.max())
    return law.family.take(kept.tolist()), law.coefficients[kept]


class _LawOfSequences(NamedTuple):
    """A law as whole sequences tell it, and its description length."""

    formula: Formula
    fitted: Fitted
    length: float


def law_of_sequences(problem: LawProblem) -> FittedLaw | None:
    """The law, or None where the pairs are no noisy sequences of one dt, or nothing in the
    dictionary leaves no more than their noise. ``partly`` is called with the three laws that come
    closest, where none does."""
    data = problem.data
    if data.varied or data.structure is not None or data.dim > len(OPTIONS.operations):
        return None
    stretches = _stretches(data)
    noise = _noise_of(stretches, data.scale)
    weak = None if noise is None else weak_gradients(stretches, data.dt, noise)
    if noise is None or weak is None:
        return None
    return _behind_noise(problem, weak, noise)


def law_of_noisy_pairs(problem: LawProblem, best: FittedLaw) -> FittedLaw | None:
    """The law of physics that tells the same pairs in fewer words than ``best``, a polynomial that
    leaves little more than their noise; None where there is none, or these are other pairs."""
    data, family, c = problem.data, best.family, best.fit.coefficients
    rows = data.training[: OPTIONS.compared]
    few = len(rows) < OPTIONS.fewest or data.dim > len(OPTIONS.operations)
    polynomial = isinstance(family, Terms) and family.variables == coordinate_names(data.dim)
    plain = not (data.coordinates.angles or data.coordinates.cyclic or data.varied)
    if few or not (polynomial and plain and problem.simple):
        return None
    z0, z1 = data.y0[rows], data.y1[rows]
    off = z1 - problem.flows.images(family, c, rows, best.fit.steps).states
    noise = robust(off, axis=0) / np.sqrt(2)
    if not (np.isfinite(off).all() and (noise > 0).all()):
        return None
    weak = gradients_of_pairs((z0, z1), data.dt, noise, off, partial(family.gradient, c))
    return _behind_noise(problem, weak, noise, best)


def _behind_noise(
    problem: LawProblem, weak: WeakGradients, noise: np.ndarray, polynomial: FittedLaw | None = None
) -> FittedLaw | None:
    """The law of least description length among those that are worth a fit, and a rival that is a
    polynomial; None where none leaves as little, or it is a polynomial too."""
    data, budget = problem.data, problem.budget
    angles = tuple(a for a in data.coordinates.angles if a < data.dim)
    cyclic = data.coordinates.cyclic
    search = NoisyTextbook(weak, angles=angles, cyclic=cyclic, on_progress=problem.on_progress)
    name = "laws of physics behind noise"
    with problem.work.optional(name), contextlib.suppress(InputError):  # constants have run away
        with budget.unit(name, MATCHING, OPTIONS.operations[data.dim - 1]):
            formulas = _worth(search.formulas())
        rival = None
        if polynomial is not None:
            rival = search.polynomial(polynomial.family, polynomial.fit.coefficients)
        if rival is not None and all(formula.is_polynomial for formula in formulas):
            return None
        family = formulas[0].family(formulas[0].constants)
        states = len(formulas) * len(data.training)
        one = operations(family, 2 * data.dim, _STEPS, family)
        with budget.unit(name, FLOW, OPTIONS.evaluations * states * one):
            return _chosen(problem, formulas, noise, rival)
    return None


def _stretches(data: Dataset) -> list[np.ndarray]:
    """States (L, 2d) of the training sequences without gaps, their angles going on over turns."""
    rows = np.sort(data.training)[: OPTIONS.looked_at]
    goes_on = next_of(data.pairs, rows)
    if not goes_on.any():
        return []
    breaks = np.flatnonzero(~goes_on) + 1
    moved = data.y1 - data.y0
    return [
        np.concatenate([data.y0[own[:1]], data.y0[own[0]] + np.cumsum(moved[own], axis=0)])
        for own in np.split(rows, breaks)
    ]


def _noise_of(stretches: list[np.ndarray], scale: np.ndarray) -> np.ndarray | None:
    """(2d,) the noise of each coordinate; None where differences of the states do not tell it."""
    found, order = [], ARCS.order
    for i, size in enumerate(scale):
        moves = [np.diff(own[:, i : i + 1], axis=0) / size for own in stretches]
        if not any(len(own) > order for own in moves):
            return None
        found.append(of_differences(moves, order, ARCS.alike))
    if None in found or min(found) < OPTIONS.least:
        return None
    return np.array(found, float) * scale


def _chosen(
    problem: LawProblem, formulas: list[Formula], noise: np.ndarray, rival: Formula | None
) -> FittedLaw | None:
    """The law of least description length that leaves no more than this noise, or than the rival.

    None where that is a polynomial as the rival is, or has as many numbers as one and no odds that
    decide: near 0 a parabola and a cosine are a parabola and a fourth power.
    """
    first, data = formulas[0], problem.data
    family = first.family(first.constants)
    sequences = Sequences.along(problem, family, first.coefficients, _STEPS)
    if sequences is None:
        return None
    train, held = (
        sequences.arcs(np.sort(rows)[: OPTIONS.looked_at], alone=rival is not None)
        for rows in (data.training, data.validation)
    )
    if train is None or held is None:
        return None

    def on_held_out(law: _LawOfSequences) -> Fitted | None:
        given = law.formula.family, law.fitted.p, len(law.formula.coefficients)
        return sequences.fitted(held, *given, fix_coefficients=True)

    laws, further = [], noise
    if rival is not None:
        known = _significant(sequences, train, rival)
        there = None if known is None else on_held_out(known)
        if known is None or there is None:
            return None
        laws, noise, further = [known], noise_of(known.fitted), noise_of(there)
    for tried, formula in enumerate(formulas):
        with contextlib.suppress(np.linalg.LinAlgError, InputError):  # constants have run away
            found = _significant(sequences, train, formula)
            laws += [] if found is None else [found]
        if tried and not laws:  # none of the likeliest two can be followed along its arcs
            return None
    laws.sort(key=lambda law: law.length)
    near = [law for law in laws if _leaves(law.fitted, noise) <= OPTIONS.as_noise]
    if not near or not _leaves(on_held_out(near[0]), further) <= OPTIONS.as_noise:
        for law in laws[:3]:
            left = _leaves(law.fitted, noise)
            problem.partly(PartialLaw(_shown(law), left, "times the noise"))
        return None
    best, formula = near[0], near[0].formula
    if rival is not None:
        plain = next(law for law in near if law.formula.is_polynomial)
        decided = plain.length - best.length > np.log(EVIDENCE.decided)
        if not (decided or len(best.fitted.p) < len(plain.fitted.p)):
            return None
    fitted = sequences.refitted(best.fitted, formula.family, len(formula.coefficients))
    return _law(problem, formula, fitted)._replace(rivals=_rivals(best, laws))


def _leaves(found: Fitted | None, noise: np.ndarray) -> float:
    """Residuals of a fit, in units of the noise (2d,)."""
    return np.inf if found is None else _rms(noise_of(found) / noise)


def _rivals(best: _LawOfSequences, laws: list[_LawOfSequences]) -> tuple[Rival, ...]:
    """The next two laws of least description length, with the odds of the best against them."""
    others: dict[frozenset, _LawOfSequences] = {}
    for law in laws:
        if law.length > best.length and law.formula.kind != best.formula.kind:
            others.setdefault(law.formula.kind, law)
    return tuple(
        Rival(_shown(law), float(np.exp(min(law.length - best.length, EVIDENCE.log_odds))))
        for law in list(others.values())[:2]
    )


def _shown(law: _LawOfSequences) -> str:
    """The law as people read it."""
    formula, p = law.formula, law.fitted.p
    terms = len(formula.coefficients)
    deviations = np.linalg.norm(covariance_root_of(law.fitted), axis=0)
    inside = map(_readable, p[terms:].tolist(), deviations[terms:].tolist())
    names = formula.family(np.array(list(inside))).term_names
    return formula_of(list(map(Term, names, p[:terms].tolist(), deviations[:terms].tolist())))


def _worth(formulas: list[Formula]) -> list[Formula]:
    """The laws that are not far behind the first, nor one before them with terms that bring
    nothing."""

    def behind(formula: Formula, other: Formula) -> float:
        """Logarithm of the odds by which the other law's weak residuals are likelier."""
        return formula.rows * float(np.log(formula.left / other.left))

    kept: list[Formula] = []
    for formula in formulas:
        if behind(formula, formulas[0]) > OPTIONS.behind:
            continue
        if any(o.kind < formula.kind and behind(formula, o) > -OPTIONS.brought for o in kept):
            continue
        kept.append(formula)
    return kept[: OPTIONS.fitted]


def _significant(
    sequences: Sequences, measured: Measured, formula: Formula
) -> _LawOfSequences | None:
    """The terms of a law that whole sequences tell from noise, fitted to them."""
    while True:
        count = len(formula.coefficients)
        found = sequences.fitted(
            measured,
            formula.family,
            formula.p,
            count,
            gained=OPTIONS.screened,
            iterations=OPTIONS.iterations,
        )
        if found is None:
            return None
        formula, triangle = formula.at(found.p), triangle_of(found)
        kept = terms_with_constants(triangle, found.p, formula.numbers)
        if len(kept) == count:
            break
        if not kept:
            return None
        formula = formula.take(kept)
    count = np.isfinite(found.residuals).sum(axis=(0, 1))
    free = count * (1 - found.x[:, 0].size / count.sum())  # an arc's first state follows its own
    length = float(
        np.sum(free * np.log(noise_of(found)))
        + 0.5 * np.log(free.sum()) * len(found.p)
        + Noisy.penalty * formula.complexity
    )
    return _LawOfSequences(formula, found, length)


def _law(problem: LawProblem, formula: Formula, fitted: Fitted) -> FittedLaw:
    """The law as any other that was fitted to pairs, with what its sequences tell.

    Standard errors are marginal: those of the constants inside widen them. A sample of the
    posterior has the constants as they are; its covariance is that of the coefficients alone,
    times (m + k)/m for k constants beside m coefficients, which leaves the mean variance of the
    images at the states as it is.
    """
    root, terms, data = covariance_root_of(fitted), len(formula.coefficients), problem.data
    known = restricted(
        formula.family(fitted.p[terms:]),
        LawNumbers(fitted.p, root.T @ root, triangle_of(fitted).rows),
        data.y0[data.training],
        data.coordinates.angles,
    )
    c, covariance = known.numbers[:terms], known.covariance
    deviations = np.sqrt(np.diag(covariance).clip(0.0))
    constants = list(map(_readable, known.numbers[terms:].tolist(), deviations[terms:].tolist()))
    family = formula.family(np.array(constants))
    inside = [j for j, places in enumerate(formula.numbers) for _ in places]
    names = [family.term_names[j] for j in inside]
    inner = tuple(map(Term, names, constants, deviations[terms:].tolist()))
    fit = problem.flows.fit(family, c, data.training, rounds=False)
    fit = fit._replace(coefficients=c, standard_errors=deviations[:terms])
    # Of the coefficients with the constants as they are, times (m + k)/m.
    own, across = covariance[:terms, :terms], covariance[:terms, terms:]
    own = own - across @ np.linalg.pinv(covariance[terms:, terms:], hermitian=True) @ across.T
    root = np.sqrt(len(covariance) / terms) * covariance_root(own)
    return FittedLaw(
        family,
        fit,
        data.training,
        problem.error_of(family, fit),
        noisy=True,
        stalled=True,
        whole=summary_of(fitted, root),
        constants=inner,
        symmetries=known.symmetries,
    )


def _readable(constant: float, deviation: float) -> float:
    """The constant to a hundredth of its standard error."""
    digits = int(np.clip(np.ceil(np.log10(abs(constant) / deviation)) + 2, 2, 16))
    return float(f"{constant:.{digits}g}")


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))
