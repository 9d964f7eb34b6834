"""A drive that nobody recorded: a sinusoidal force of one frequency on each coordinate, or such a
stiffness, as of a pendulum whose pivot is shaken.

In weak form the terms of a library and the two waves of a frequency ω are linear, so that of each
ω one least-squares problem tells what is left; the ω that leaves least is a drive where it is a
line, and its likelihood above what chance makes among all that were tried. Along arcs a fit's
residuals are then linear in a small change of ω, as they are in the coefficients (variable
projection). Motion of several frequencies has lines too beside a library that lacks its terms: what
tells is whether the law with the drive leaves noise.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from scipy.optimize import minimize_scalar

from gfnn_jax.families.friction import LINEAR
from gfnn_jax.fitting.evidence import EVIDENCE
from gfnn_jax.models.lagrangians import libraries
from gfnn_jax.models.lagrangians.arc_inputs import ArcInputs
from gfnn_jax.models.lagrangians.fit import ArcProblem, LawFit
from gfnn_jax.models.lagrangians.input_rules import correction
from gfnn_jax.models.lagrangians.structure import Structure
from gfnn_jax.models.lagrangians.weak_form import Options as Weak
from gfnn_jax.models.lagrangians.weak_form import weak_rows
from gfnn_jax.models.lagrangians.windows import Options as OfWindows
from gfnn_jax.models.lagrangians.windows import Windows


class Options:
    """Options of the search for a drive (`benchmarks/vocabulary.py`).

    spacing: of the frequencies tried, in turns over the record, and lows: of them, that are looked
    at more closely. fewest: turns of the slowest.
    windows: independent weak residuals, at least.
    fastest: times the fastest motion's frequency. width: turns over the record, of a line.
    stands_out: times the logarithm of the likelihood of any other frequency, of what is a line.
    rank: of the terms' columns, relative. settled: standard errors, within which a frequency is
    found. most: corrections. apart: turns over the record, by which waves are differentiated.
    fractions, harmonics: of a frequency, that periodic motion may have; noise: times it, that such
    motion leaves; low: harmonics of one whose size changes, as a polynomial of this degree in time,
    and grows: of its variance, that it leaves.
    """

    spacing: float = 0.25
    lows: int = 3
    fewest: float = 2.0
    windows: float = 10.0
    fastest: float = 4.0
    width: float = 2.0
    stands_out: float = 1.5
    rank: float = 1e-8
    settled: float = 0.1
    most: int = 5
    apart: float = 0.01
    fractions: tuple[int, ...] = (1, 2, 3)
    harmonics: int = 12
    noise: float = 3.0
    low: int = 3
    grows: float = 5e-4


def hidden_frequency(problem: ArcProblem, stiff: bool, known: Sequence[float] = ()) -> float | None:
    """The angular frequency of a drive that the record shows beside a library of terms, in rad/s:
    of a force, and of a stiffness where it may be ``stiff``; None where it shows none, or one that
    is ``known``, of which no other search finds more."""
    left, count, waves = _left_of(problem, stiff)
    if not count > Options.windows:
        return None
    turn = 2 * np.pi / _duration(problem)
    fastest = Options.fastest * problem.scales.omega
    tried = np.arange(Options.fewest * turn, fastest, Options.spacing * turn)
    if not len(tried):
        return None
    shares = np.array([left(omega) for omega in tried])
    best, found = _lowest(left, tried, shares)
    beside = shares[np.abs(tried - best) > Options.width * turn]
    gain, others = (
        -np.log(max(float(share), 1e-300)) for share in (found.fun, min(beside, default=1.0))
    )
    chance = np.log(len(tried)) + 0.5 * waves * np.log(max(count, 1.0))
    is_line = gain > Options.stands_out * others
    is_seen = is_line and 0.5 * count * gain > EVIDENCE.logarithm + chance
    omega = float(found.x)
    is_known = any(abs(omega - one) < Options.spacing * turn for one in known)
    return omega if is_seen and not is_known and not _repeats(problem, omega) else None


def _lowest(
    left: Callable[[float], float], tried: np.ndarray, shares: np.ndarray
) -> tuple[float, Any]:
    """The frequency, of those tried, near which least is left, and the minimum there: between them
    a drive leaves much more than where it is, and an own frequency of the motion may leave less
    there."""
    around, spacing = np.pad(shares, 1, constant_values=np.inf), float(np.ptp(tried[:2]))
    lows = np.flatnonzero((shares <= around[:-2]) & (shares <= around[2:]))
    some = tried[lows[np.argsort(shares[lows])][: Options.lows]].tolist()
    found: list[tuple[float, Any]] = [
        (omega, minimize_scalar(left, bounds=(omega - spacing, omega + spacing), method="bounded"))
        for omega in some
    ]
    return min(found, key=lambda one: one[1].fun)


def _repeats(problem: ArcProblem, omega: float) -> bool:
    """Return whether the later half of the motion is periodic, with this frequency or a fraction of
    it, or all of it is but for a size that grows or fades: what sustains itself, or grows to its
    cycle, is so too, and a drive would imitate it."""
    t, q = np.concatenate([n.t for n in problem.nodes]), problem.states[:, : problem.dim]
    sigma = np.median(problem.state_scale(problem.scales.sigma)[: problem.dim])
    late = t > np.median(t)

    def left(t: np.ndarray, q: np.ndarray, part: int, harmonics: int, powers: int) -> float:
        """Variance, of that of q, that waves leave whose sizes are polynomials of the time."""
        turned = np.outer(t, omega / part * np.arange(harmonics + 1))
        waves = np.concatenate([np.cos(turned), np.sin(turned[:, 1:])], axis=1)
        place = (t - t[0]) / np.ptp(t)
        waves = np.concatenate([waves * place[:, None] ** n for n in range(powers)], axis=1)
        rest = q - waves @ np.linalg.lstsq(waves, q, rcond=None)[0]
        return float(np.mean(rest**2) / np.mean(np.var(q, axis=0)))

    noise = (Options.noise * sigma) ** 2 / np.mean(np.var(q[late], axis=0))
    parts, many = Options.fractions, Options.harmonics
    if any(left(t[late], q[late], part, many, 1) < noise for part in parts):
        return True
    return left(t, q, 1, Options.low, Options.low + 1) < Options.grows


def with_frequency(fit: LawFit, omega: float) -> tuple[LawFit, float, float]:
    """A fit whose last two inputs are the waves of a frequency, with the frequency that fits best:
    it, and its standard error, in rad/s."""
    error = np.nan
    apart = Options.apart * 2 * np.pi / _duration(fit.problem)
    for _ in range(Options.most):
        ahead, behind = (_driven(fit.problem, omega + by).inputs for by in (apart, -apart))
        slope = (ahead(fit.arcs) - behind(fit.arcs)) / (2 * apart)
        change, error = correction(fit, slope)
        if not abs(change) > Options.settled * error:
            break
        omega += change
        fit = fit.again(problem=_driven(fit.problem, omega))
    return fit, omega, error


def _duration(problem: ArcProblem) -> float:
    return max(n.t[-1] for n in problem.nodes) - min(n.t[0] for n in problem.nodes)


def _driven(problem: ArcProblem, omega: float) -> ArcProblem:
    """The problem whose last two inputs are the waves of this frequency."""
    nodes = []
    for n in problem.nodes:
        u, turned = n.stretch.u.copy(), omega * n.stretch.t
        u[:, -2], u[:, -1] = np.cos(turned), np.sin(turned)
        nodes.append(dataclasses.replace(n, stretch=dataclasses.replace(n.stretch, u=u)))
    old = problem.inputs
    inputs = ArcInputs(nodes, old.substeps, old.hold, old.delay)
    return dataclasses.replace(problem, nodes=nodes, inputs=inputs)


def _left_of(problem: ArcProblem, stiff: bool) -> tuple[Callable[[float], float], float, int]:
    """Share of the squares of a library's weak residuals that a drive of a frequency leaves, the
    number of residuals that are independent, and of coefficients of the drive; where it is
    ``stiff`` its force is in proportion to the position, or to the angle's sine and cosine, too."""
    d, angles = problem.dim, problem.angles
    rows = libraries.first(d, angles)
    if d == 1:
        rows = [row for row in libraries.every(d, angles) if sum(row[0]) < 2 or row in rows]
    terms = libraries.without_forces(rows, problem.observation.shifts())
    friction = tuple(libraries.losses(d, (LINEAR,), 0.0)[:d])
    form = Structure(d, terms, friction, (), problem.num_inputs).form(problem.gauge)
    lengths = [np.full(len(problem.nodes), k * problem.scales.period) for k in OfWindows.lengths]
    windows = Windows.of(problem.nodes, lengths)
    X, y = weak_rows(form, windows)
    X, y = X.reshape(-1, X.shape[-1]), y.reshape(-1)
    X = X[:, X.any(axis=0)]
    U, s, _ = np.linalg.svd(X / np.linalg.norm(X, axis=0), full_matrices=False)
    Q = U[:, s > Options.rank * np.max(s, initial=0.0)]
    y = y - Q @ (Q.T @ y)
    factors = _factors(windows.x[:, :d], angles, stiff).T[:, None]  # (n, 1, m)
    many = 2 * factors.shape[-1]

    def left(omega: float) -> float:
        turned = omega * windows.t
        waves = np.stack([np.cos(turned), np.sin(turned)], axis=1)[..., None]
        both = windows.along(waves * factors).reshape(-1, many)
        A = (both[:, None, None, :] * np.eye(d)[:, :, None]).reshape(len(y), many * d)
        A = A - Q @ (Q.T @ A)
        c = np.linalg.lstsq(A, y, rcond=Options.rank)[0]
        return float(np.sum((y - A @ c) ** 2) / max(np.sum(y**2), 1e-300))

    return left, len(y) / Weak.overlap, many * d


def _factors(q: np.ndarray, angles: tuple[int, ...], stiff: bool) -> np.ndarray:
    """Factors (m, n) of the waves of a drive at positions q (n, d)."""
    own = [(np.sin(x), np.cos(x)) if i in angles else (x,) for i, x in enumerate(q.T)]
    return np.array([np.ones(len(q)), *(f for some in own[: stiff * len(own)] for f in some)])
