"""Parameters of an arm by convex least squares, every body physically possible.

    minimise  ½ Σ |(Y(q, v, a) x − τ) / σ|²
              + γ Σ_links [tr(J₀⁻¹J) − log det J] + γ Σ_i [x_i/x₀ − log x_i]

x are the links' π, the inertias of rotors, constant forces and friction. J(π) is a link's
pseudo-inertia, which has to be positive definite, and J₀ that of a CAD model or a guess; rotors
and friction have to be > 0. Both barriers are Bregman divergences, of slope 0 at the prior (Lee,
Wensing & Park, IEEE T-RO 36 (2020) 166): they keep x possible, and near the prior where the torques
do not determine it. Newton's method on the triangle of the rows ends after some ten steps, each
tried by Cholesky factors of all J.

σ is the noise of each joint's force times the root of its residual's correlation time, so that the
squares count independent residuals. Coulomb friction turns over a width in speed that the data
tell.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator

import numpy as np

from gfnn_jax.families.friction import DRY, LINEAR, QUADRATIC, Friction
from gfnn_jax.families.rigid_bodies import PER_LINK, PSEUDO, Bodies, pseudo_inertias
from gfnn_jax.fitting.evidence import correlation_time
from gfnn_jax.fitting.triangle import Triangle


class Options:
    """Options of an arm's identification (`benchmarks/arms.py`).

    prior: weight γ of the prior, in independent residuals. reflected: a rotor's inertia that is
    expected, as a share of the mass that its joint feels. rounds: of noise and parameters in turn.
    widths: of Coulomb friction that are tried, as shares of a joint's rms speed. block: samples
    whose rows are made together. saturated: share of a joint's largest force from which it is at
    its limit; plateau: share of samples at one largest force that are such a limit. explained:
    share of a joint's force below which its law does not explain it, or less than parameters of
    that joint alone by ``apart``; mended: error of a joint alone, as a share of its force, to which
    others are compared. units: factor between forces and those of a CAD model beyond which
    units are asked about. converged: Newton's decrement at which it ends. structure: random motions
    that tell the base parameters. dependent: share of a column's norm below which it depends on
    others. sharpened: a parameter's standard error has to be below this share of the parameter, or
    of what the prior expects. most: steps of Newton's method.
    """

    prior: float = 0.1
    reflected: float = 0.1
    rounds: int = 4
    widths: tuple[float, ...] = (3e-4, 1e-3, 3e-3, 0.01, 0.02, 0.05, 0.1, 0.2)
    block: int = 2_000
    saturated: float = 0.99
    plateau: float = 0.01
    explained: float = 0.5
    apart: float = 0.2
    mended: float = 0.1
    units: float = 3.0
    converged: float = 1e-9
    structure: int = 200
    dependent: float = 1e-8
    sharpened: float = 1 / 3
    most: int = 200


KINDS = {"linear": LINEAR, "quadratic": QUADRATIC, "dry": DRY}


@dataclasses.dataclass(frozen=True, eq=False)
class Motion:
    """Samples of a motion: q, v, a (n, k) of the joints and their forces (n, k), NaN where a force
    says nothing; the length of each run."""

    q: np.ndarray
    v: np.ndarray
    a: np.ndarray
    force: np.ndarray
    lengths: tuple[int, ...]

    @property
    def heard(self) -> np.ndarray:
        """Mask (k,) of joints whose forces say something."""
        return np.asarray(np.isfinite(self.force).any(axis=0))

    def without(self, rows: np.ndarray) -> Motion:
        """The motion without these forces (n, k)."""
        return dataclasses.replace(self, force=np.where(rows, np.nan, self.force))


@dataclasses.dataclass(frozen=True, eq=False)
class Columns:
    """Parameters that forces are linear in: π (10 k), rotors (k), offsets (k), and friction of
    these kinds, (k) each; widths (k,) of Coulomb friction."""

    bodies: Bodies
    kinds: tuple[str, ...]
    widths: np.ndarray

    @property
    def count(self) -> int:
        return (PER_LINK + 2 + len(self.kinds)) * self.bodies.dim

    @property
    def positive(self) -> np.ndarray:
        """Indices of rotors and friction."""
        k = self.bodies.dim
        first = PER_LINK * k
        return np.r_[first : first + k, first + 2 * k : self.count]

    @property
    def friction(self) -> Friction:
        """Friction whose coefficients are the last of the parameters."""
        unit = np.eye(self.bodies.dim, dtype=int)
        rows = [
            (unit[i], KINDS[kind], self.widths[i] if kind == "dry" else 0.0)
            for kind in self.kinds
            for i in range(self.bodies.dim)
        ]
        return Friction.of(rows, self.bodies.dim)

    def rows(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Forces (n, k, count) of the joints for a unit of each parameter."""
        k = self.bodies.dim
        rigid, lost = self.bodies.regressor(q, v, a), self.friction.residuals(v)
        found = np.zeros((len(q), k, self.count))
        found[..., : PER_LINK * k] = rigid
        found[:, range(k), range(PER_LINK * k, (PER_LINK + 1) * k)] = a
        found[:, range(k), range((PER_LINK + 1) * k, (PER_LINK + 2) * k)] = 1.0
        found[..., (PER_LINK + 2) * k :] = np.swapaxes(lost, 1, 2)
        return found

    def blocks(self, motion: Motion) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """(rows (n, k, count), forces (n, k)) of the samples, some at a time."""
        for first in range(0, len(motion.q), Options.block):
            own = slice(first, first + Options.block)
            yield self.rows(motion.q[own], motion.v[own], motion.a[own]), motion.force[own]

    def residuals(self, motion: Motion, x: np.ndarray) -> np.ndarray:
        """Forces less those of the parameters, (n, k)."""
        return np.concatenate([force - rows @ x for rows, force in self.blocks(motion)])

    def triangle(self, motion: Motion, sigma: np.ndarray) -> Triangle:
        """Triangle of the rows in units of the noise (k,) of the joints."""

        def weighted() -> Iterator[np.ndarray]:
            for rows, force in self.blocks(motion):
                both = np.concatenate([rows, force[..., None]], axis=-1) / sigma[:, None]
                yield np.asfortranarray(both[np.isfinite(force)])

        return Triangle.of_blocks(weighted(), self.count)


@dataclasses.dataclass(frozen=True, eq=False)
class Prior:
    """J₀ (k, 4, 4) of the links, the sizes x₀ of what has to be positive, and the weight γ."""

    inertias: np.ndarray
    sizes: np.ndarray
    weight: float = Options.prior

    @property
    def inverse(self) -> np.ndarray:
        return np.linalg.inv(self.inertias)

    def variances(self, columns: Columns) -> np.ndarray:
        """Covariance (count, count) of the parameters by the prior with γ = 1, 0 of offsets."""
        found = np.zeros((columns.count, columns.count))
        for i, inverse in enumerate(self.inverse):
            turned = inverse @ PSEUDO
            own = slice(PER_LINK * i, PER_LINK * (i + 1))
            found[own, own] = np.linalg.inv(np.einsum("pij,qji->pq", turned, turned))
        found[columns.positive, columns.positive] = self.sizes**2
        return found


def minimum(
    triangle: Triangle, columns: Columns, prior: Prior, start: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The parameters x of the least cost, and the Hessian there. start: a possible x."""
    A, b = triangle.leading(columns.count)
    rigid, positive = PER_LINK * columns.bodies.dim, columns.positive
    along = np.einsum("kij,pji->kp", prior.inverse, PSEUDO).ravel()
    normal, target = A.T @ A, A.T @ b
    normal[np.diag_indices_from(normal)] += np.diag(normal) == 0  # of what no row has

    def cost(x: np.ndarray) -> float:
        if np.any(x[positive] <= 0):
            return np.inf
        try:
            factors = np.linalg.cholesky(pseudo_inertias(x[:rigid]))
        except np.linalg.LinAlgError:
            return np.inf
        volume = 2 * np.sum(np.log(np.diagonal(factors, axis1=1, axis2=2)))
        shares = x[positive] / prior.sizes
        return 0.5 * np.sum((A @ x - b) ** 2) + prior.weight * (
            along @ x[:rigid] - volume + np.sum(shares - np.log(shares))
        )

    x, value = start, cost(start)
    for _ in range(Options.most):
        turned = np.linalg.inv(pseudo_inertias(x[:rigid]))[:, None] @ PSEUDO
        slope, hessian = normal @ x - target, normal.copy()
        slope[:rigid] += prior.weight * (along - np.trace(turned, axis1=2, axis2=3).ravel())
        for i, own in enumerate(turned):
            at = slice(PER_LINK * i, PER_LINK * (i + 1))
            hessian[at, at] += prior.weight * np.einsum("pij,qji->pq", own, own)
        slope[positive] += prior.weight * (1 / prior.sizes - 1 / x[positive])
        hessian[positive, positive] += prior.weight / x[positive] ** 2
        scale = 1 / np.sqrt(np.diag(hessian))
        step = -scale * np.linalg.solve(scale[:, None] * hessian * scale, scale * slope)
        fall, share = -slope @ step, 1.0
        if fall < Options.converged * (1 + abs(value)):
            break
        while (tried := cost(x + share * step)) > value - 0.25 * share * fall and share > 1e-9:
            share *= 0.5
        if share <= 1e-9:  # at roundoff
            break
        x, value = x + share * step, tried
    return x, hessian


def widths_of(columns: Columns, motion: Motion) -> np.ndarray:
    """Widths (k,) of Coulomb friction by which each joint's own forces are explained best."""
    k, kinds = columns.bodies.dim, tuple(kind for kind in columns.kinds if kind != "dry")
    others = dataclasses.replace(columns, kinds=kinds)
    rows = np.concatenate([rows for rows, _ in others.blocks(motion)])
    found = columns.widths.copy()
    for i in range(k):
        known = np.isfinite(motion.force[:, i])
        if not known.any():
            continue
        own, v = rows[known, i], motion.v[known, i]
        rms = np.sqrt(np.mean(v**2))
        sizes = np.linalg.norm(own, axis=0)
        u, s, _ = np.linalg.svd(own[:, sizes > 0] / sizes[sizes > 0], full_matrices=False)
        u = u[:, s > Options.dependent * s[0]]
        force = motion.force[known, i]
        force = force - u @ (u.T @ force)
        gains = []
        for width in rms * np.array(Options.widths):
            shape = v / np.hypot(v, width)
            shape = shape - u @ (u.T @ shape)
            gains.append((shape @ force) ** 2 / (shape @ shape))
        found[i] = rms * Options.widths[int(np.argmax(gains))]
    return np.where(motion.heard, found, found.max())


@dataclasses.dataclass(frozen=True, eq=False)
class Identified:
    """Parameters x (count,) and their covariance, by data and prior; the triangle of the rows in
    units of the noise; the residual's rms (k,) and correlation time (k,) of each joint."""

    columns: Columns
    x: np.ndarray
    covariance: np.ndarray
    triangle: Triangle
    residual: np.ndarray
    correlation: np.ndarray
    prior: Prior


def identified(
    columns: Columns, motion: Motion, prior: Prior, start: np.ndarray, report: Callable[[str], None]
) -> Identified:
    """The parameters of an arm by a motion. start: a possible x."""
    if "dry" in columns.kinds:
        columns = dataclasses.replace(columns, widths=widths_of(columns, motion))
    known = np.maximum(np.isfinite(motion.force).sum(axis=0), 1)
    size = np.sqrt(np.nansum(motion.force**2, axis=0) / known)
    size[size == 0] = 1.0
    sigma, x = size.copy(), start
    for number in range(Options.rounds):
        report(f"parameters of the arm, round {number + 1}")
        triangle = columns.triangle(motion, sigma)
        x, hessian = minimum(triangle, columns, prior, x)
        left = columns.residuals(motion, x)
        residual = np.sqrt(np.nansum(left**2, axis=0) / known)
        runs = np.split(left, np.cumsum(motion.lengths)[:-1])
        longest = max(motion.lengths)
        padded = np.stack(
            [np.pad(run, ((0, longest - len(run)), (0, 0)), constant_values=np.nan) for run in runs]
        )
        correlation = np.array([correlation_time(padded[..., i : i + 1]) for i in range(len(size))])
        sigma = np.maximum(residual, 1e-9 * size) * np.sqrt(correlation)
    scale = 1 / np.sqrt(np.diag(hessian))
    inverse = np.linalg.inv(scale[:, None] * hessian * scale)
    covariance = scale[:, None] * inverse * scale
    return Identified(columns, x, covariance, triangle, residual, correlation, prior)


@dataclasses.dataclass(frozen=True, eq=False)
class BaseParameters:
    """The sums of parameters that forces depend on, of rigid bodies, rotors and offsets.

    names: each sum as text. turn: (m, count) of the parameters. values, errors: (m,) as fitted,
    with the standard errors by the data alone, inf where they say nothing. expected: (m,) sizes by
    the prior, those of offsets by the forces' residual.
    """

    names: tuple[str, ...]
    turn: np.ndarray
    values: np.ndarray
    errors: np.ndarray
    expected: np.ndarray

    @property
    def determined(self) -> np.ndarray:
        """Mask (m,) of those that the data tell, to a part of their size or of the prior."""
        return self.errors < Options.sharpened * np.maximum(self.expected, np.abs(self.values))


def base_parameters(found: Identified, motion: Motion) -> tuple[BaseParameters, str | None]:
    """The base parameters of an arm, which of them a motion determines, and the joint whose swings,
    from poses of the motion, would determine most of the others; None where there are none.

    Random motions tell the sums: a parameter whose column depends on those before it, of links
    nearer the base, is added to them (Gautier, J. Robot. Syst. 8 (1991) 485).
    """
    columns, bodies = found.columns, found.columns.bodies
    k, rng = bodies.dim, np.random.default_rng(0)
    rigid = dataclasses.replace(columns, kinds=())
    q, v, a = rng.uniform(-np.pi, np.pi, (3, Options.structure, k))
    rows = rigid.rows(q, v, a).reshape(-1, rigid.count)
    within = [4, 5, 6, 7, 8, 9, 1, 2, 3, 0]  # the mass last: it is what moves into others
    order = [PER_LINK * i + j for i in range(k) for j in within]
    order += range(PER_LINK * k, rigid.count)
    sizes = np.linalg.norm(rows, axis=0)
    some = [j for j in order if sizes[j] > Options.dependent * sizes.max()]
    R = np.asarray(np.linalg.qr(rows[:, some] / sizes[some], mode="r"))
    free = np.abs(np.diag(R)) > Options.dependent
    own, rest = np.flatnonzero(free), np.flatnonzero(~free)
    mixed = np.linalg.lstsq(R[:, own], R[:, rest], rcond=None)[0]
    mixed = np.where(np.abs(mixed) > Options.dependent, mixed, 0.0)
    turn, added = np.zeros((len(own), columns.count)), [some[r] for r in rest]
    for row, j in enumerate(own):
        turn[row, some[j]] = 1.0
        turn[row, added] = mixed[row] * sizes[added] / sizes[some[j]]
    names = [*bodies.parameter_names]
    names += [f"{word} {name}" for word in ("rotor", "offset") for name in bodies.names]
    texts = tuple(_sum(row, names) for row in turn)
    # The data's rows depend on base parameters and friction alone: those columns are theirs.
    kept = [*(some[j] for j in own), *range(rigid.count, columns.count)]
    A = found.triangle.leading(columns.count)[0][:, kept]
    spread = turn @ found.prior.variances(columns)
    expected = np.sqrt(np.einsum("ij,ij->i", spread, turn))
    expected[-k:] = found.residual  # of offsets
    base = BaseParameters(texts, turn, turn @ found.x, _errors(A)[: len(own)], expected)
    if base.determined.all():
        return base, None
    noise = np.where(found.residual > 0, found.residual, found.residual.max() or 1.0)[:, None]
    poses, told = motion.q[rng.integers(len(motion.q), size=Options.structure)], []
    for unit in np.eye(k):
        swing, v, a = rng.uniform(-np.pi, np.pi, (3, len(poses), 1)) * unit
        q = np.where(unit, swing, poses)
        swings = (columns.rows(q, v, a) / noise)[:, motion.heard | (unit > 0)][..., kept]
        errors = _errors(np.concatenate([A, swings.reshape(-1, len(kept))]))[: len(own)]
        told.append(dataclasses.replace(base, errors=errors).determined.sum())
    return base, bodies.names[int(np.argmax(told))]


def _errors(A: np.ndarray) -> np.ndarray:
    """Standard errors of parameters with rows A in units of noise, inf where they say nothing."""
    scale = np.linalg.norm(A, axis=0)
    empty, scale = scale == 0, np.where(scale == 0, 1.0, scale)
    _, s, vt = np.linalg.svd(A / scale, full_matrices=False)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = np.where(s > Options.dependent * s[0], 1 / s, np.inf)
        parts = np.where(np.abs(vt.T) > Options.dependent, vt.T * inverse, 0.0)
    return np.where(empty, np.inf, np.linalg.norm(parts, axis=1) / scale)


def _sum(row: np.ndarray, names: list[str]) -> str:
    """A sum of parameters as text, that with factor 1 first."""
    listed = np.flatnonzero(row)
    text = ""
    for j in listed:
        size = "" if abs(abs(row[j]) - 1.0) < Options.dependent else f"{abs(row[j]):.3g} "
        sign = "-" if row[j] < 0 else "+"
        text += f" {sign} {size}{names[j]}" if text else f"{size}{names[j]}"
    return text
