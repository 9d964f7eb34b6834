"""Start of the fit of a law: the equation of motion in weak form, which is linear in the
coefficients and free of accelerations.

    ∫ (−φ̇ ∂ℓ_j/∂v − φ ∂ℓ_j/∂q) dt        for a term of L,
    ∫ φ ∂r_k/∂v dt                         for a friction,      −∫ φ u dt   for a gain

with bumps φ = (s(1 − s))³ along windows of the record, in which the term d/dt was integrated by
parts. Terms are eliminated until all are seen.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
from scipy.sparse import csr_array

from gfnn_jax.dataset.stretches import Nodes
from gfnn_jax.errors import FitError
from gfnn_jax.families.friction import LINEAR, Friction
from gfnn_jax.families.lagrangian import Terms, functions_of
from gfnn_jax.flows.motion import Form
from gfnn_jax.models.lagrangians.fit import ArcProblem, LawFit
from gfnn_jax.models.lagrangians.libraries import FEW
from gfnn_jax.models.lagrangians.structure import (
    SINE,
    Key,
    Loss,
    Row,
    Structure,
    cosine_of,
    is_constant,
)


@dataclasses.dataclass(frozen=True)
class WeakOptions:
    """Options of the weak form (`benchmarks/random_recordings.py`).

    lengths: of the windows, in periods. periods: of the longest run, below which windows are
    shorter too, for there would be few of them, or none. fewest: samples of a window. spacing: of a
    window's length, to the next. overlap: rows that share samples, of which as many count as one.
    apart: ratio of the weights of coordinates, at most, since a wrong library would make one of
    them all. rounding: residual of a coordinate to the sizes of its terms, below which a law
    without mass and force solves the equations. slow: of the rms speed of a coordinate, below which
    dry friction holds it; held: share of a window, above which it says nothing of the law. many:
    terms of a library, of which the ``kept`` that explain most are tried, ``block`` by block;
    imitated: share of what one does that those of the law do not, below which it explains nothing.
    far: of the spread, that a centre of forces is from the origin; torque: share of the squares of
    forces times distances, that is none about it; some: that forces through one point leave.
    """

    lengths: tuple[float, ...] = (0.5, 1.0)
    periods: float = 2.0
    fewest: int = 7
    spacing: float = 0.25
    overlap: float = 3.0
    apart: float = 100.0
    rounding: float = 1e-9
    rank: float = 1e-12
    slow: float = 0.03
    held: float = 0.25
    many: int = 400
    kept: int = 120
    block: int = 300
    imitated: float = 0.03
    far: float = 0.03
    torque: float = 1e-4
    some: float = 0.01


OPTIONS = WeakOptions()


def protected(structure: Structure, others: bool = False) -> set[Key]:
    """Constant masses of each coordinate, without which there would be no motion; of several that
    depend on parameters of the system none alone. Beside ``others`` none where a mass that depends
    on position does as well."""
    masses = [row for row in structure.terms if max(row[0]) == 2 and (others or is_constant(row))]
    alone = [row for row in masses if sum(other[0] == row[0] for other in masses) == 1]
    return {("term", row) for row in alone if is_constant(row)}


class _Equations(NamedTuple):
    """X (windows, d, n) c = Y (windows, d) of coefficients ``keys``, of which ``keep`` (indices)
    act and ``masses`` are ½; t (windows,) where their windows are."""

    keys: list[Key]
    X: np.ndarray
    Y: np.ndarray
    keep: list[int]
    masses: list[int]
    t: np.ndarray

    @classmethod
    def of(cls, structure: Structure, problem: ArcProblem, equal: bool) -> _Equations:
        """Make those of a structure, with ``equal`` masses where these are constant."""
        d, nodes, uneven = structure.dim, problem.nodes, problem.scales.uneven
        if uneven:
            nodes = [n.evenly(problem.scales.nodes_of(np.ptp(n.t))) for n in nodes]
        args = np.repeat([n.stretch.args for n in nodes], [len(n.t) for n in nodes], axis=0)
        form = structure.form(np.concatenate([n.x[:, :d] for n in nodes]), args)
        period = min(problem.scales.period, max(np.ptp(n.t) for n in nodes) / OPTIONS.periods)
        lengths = [length * period for length in OPTIONS.lengths]
        windows = [
            # of a run that is shorter than a window, all of it
            (node, min(length, 0.999 * np.ptp(node.t)) if uneven else length)
            for node in nodes
            for length in lengths
        ]
        rows, targets = zip(*(weak_rows(form, *window) for window in windows), strict=True)
        bumps = [Bumps.of(n.t, length) for n, length in windows]
        t = np.concatenate([one.t for one in bumps])
        X, Y = np.concatenate(rows), -np.concatenate(targets)
        if np.any(form.friction.dry):
            least = OPTIONS.slow * np.sqrt(np.mean(problem.states[:, d:] ** 2, axis=0))
            slow = [1.0 * (np.abs(n.x[:, d:]) < least) for n, _ in windows]
            inside: list[Any] = [1.0 * (one.phi != 0) for one in bumps]
            part = [W @ x / W.sum(axis=1)[:, None] for W, x in zip(inside, slow, strict=True)]
            held = np.concatenate(part) > OPTIONS.held  # by any force up to that of sliding
            X[held], Y[held] = 0.0, 0.0
        keys = structure.keys()[: form.count]
        keep = [k for k in range(form.count) if np.any(X[..., k])]
        masses = [k for k in keep if equal and keys[k] in protected(structure)]
        keep = [k for k in keep if k not in masses]
        Y = Y - 0.5 * X[..., masses].sum(axis=-1)
        return cls(keys, X, Y, keep, masses, t)


def weak_share(structure: Structure, problem: ArcProblem) -> float:
    """Share of the squares of the equations of motion that all terms of a structure, with equal
    masses, leave."""
    _, X, Y, keep, *_ = _Equations.of(structure, problem, True)
    return _share(X[..., keep], Y)


def trend(structure: Structure, problem: ArcProblem) -> tuple[Key, float, float] | None:
    """The force whose coefficient, did it change in proportion to time, would leave least of the
    equations of motion of a structure; its change from the record's begin to its end, relative to
    its mean; and the share of the squares of the residuals that it leaves. None where there is no
    force."""
    keys, X, Y, keep, _, t = _Equations.of(structure, problem, False)
    place = (t - np.mean(t)) / max(np.ptp(t), 1e-300)
    X, keys = X[..., keep], [keys[k] for k in keep]
    before, found = _share(X, Y), []
    for k, key in enumerate(keys):
        if key[0] == "term" and not any(key[1][0]):
            more = np.concatenate([X, X[..., [k]] * place[:, None, None]], axis=-1)
            c = _solve(more, Y)[0]
            change = float(c[-1] / c[k]) if c[k] else np.inf
            found.append((_share(more, Y) / max(before, 1e-300), key, change))
    if not found:
        return None
    share, key, change = min(found, key=lambda one: one[0])
    return key, change, share


def _share(X: np.ndarray, Y: np.ndarray) -> float:
    """Share of the squares of Y that X c leaves."""
    residual = _solve(X, Y)[1] if X.shape[-1] else Y
    return float(np.sum(residual**2) / max(np.sum(Y**2), 1e-300))


def weak_start(
    structure: Structure, problem: ArcProblem, prune: bool = True, equal: bool = False
) -> tuple[Structure, dict[Key, float]]:
    """The structure less what is not seen at four standard errors (if ``prune``), and its
    coefficients; with ``equal`` masses of all coordinates, where these are constant.

    Raises FitError where a coordinate without mass and force solves the equations.
    """
    keys, X, Y, keep, masses, _ = _Equations.of(structure, problem, equal)
    fixed, evidence = protected(structure), problem.options.evidence
    # A coordinate's equation times its speed is a power, whatever its unit.
    speed = np.sqrt(np.mean(problem.states[:, structure.dim :] ** 2, axis=0))
    weight = unit = np.where(speed > 0, speed, 1.0)
    while True:
        for _ in range(2):  # each coordinate's rows in units of their own residual
            c, residual, inverse = _solve(X[..., keep] * weight[:, None], Y * weight)
            size = np.sqrt(np.mean(residual**2, axis=0))
            if not np.min(size) > OPTIONS.rounding * np.linalg.norm(X[..., keep] * c):
                raise FitError(
                    "terms: a combination of them vanishes all along the recording, so that their "
                    "coefficients are not determined. Leave one out, or add a force"
                )
            told = weight / size / unit
            weight = unit * np.maximum(told, np.max(told) / OPTIONS.apart)
        error = np.sqrt(OPTIONS.overlap * np.mean(residual**2)) * np.linalg.norm(inverse, axis=1)
        z = [
            np.inf if keys[k] in fixed else abs(value) / e
            for k, value, e in zip(keep, c, error, strict=True)
        ]
        if not prune or not z or min(z) > evidence.significant:
            break
        gone = {keep[int(np.argmin(z))]}
        if structure.dim > FEW:  # whose terms are many
            gone |= {k for k, size in zip(keep, z, strict=True) if size < evidence.nothing}
        keep = [k for k in keep if k not in gone]
    kept = {keys[k]: float(value) for k, value in zip(keep, c, strict=True)}
    kept |= {keys[k]: 0.5 for k in masses}
    return structure.without({k for k in keys if k not in kept}), kept


def promising(fit: LawFit, every: Structure) -> Structure:
    """The structure; of a large one the terms alone that explain most of what the law of a fit
    leaves of the equations of motion, each by itself: derivatives of all along the arcs would take
    long, and much memory."""
    rows = [row for row in every.terms if row not in fit.structure.terms]
    if len(rows) <= OPTIONS.many:
        return every
    problem, d = fit.problem, every.dim
    period = min(problem.scales.period, max(np.ptp(n.t) for n in problem.nodes) / OPTIONS.periods)

    def columns(terms: Terms, friction: Friction, inputs: int = 0) -> np.ndarray:
        n = terms.count
        form = Form(terms, np.zeros(n), np.eye(n), friction, inputs)
        return np.concatenate(
            [weak_rows(form, node, OPTIONS.lengths[-1] * period)[0] for node in problem.nodes]
        )

    linear = [(tuple(axis), LINEAR, 0.0) for axis in np.eye(d, dtype=int).tolist()]
    friction = Friction.of([*fit.structure.friction, *linear], d)
    own = columns(fit.form.terms, friction, every.num_inputs)
    law = fit.form.lagrangian(fit.p[: fit.form.count])
    left = own[..., : law.terms.count] @ law.coefficients
    weight = 1 / np.maximum(np.std(left, axis=0), 1e-300)[:, None]  # of each coordinate

    def flat(part: np.ndarray) -> np.ndarray:
        return (part * weight).reshape(-1, part.shape[-1])

    basis = np.linalg.qr(flat(own))[0]

    def apart(part: np.ndarray) -> np.ndarray:
        return part - basis @ (basis.T @ part)

    rest, explains = apart(flat(left[..., None]))[:, 0], []
    for k in range(0, len(rows), OPTIONS.block):
        some = rows[k : k + OPTIONS.block]
        whole = flat(columns(Terms.of(some, d, every.leaders), Friction.of([], d)))
        new = apart(whole)
        size, least = (np.linalg.norm(part, axis=0) for part in (new, OPTIONS.imitated * whole))
        explains += np.where(
            size > least, np.abs(rest @ new) / np.maximum(size, 1e-300), 0.0
        ).tolist()
    best = sorted(np.argsort(explains)[-OPTIONS.kept :].tolist())
    return dataclasses.replace(every, terms=(every.terms[0], *(rows[k] for k in best)))


def zeros_of_angles(
    terms: Sequence[Row], friction: Sequence[Loss], problem: ArcProblem
) -> np.ndarray:
    """Zeros (d,) of angles, up to a quarter of a turn, from which their own potentials cos q_i have
    no sine; 0 of coordinates without.

    Raises FitError as `weak_start`.
    """
    sines = [(*row[:3], row[3] + SINE) for row in terms if any(row[2])]
    structure = Structure(problem.dim, (*terms, *sines), tuple(friction), (), problem.num_inputs)
    known = weak_start(structure, problem, prune=False)[1]
    zeros = np.zeros(structure.dim)
    for row in sines:
        if (cosine := cosine_of(row)) is not None:
            a, b = (known.get(("term", one), 0.0) for one in (cosine, row))
            zeros[row[2].index(1)] = np.arctan2(b, a)
    return np.where(np.abs(zeros) > np.pi / 2, zeros - np.pi * np.sign(zeros), zeros)


def centre_of_forces(problem: ArcProblem) -> np.ndarray:
    """The point c (d,) of lengths through which forces pass; 0 where there is none, where it is
    close to the origin, or where a column shows more than one of them, or a parameter its zero.

    About c the acceleration has no torque but that of a uniform field g and of drag:
    (q − c) × (q̈ − g + γ q̇) = 0, which is linear in c, g, γ and in products of these. The plainest
    choice of these is taken that leaves hardly any torque, else that by which c is known best.
    """
    d, period = problem.dim, problem.scales.period
    if len(problem.observation.direct) < d:
        return np.zeros(d)
    period = min(period, max(np.ptp(n.t) for n in problem.nodes) / OPTIONS.periods)
    planes, rows, targets, sizes = list(combinations(range(d), 2)), [], [], []
    middle, spread = (of(problem.states[:, :d], axis=0) for of in (np.mean, np.std))
    for node in problem.nodes:
        q, v = np.split(node.x, 2, axis=1)
        bumps = Bumps.of(node.t, OPTIONS.lengths[-1] * period)
        one = summed(bumps.phi, np.ones(len(q)))
        bent, speed, place = -summed(bumps.slope, v), summed(bumps.phi, v), summed(bumps.phi, q)
        sizes.append(np.sum((place / one[:, None] - middle) ** 2, axis=1) @ np.sum(bent**2, axis=1))
        for at, (i, j) in enumerate(planes):

            def across(x: np.ndarray, i: int = i, j: int = j) -> np.ndarray:
                """Return the factors of a vector (d,) in the plane's part of its product with x."""
                return np.outer(x[:, j], np.eye(d)[i]) - np.outer(x[:, i], np.eye(d)[j])

            spin = q[:, i] * v[:, j] - q[:, j] * v[:, i]
            field = [across(place), np.outer(one, np.eye(len(planes))[at])]
            drag = [across(speed), summed(bumps.phi, spin)[:, None]]
            rows.append([across(bent), *field, *drag])
            targets.append(-summed(bumps.slope, spin))
    parts, Y = [np.concatenate(part) for part in zip(*rows, strict=True)], np.concatenate(targets)
    if not len(Y):  # runs are shorter than a window
        return np.zeros(d)
    found = []
    for taken in ((0,), (0, 3, 4), (0, 1, 2), (0, 1, 2, 3, 4)):
        X = np.concatenate([parts[k] for k in taken], axis=1)
        c, left, inverse = _solve(X[:, None], Y[:, None])
        error = np.sqrt(OPTIONS.overlap * np.mean(left**2)) * np.linalg.norm(inverse[:d])
        found.append((error, np.sum(left**2) / max(sum(sizes), 1e-300), c[:d]))
    plain = [one for one in found if one[1] < OPTIONS.torque]
    error, share, c = plain[0] if plain else min(found, key=lambda one: one[0])
    near = max(OPTIONS.far * np.linalg.norm(spread), problem.options.evidence.significant * error)
    return c if share < OPTIONS.some and np.linalg.norm(c) > near else np.zeros(d)


def weak_rows(form: Form, node: Nodes, length: float) -> tuple[np.ndarray, np.ndarray]:
    """Rows (windows, d, count) of the coefficients, and what the fixed part of the law gives
    (windows, d); their sum with the coefficients is zero for the law. Along the nodes of one
    segment; ``length`` of the windows in units of t."""
    terms, d, t = form.terms, form.dim, node.t
    q, v, u = node.x[:, :d], node.x[:, d:], node.stretch.u[node.at]
    weights = np.ones(terms.count + form.friction.count)
    if form.powers is not None:
        weights = functions_of(form.powers, node.stretch.args)[: len(weights)]
    f, df, _ = terms.potentials(q, 1, u)
    g, dg = terms.motion(v)
    momentum = terms.acting(dg * f[..., None]).swapaxes(1, 2)  # (n, d, P)
    force = terms.acting(df * g[..., None]).swapaxes(1, 2)
    bumps = Bumps.of(t, length)
    of_terms = -summed(bumps.slope, momentum) - summed(bumps.phi, force)
    of_terms = of_terms * weights[: terms.count]
    lost = summed(bumps.phi, form.friction.residuals(v, u).swapaxes(1, 2))
    rows = [of_terms @ form.basis, lost * weights[terms.count :]]
    if form.num_inputs:
        push = -summed(bumps.phi, u[:, None])
        rows.append(
            (push[:, :, None] * np.eye(d)[:, :, None]).reshape(len(push), d, d * u.shape[1])
        )
    return np.concatenate(rows, axis=2), of_terms @ form.fixed


def summed(weights: Any, values: np.ndarray) -> np.ndarray:
    """Sums (windows, ...) of values (n, ...) by the weights of windows, a sparse array."""
    shape = (weights.shape[0], *values.shape[1:])
    return np.asarray(weights @ values.reshape(len(values), -1)).reshape(shape)


class Bumps(NamedTuple):
    """φ dt and φ̇ dt, each (windows, n), at times t (n,), in units of the noise that v brings; and
    the mean time (windows,) of each window."""

    phi: csr_array
    slope: csr_array
    t: np.ndarray

    @classmethod
    def of(cls, t: np.ndarray, length: float) -> Bumps:
        """Make windows of this length along the times."""
        starts = np.arange(t[0], t[-1] - length, OPTIONS.spacing * length)
        first, last = np.searchsorted(t, starts), np.searchsorted(t, starts + length)
        keep = last - first >= OPTIONS.fewest
        starts, first, last = starts[keep], first[keep], last[keep]
        ends = np.cumsum([0, *(last - first)])
        window = np.repeat(np.arange(len(starts)), last - first)
        at = np.arange(ends[-1]) + (first - ends[:-1])[window]
        s, weight = (t[at] - starts[window]) / length, np.gradient(t)[at]
        weight[ends[:-1]] = t[first + 1] - t[first]
        weight[ends[1:] - 1] = t[last - 1] - t[last - 2]
        bump = s * (1 - s)
        phi, slope = bump**3 * weight, 3 * bump**2 * (1 - 2 * s) / length * weight
        norm = np.sqrt(np.bincount(window, slope**2, len(starts)))[window]
        mean = np.bincount(window, t[at], len(starts)) / (last - first)
        shape = (len(starts), len(t))
        phi, slope = (csr_array((x / norm, at, ends), shape) for x in (phi, slope))
        return cls(phi, slope, mean)


def _solve(X: np.ndarray, Y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Least squares X c = Y: c, residuals in the shape of Y, and R⁻¹ of the factor."""
    flat = X.reshape(X.shape[0] * X.shape[1], X.shape[2])
    scale = np.linalg.norm(flat, axis=0)
    Q, R = np.linalg.qr(flat / scale)
    inverse = np.linalg.pinv(R, rcond=OPTIONS.rank)
    c = inverse @ (Q.T @ Y.reshape(-1))
    residual = Y - (flat / scale @ c).reshape(Y.shape)
    return c / scale, residual, inverse / scale[:, None]
