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
from typing import NamedTuple

import numpy as np
from scipy.linalg.lapack import dtrtri  # pyright: ignore[reportAttributeAccessIssue]

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
from gfnn_jax.models.lagrangians.windows import Windows


class Options:
    """Options of the weak form (`benchmarks/random_recordings.py`).

    overlap: rows that share samples, of which as many count as one.
    apart: ratio of the weights of coordinates, at most, since a wrong library would make one of
    them all. rounding: residual of a coordinate to the sizes of its terms, below which a law
    without mass and force solves the equations. slow: of the rms speed of a coordinate, below which
    dry friction holds it; held: share of a window, above which it says nothing of the law. many:
    terms of a library, of which the ``kept`` that explain most are tried, ``block`` by block;
    imitated: share of what one does that those of the law do not, below which it explains nothing.
    far: of the spread, that a centre of forces is from the origin; torque: share of the squares of
    forces times distances, that is none about it; some: that forces through one point leave.
    """

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


def protected(structure: Structure, others: bool = False) -> set[Key]:
    """Constant masses of each coordinate, without which there would be no motion; of several that
    depend on parameters of the system none alone. Beside ``others`` none where a mass that depends
    on position does as well."""
    masses = [row for row in structure.terms if max(row[0]) == 2 and (others or is_constant(row))]
    alone = [row for row in masses if sum(other[0] == row[0] for other in masses) == 1]
    return {("term", row) for row in alone if is_constant(row)}


def _of_bodies(structure: Structure) -> set[Key]:
    """The masses that are equal where each coordinate is that of a body: the constant ones, and
    those of angles v_j² q_i², at distances q_i."""
    far = {row for row in structure.terms if max(row[0]) == sum(row[1]) == max(row[1]) == 2}
    turned = {row[0] for row in far}
    constant = {key for key in protected(structure) if key[1][0] not in turned}
    return constant | {("term", row) for row in far if row[0] != row[1] and not any(row[2])}


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
        d, windows = structure.dim, problem.windows
        form = structure.form(windows.x[:, :d], windows.args)
        X, fixed = weak_rows(form, windows)
        Y = -fixed
        if np.any(form.friction.dry):
            least = Options.slow * np.sqrt(np.mean(problem.states[:, d:] ** 2, axis=0))
            held = windows.mean(1.0 * (np.abs(windows.x[:, d:]) < least)) > Options.held
            X[held], Y[held] = 0.0, 0.0  # held by any force up to that of sliding
        keys = structure.keys()[: form.count]
        keep = [k for k in range(form.count) if np.any(X[..., k])]
        masses = [k for k in keep if equal and keys[k] in _of_bodies(structure)]
        keep = [k for k in keep if k not in masses]
        Y = Y - 0.5 * X[..., masses].sum(axis=-1)
        return cls(keys, X, Y, keep, masses, windows.mean(windows.t))


def weak_share(structure: Structure, problem: ArcProblem, equal: bool = True) -> float:
    """Share of the squares of the equations of motion that all terms of a structure, with ``equal``
    masses or masses of their own, leave."""
    _, X, Y, keep, *_ = _Equations.of(structure, problem, equal)
    return _share(X[..., keep], Y)


def trend(
    structure: Structure, problem: ArcProblem, rubs: bool = False
) -> tuple[Key, float, float] | None:
    """The force, or where it ``rubs`` the friction, whose coefficient, did it change in proportion
    to time and keep its sign, would leave least of the equations of motion of a structure; its
    change from the record's begin to its end, relative to its mean; and the share of the squares of
    the residuals that it leaves. None where there is none."""
    keys, X, Y, keep, _, t = _Equations.of(structure, problem, False)
    place = (t - np.mean(t)) / max(np.ptp(t), 1e-300)
    X, keys = X[..., keep], [keys[k] for k in keep]
    before, found = _share(X, Y), []
    for k, key in enumerate(keys):
        if key[0] == "loss" if rubs else key[0] == "term" and not any(key[1][0]):
            more = np.concatenate([X, X[..., [k]] * place[:, None, None]], axis=-1)
            c = _solve(more, Y)[0]
            if abs(c[-1]) < 2 * abs(c[k]):
                share = _share(more, Y) / max(before, 1e-300)
                found.append((share, key, float(c[-1] / c[k])))
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
            rows = X[..., keep] * weight[:, None]
            c, residual, inverse = _solve(rows, Y * weight)
            size = np.sqrt(np.mean(residual**2, axis=0))
            if not np.min(size) > Options.rounding * np.linalg.norm(rows * c):
                raise FitError(
                    "terms: a combination of them vanishes all along the recording, so that their "
                    "coefficients are not determined. Leave one out, or add a force"
                )
            told = weight / size / unit
            weight = unit * np.maximum(told, np.max(told) / Options.apart)
        error = np.sqrt(Options.overlap * np.mean(residual**2)) * np.linalg.norm(inverse, axis=1)
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
    if len(rows) <= Options.many:
        return every
    d, windows = every.dim, Windows.longest(fit.problem.nodes, fit.problem.scales)

    def columns(terms: Terms, friction: Friction, inputs: int = 0) -> np.ndarray:
        n = terms.count
        return weak_rows(Form(terms, np.zeros(n), np.eye(n), friction, inputs), windows)[0]

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
    for k in range(0, len(rows), Options.block):
        some = rows[k : k + Options.block]
        whole = flat(columns(Terms.of(some, d, every.leaders), Friction.of([], d)))
        new = apart(whole)
        size, least = (np.linalg.norm(part, axis=0) for part in (new, Options.imitated * whole))
        explains += np.where(
            size > least, np.abs(rest @ new) / np.maximum(size, 1e-300), 0.0
        ).tolist()
    best = sorted(np.argsort(explains)[-Options.kept :].tolist())
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
    d = problem.dim
    if len(problem.observation.direct) < d:
        return np.zeros(d)
    windows = Windows.longest(problem.nodes, problem.scales)
    q, v = np.split(windows.x, 2, axis=1)
    middle, spread = (of(problem.states[:, :d], axis=0) for of in (np.mean, np.std))
    one, place = windows.along(np.ones(len(q))), windows.along(q)
    bent, speed = -windows.changing(v), windows.along(v)
    size = np.sum((place / one[:, None] - middle) ** 2, axis=1) @ np.sum(bent**2, axis=1)
    planes, rows, targets = list(combinations(range(d), 2)), [], []
    for at, (i, j) in enumerate(planes):

        def across(x: np.ndarray, i: int = i, j: int = j) -> np.ndarray:
            """Return the factors of a vector (d,) in the plane's part of its product with x."""
            return np.outer(x[:, j], np.eye(d)[i]) - np.outer(x[:, i], np.eye(d)[j])

        spin = q[:, i] * v[:, j] - q[:, j] * v[:, i]
        field = [across(place), np.outer(one, np.eye(len(planes))[at])]
        rows.append([across(bent), *field, across(speed), windows.along(spin)[:, None]])
        targets.append(-windows.changing(spin))
    parts, Y = [np.concatenate(part) for part in zip(*rows, strict=True)], np.concatenate(targets)
    if not len(Y):  # runs are shorter than a window
        return np.zeros(d)
    found = []
    for taken in ((0,), (0, 3, 4), (0, 1, 2), (0, 1, 2, 3, 4)):
        X = np.concatenate([parts[k] for k in taken], axis=1)
        c, left, inverse = _solve(X[:, None], Y[:, None])
        error = np.sqrt(Options.overlap * np.mean(left**2)) * np.linalg.norm(inverse[:d])
        found.append((error, np.sum(left**2) / max(size, 1e-300), c[:d]))
    plain = [one for one in found if one[1] < Options.torque]
    error, share, c = plain[0] if plain else min(found, key=lambda one: one[0])
    near = max(Options.far * np.linalg.norm(spread), problem.options.evidence.significant * error)
    return c if share < Options.some and np.linalg.norm(c) > near else np.zeros(d)


def weak_rows(form: Form, windows: Windows) -> tuple[np.ndarray, np.ndarray]:
    """Rows (windows, d, count) of the coefficients, and what the fixed part of the law gives
    (windows, d); their sum with the coefficients is zero for the law."""
    terms, d = form.terms, form.dim
    parts = [_integrals(form, part) for part in windows.parts(terms.count * d)]
    of_terms, lost = (sum(part) for part in zip(*parts, strict=True))
    if form.powers is not None:
        weights = functions_of(form.powers, windows.systems)[:, None]
        of_terms, lost = (
            of_terms * weights[..., : terms.count],
            lost * weights[..., terms.count : terms.count + form.friction.count],
        )
    rows = [of_terms @ form.basis, lost]
    if form.num_inputs:
        push = -windows.along(windows.u)[:, None]
        rows.append(
            (push[:, :, None] * np.eye(d)[:, :, None]).reshape(len(push), d, d * push.shape[-1])
        )
    return np.concatenate(rows, axis=2), of_terms @ form.fixed


def _integrals(form: Form, windows: Windows) -> tuple[np.ndarray, np.ndarray]:
    """Return the integrals of each term (windows, d, P) and of each friction (windows, d, F)."""
    terms, (q, v) = form.terms, np.split(windows.x, 2, axis=1)
    f, df, _ = terms.potentials(q, 1, windows.u)
    g, dg = terms.motion(v)
    momentum = terms.acting(dg * f[..., None]).swapaxes(1, 2)  # (n, d, P)
    force = terms.acting(df * g[..., None]).swapaxes(1, 2)
    lost = form.friction.residuals(v, windows.u, q).swapaxes(1, 2)
    return -windows.changing(momentum) - windows.along(force), windows.along(lost)


def _solve(X: np.ndarray, Y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Least squares X c = Y: c, residuals in the shape of Y, and R⁻¹ of the factor."""
    flat = X.reshape(X.shape[0] * X.shape[1], X.shape[2])
    n, scale = flat.shape[1], np.linalg.norm(flat, axis=0)
    both = np.concatenate([flat / scale, Y.reshape(-1, 1)], axis=1)
    R = np.asarray(np.linalg.qr(both, mode="r"))[:n]
    inverse = _inverse(R[:, :n])
    c = inverse @ R[:, n]
    residual = Y - (both[:, :n] @ c).reshape(Y.shape)
    return c / scale, residual, inverse / scale[:, None]


def _inverse(R: np.ndarray) -> np.ndarray:
    """The inverse of a triangle, of its part above roundoff where that is not all of it."""
    inverse, singular = dtrtri(R) if R.shape[0] == R.shape[1] > 0 else (R, 1)
    size = np.linalg.norm(R) * np.linalg.norm(inverse)  # above that of its singular values
    if singular or not size < 1 / Options.rank:
        return np.linalg.pinv(R, rcond=Options.rank)
    return inverse
