"""Gauss–Newton over arcs whose states are latent.

An arc is a stretch of one run: states x_0 … x_{L−1} at its nodes, of which only

    y_n = g(x_n; p) + noise,        D(x_n, x_{n+1}; p) = 0

is known. A model supplies g and the defect D between neighbouring states: of a law the end of its
step, F(x_n; p) − x_{n+1}; of a generating function Z − z − h J∇S(w). A pair is an arc of two
states. All nodes are kept as unknowns, so that every defect is evaluated at once, and an arc need
not be followed from its first state (multiple shooting; Bock, Springer Ser. Chem. Phys. 18 (1981)
102). An iteration linearises

    δx_{n+1} = Φ_n δx_n + Γ_n δp + c_n,

c_n the move of x_{n+1} that would close the defect, which makes δx_n a function of δx_0 and δp
alone. The arc's own δx_0 is eliminated by its own QR; what remains of all arcs are rows for δp.
Where it converges the defects are zero, and each arc is an orbit of the model. Residuals enter in
units of the noise through a robust loss (`solve.noise`). The noise may be estimated on the way.
Where it is not white, a *whitening* (`solve.noise`) mixes residuals along an arc into white ones.

Where the least residuals lie in a canyon that bends, as of coefficients that act on what nothing
shows, or of masses that phases alone tell apart, a straight step soon leaves it, and brings less
than it promised. From then on steps bend as the canyon does: δ + ½ a, a the acceleration that keeps
the linearised residuals (geodesic acceleration: Transtrum & Sethna, arXiv:1207.4999), as long as
one of them lowers the cost. Each needs one further evaluation, without derivatives.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from functools import cached_property, partial
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np

from gfnn_jax.solve.levenberg_marquardt import Factors, Tried, descended
from gfnn_jax.solve.noise import Loss, SoftL1, of_residuals


class Defects(NamedTuple):
    """The linearised defects of states (A, L, m): c_n (A, L − 1, m), Φ_n (…, m, m) and, in the n
    coefficients, Γ_n (…, m, n)."""

    closing: np.ndarray
    by_state: np.ndarray
    by_coefficients: np.ndarray


def flow_defects(
    rates: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]],
    x: np.ndarray,
    h: np.ndarray,
    parameters: int,
    substeps: int,
) -> Defects:
    """Ends of Runge–Kutta steps of order 4 of ż = f(z; p) from all nodes x (A, L, n) but the last,
    less the next nodes.

    h: (A (L − 1), 1), times between nodes. parameters: of p. rates: (ż (N, n), its derivatives) of
    z (N, n) and the derivatives (N, n, n + P) of z in the node it began at and in p.
    """
    arcs, length, n = x.shape
    z, h = x[:, :-1].reshape(-1, n), h / substeps
    slope = np.zeros((len(z), n, n + parameters))
    slope[:, range(n), range(n)] = 1.0
    for _ in range(substeps):
        total, change, at = np.zeros_like(z), np.zeros_like(slope), (z, slope)
        for part, weight in zip((0.5, 0.5, 1.0, 0.0), (1, 2, 2, 1), strict=True):
            rate, moving = rates(*at)
            total, change = total + weight * rate / 6, change + weight * moving / 6
            at = z + part * h * rate, slope + part * h[..., None] * moving
        z, slope = z + h * total, slope + h[..., None] * change
    ends = z.reshape(arcs, length - 1, n)
    slope = slope.reshape(arcs, length - 1, n, -1)
    return Defects(ends - x[:, 1:], slope[..., :n], slope[..., n:])


class Observed(NamedTuple):
    """g at the states (A, L, k), and its derivatives (A, L, k, m) and (A, L, k, n)."""

    values: np.ndarray
    by_state: np.ndarray
    by_coefficients: np.ndarray


@runtime_checkable
class Model(Protocol):
    """States that move and are measured: what `Readings.fit` asks of a law, or of any other map."""

    def defects(self, p: np.ndarray, x: np.ndarray) -> Defects: ...

    def observe(self, p: np.ndarray, x: np.ndarray) -> Observed: ...

    def take(self, arcs: np.ndarray) -> Model:
        """The same model of some of the arcs (indices)."""
        ...


def observed_whole(x: np.ndarray, coefficients: int) -> Observed:
    """The states themselves, g(x; p) = x."""
    own = np.broadcast_to(np.eye(x.shape[-1]), (*x.shape, x.shape[-1]))
    return Observed(x, own, np.broadcast_to(0.0, (*x.shape, coefficients)))


@dataclasses.dataclass(frozen=True)
class Known:
    """A model whose coefficients p (n,) are known: only states are latent."""

    model: Model
    p: np.ndarray

    def take(self, arcs: np.ndarray) -> Known:
        return Known(self.model.take(arcs), self.p)


def evaluated(model: Model | Known, p: np.ndarray, x: np.ndarray) -> tuple[Defects, Observed]:
    """The linearised defects of states x (A, L, m), and what is measured of them."""
    if not isinstance(model, Known):
        return model.defects(p, x), model.observe(p, x)
    defects, observed = evaluated(model.model, model.p, x)
    return (
        defects._replace(by_coefficients=defects.by_coefficients[..., :0]),
        observed._replace(by_coefficients=observed.by_coefficients[..., :0]),
    )


@runtime_checkable
class Following(Protocol):
    """A model that can be followed from one state on."""

    def followed(self, p: np.ndarray, x: np.ndarray) -> np.ndarray:
        """The orbits (A, L, m) from the first states of x (A, L, m)."""
        ...


@runtime_checkable
class Stepping(Model, Protocol):
    """A model whose defects can be told without their derivatives, as steps that bend ask."""

    def closing(self, p: np.ndarray, x: np.ndarray) -> np.ndarray:
        """c_n (A, L − 1, m) of states x (A, L, m)."""
        ...


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of Gauss–Newton over latent arcs (benchmarks/random_recordings.py)."""

    # a defect of this many standard deviations costs as much as a residual of one
    defect: float = 0.1
    # Standard deviations, rms: of all defects, below which steps lower the cost; and of the jumps
    # of an arc, added up as those of a random walk, below which it is an orbit of the model.
    closed: float = 0.1
    joining: int = 5  # steps that close what a descent has left open
    settled: float = 0.003  # of the noise: a change that needs no further iteration
    # Of the largest pivot, each in units of its column, below which one determines nothing: of an
    # arc of gross errors alone, or of the speed of a body that sticks.
    loose: float = 1e-12
    # Of a step, that an arc which it made worse goes with its states: where arcs share no
    # coefficients, and where they do.
    parts_alone: tuple[float, ...] = (0.5, 0.25, 0.125, 0.0)
    parts_together: tuple[float, ...] = (0.25, 0.0)
    # times the defects of an arc that stays, at the most, by a step of the coefficients
    grown: float = 2.0
    block_bytes: int = 64 * 2**20  # of the sensitivities of a block of arcs
    determined: float = 1e-6  # least singular value, of columns of norm 1, of a direction that is
    short: float = 0.5  # of the decrease that was promised: below, steps are bent
    trials: int = 4  # of steps that bend, from one place; the straight ones after these are shorter
    probed: float = 0.1  # of a step, over which its curvature is told
    bent: float = 1.5  # times a step, that its acceleration may be: Transtrum and Sethna's 2 · ¾


OPTIONS = Options()

_DAMPING = Factors(1e-4, first=5e-6, grown_by=5.0, shrunk_by=0.2, least=1e-12, keeps=True)
OUTLYING = 5.0  # standard deviations: a residual beyond does not tell the noise
SOFT_L1 = SoftL1()


@dataclasses.dataclass(frozen=True)
class Fitted:
    """The fit of all arcs.

    p: (n,) coefficients. x: (A, L, m) states. residuals: (A, L, k) in units of the noise, NaN where
    nothing was measured; whitened: the same after the whitening. sigma: the noise as given or
    estimated, (k,) or (A, L, k). factor: the triangle (n + 1, n + 1) of [∂r/∂p, r] without the
    states; 0 where derivatives along an arc overflow. scores: (A, n) each arc's part of the
    gradient in p. arcs: (A, m, m) triangles of each δx_0 with p fixed. transports: (A, m, m)
    ∂x_{L−1}/∂x_0. rows: (A, L k, m + 1) of [δx_0, r] as of `Readings.linearised`, none where there
    are coefficients. open: (A,) what each arc's defects cost, 0 of an arc that is an orbit. cost:
    infinite where the defects could not be closed, or derivatives overflow, and open then too.
    """

    p: np.ndarray
    x: np.ndarray
    residuals: np.ndarray
    whitened: np.ndarray
    sigma: np.ndarray
    factor: np.ndarray
    scores: np.ndarray
    arcs: np.ndarray
    transports: np.ndarray
    rows: np.ndarray
    open: np.ndarray
    cost: float
    iterations: int
    converged: bool

    @property
    def triangle(self) -> np.ndarray:
        """(n, n), of p alone."""
        return self.factor[:-1, :-1]

    def last_covariance(self) -> np.ndarray:
        """Covariance of the last state of each arc (A, m, m), with p as it is; 1e100 of each
        coordinate where derivatives overflow."""
        both = self.arcs + self.transports
        known = np.asarray(np.isfinite(both).all(axis=(1, 2)))
        root = self.transports[known] @ np.linalg.pinv(self.arcs[known])
        covariance = np.tile(1e100 * np.eye(self.transports.shape[1]), (len(known), 1, 1))
        covariance[known] = root @ root.swapaxes(1, 2)
        return covariance


@dataclasses.dataclass(frozen=True, eq=False)
class Readings:
    """Readings y (A, L, k) of the latent states of arcs, and the model that they are compared with.

    y: NaN where nothing was measured. sigma: (k,) or (A, L, k), their noise. loss: of residuals in
    units of it. whitening: (A, k, L, L) of these residuals, by channel; None: they are white.
    """

    model: Model | Known
    y: np.ndarray
    sigma: np.ndarray
    loss: Loss = SOFT_L1
    whitening: np.ndarray | None = None

    def fit(
        self,
        p: np.ndarray,
        x: np.ndarray,
        state_scale: np.ndarray,
        *,
        max_iterations: int = 30,
        tolerance: float = 1e-4,
        least: np.ndarray | None = None,
    ) -> Fitted:
        """Fit p (n,) and the states x (A, L, m), from what they start at, to the readings.

        ``state_scale`` (m,) is the defect that counts as one standard deviation. While defects
        matter, an iteration has to close them; then it has to lower the cost. Ends where it lowers
        it by less than ``tolerance`` of itself, and a whole step promises no more. The cost is
        infinite where the defects could not be closed.

        least: (k,) what of the residuals is no noise; sigma is then where the noise starts from,
        and is estimated by every iteration, of (A, L, k) one factor for each of the k. None: sigma
        is known.
        """
        measured = np.isfinite(self.y)
        known = np.where(measured, self.y, 0.0)
        data = _Data(self.model, measured, known, least, tolerance)
        here = data.at(p, x, _Units(self.sigma, state_scale, self.loss, self.whitening))
        start = _AtStates(data, here, here, np.arange(len(x)))
        if not np.isfinite(here.cost):
            return start.fitted(0, converged=False)
        found = descended(start, _DAMPING, max_iterations)
        steps = found.steps
        if not found.problem.here.joined:
            joining = dataclasses.replace(found.problem, joins=True)
            found = descended(joining, _DAMPING, OPTIONS.joining)
            steps += found.steps
            if found.problem.here.joined and not found.settled:
                found = descended(found.problem, _DAMPING, max(max_iterations - steps, 0))
                steps += found.steps
        last: _AtStates = found.problem
        converged = (found.settled or found.stuck) and last.here.joined
        return last.fitted(steps, converged and bool(np.isfinite(last.here.cost)))

    def linearised(self, p: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rows (A, L k, m + n + 1) of [δx_0, δp, r] of all arcs at p and x, weighted as robust loss
        has it, and δx_{L−1} (A, m, m + n + 1) by the same and by the defects before it."""
        measured, (defects, observed) = np.isfinite(self.y), evaluated(self.model, p, x)
        off = np.where(measured, np.where(measured, self.y, 0.0) - observed.values, 0.0)
        units = _Units(self.sigma, np.ones(x.shape[-1]), self.loss, self.whitening)
        return _linearised(_Iterate(p, x, defects, observed, measured, off, units), slice(None))

    def rows(self, p: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Rows (A, L, k, n + 1) of the coefficients and the residuals after each arc's own δx_0 was
        projected out: residuals − rows · δp are those of any other coefficients near p, each arc
        with the state that suits them best."""
        (J, _), m = self.linearised(p, x), x.shape[-1]
        Q = np.linalg.qr(J[..., :m])[0]
        return (J[..., m:] - Q @ (Q.swapaxes(1, 2) @ J[..., m:])).reshape(*self.y.shape, -1)

    def eliminated_rows(self, p: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Rows (R, n + 1) of [∂r/∂p, r] without the states of each arc: what its own state does not
        explain."""
        (J, _), m = self.linearised(p, x), x.shape[-1]
        across = np.linalg.qr(J[..., :m], mode="complete")[0][..., m:]
        return (across.swapaxes(1, 2) @ J[..., m:]).reshape(-1, J.shape[-1] - m)

    def last_by_coefficients(self, p: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Derivative (A, m, n) in p of the last state of each arc that was fitted with p fixed."""
        (J, last), m = self.linearised(p, x), x.shape[-1]
        R = np.asarray(np.linalg.qr(J, mode="r"))
        first = np.linalg.solve(R[:, :m, :m], -R[:, :m, m:-1])
        return last[..., :m] @ first + last[..., m:-1]


class _Data(NamedTuple):
    """Data that arcs are fitted to.

    measured, known: which of y (A, L, k) was measured, and y, 0 where it was not. least: what of
    the residuals is no noise; None: the noise is known. tolerance: of the cost.
    """

    model: Model | Known
    measured: np.ndarray
    known: np.ndarray
    least: np.ndarray | None
    tolerance: float

    def at(self, p: np.ndarray, x: np.ndarray, units: _Units) -> _Iterate:
        """The residuals and defects of coefficients p and states x."""
        with np.errstate(all="ignore"):
            defects, observed = evaluated(self.model, p, x)
        return self._of(p, x, defects, observed, units)

    def _of(
        self, p: np.ndarray, x: np.ndarray, defects: Defects, observed: Observed, units: _Units
    ) -> _Iterate:
        with np.errstate(all="ignore"):
            off = np.where(self.measured, self.known - observed.values, 0.0)
        return _Iterate(p, x, defects, observed, self.measured, off, units)

    def moved(self, here: _Iterate, arcs: np.ndarray, x: np.ndarray) -> _Iterate:
        """The same iterate, but that these arcs (indices, n) have the states x (n, L, m)."""
        with np.errstate(all="ignore"):
            found = evaluated(self.model.take(arcs), here.p, x)
        return self._with(here, arcs, x, *found)

    def bending(self, here: _Iterate, dp: np.ndarray, dx: np.ndarray) -> _Iterate:
        """The same iterate with second derivatives along a step, of what is measured and of the
        defects, in place of its residuals and defects."""
        assert isinstance(self.model, Stepping)
        part, shown, closing = OPTIONS.probed, here.observed, here.defects.closing
        p, x = here.p + part * dp, here.x + part * dx
        along = (shown.by_state @ dx[..., None])[..., 0] + shown.by_coefficients @ dp
        with np.errstate(all="ignore"):
            values = self.model.observe(p, x).values - shown.values - part * along
            defects = self.model.closing(p, x) - (1 - part) * closing  # a whole step closes them
        return dataclasses.replace(
            here,
            defects=here.defects._replace(closing=2 / part**2 * defects),
            off=np.where(self.measured, -2 / part**2 * values, 0.0),
            weighted=here.weights,
        )

    def mixed(self, here: _Iterate, other: _Iterate, arcs: np.ndarray) -> _Iterate:
        """The same iterate, but that these arcs (indices, n) are as in the other."""
        defects = Defects(*(part[arcs] for part in other.defects))
        observed = Observed(*(part[arcs] for part in other.observed))
        return self._with(here, arcs, other.x[arcs], defects, observed)

    def _with(
        self, here: _Iterate, arcs: np.ndarray, x: np.ndarray, defects: Defects, observed: Observed
    ) -> _Iterate:
        defects = Defects(*map(partial(_replaced, arcs), here.defects, defects))
        observed = Observed(*map(partial(_replaced, arcs), here.observed, observed))
        return self._of(here.p, _replaced(arcs, here.x, x), defects, observed, here.units)


@dataclasses.dataclass(frozen=True)
class _AtStates:
    """The problem of all arcs where a descent stands, the best iterate that it came by, and which
    arcs are ``moving`` (indices): of those that share nothing, the ones that have not settled.

    While defects matter a step has to close them; then it has to lower the cost. They matter until
    they are small all in all (`closed`); where a descent has ended so, with a jump that readings
    pull open, until each arc is an orbit (``joins``). Once a step has brought much less than the
    linear problem promised, steps are bent along the valley (``bends``), where the model is a
    `Stepping` one; until at one place none of these lowers the cost: at the next one a straight
    step comes first again.
    """

    data: _Data
    here: _Iterate
    best: _Iterate
    moving: np.ndarray
    bends: bool = False
    joins: bool = False

    @property
    def _apart(self) -> bool:
        """Return whether arcs share nothing, neither coefficients nor noise."""
        return not len(self.here.p) and self.data.least is None

    @cached_property
    def _rows(self) -> _Rows:
        return _reduced(self.here, leverage=self.data.least is not None)

    def closed(self, at: _Iterate) -> bool:
        """True where defects are small enough for a step to lower the cost."""
        return at.joined if self.joins else at.gap <= OPTIONS.closed * math.sqrt(at.x.size)

    def tried(self, damping: float, failures: int) -> Tried:
        """A step of p and x, which bends at first; each that failed halves the next. Where
        it fails, each arc halves its own: one that is hard to follow holds back no other."""
        here, share = self.here, 0.5**failures
        if self._apart:
            return self._each()
        if not np.isfinite(self._rows.factor).all():  # derivatives along an arc have overflowed
            return Tried(here, -np.inf, damping, hopeless=True)
        bends = self.bends or (failures > 0 and isinstance(self.data.model, Stepping))
        bends, straight = bends and self.closed(here), failures - OPTIONS.trials
        if bends and straight >= 0:
            share = 0.5 ** (1 + straight)
            if straight == 0:  # as little damping as where bent steps began
                damping /= _DAMPING.grown_by**OPTIONS.trials
        dp, dx = _solve(self._rows, here.defects, damping)
        if bends and straight < 0:
            return self._curved(dp, dx, damping)
        there = self.data.at(here.p + share * dp, here.x + share * dx, here.units)
        decrease = self._decrease(there, share, np.zeros(len(here.x), bool))
        if not decrease > 0:
            there, stays = self._alone(there, share, dx)
            decrease = self._decrease(there, share, stays)
            if not decrease > 0 and stays.any():
                there, stays = self._begun_anew(there, stays)
                decrease = self._decrease(there, share, stays)
        return Tried(_Ahead(there, straightened=bends), decrease, damping)

    def _each(self) -> Tried:
        """A step of arcs that share nothing, each as far as is best for it."""
        here, arcs = self.here, self.moving
        if not len(arcs):
            return Tried(here, -np.inf, 0.0, hopeless=True)
        defects, dx = Defects(*(part[arcs] for part in here.defects)), np.zeros_like(here.x)
        dx[arcs] = _solve(_reduced(here, arcs), defects, 0.0)[1]
        there = self.data.moved(here, arcs, here.x[arcs] + dx[arcs])
        there, _ = self._alone(there, 1.0, dx)
        decrease = np.sum(here.merits - there.merits)
        return Tried(_Ahead(there), decrease, 0.0, hopeless=True)

    def _curved(self, dp: np.ndarray, dx: np.ndarray, damping: float) -> Tried:
        """The end of a whole step that bends, or of the straight one where it would bend by more
        than is small."""
        here = self.here
        p, x, bending = here.p + dp, here.x + dx, self.data.bending(here, dp, dx)
        rows = _reduced(bending)
        if np.isfinite(rows.factor).all():
            ddp, ddx = _solve(rows, bending.defects, damping)
            scale = np.linalg.norm(self._rows.triangle, axis=0)
            if np.linalg.norm(scale * ddp) < OPTIONS.bent * np.linalg.norm(scale * dp):
                p, x = p + 0.5 * ddp, x + 0.5 * ddx
        there = self.data.at(p, x, here.units)
        decrease = self._decrease(there, 1.0, np.zeros(len(x), bool))
        return Tried(_Ahead(there), decrease, damping)

    def _decrease(self, there: _Iterate, share: float, stays: np.ndarray) -> float:
        """Decrease of the cost by this share of a step, or of the defects while they matter: of
        those of arcs but for the ones that stay (A,) where they are."""
        if self.closed(self.here):
            # Roundoff may hide what the last steps gain; others that gain nothing have failed.
            last = self.promised <= self.data.tolerance * self.here.cost
            return self.here.merit * (1 + 1e-9 * last) - there.merit
        if not np.isfinite(there.gap):
            return -np.inf
        before, after = (np.sqrt(np.sum(at.gaps[~stays])) for at in (self.here, there))
        return float((1 - 0.5 * share) * before - after)

    def _alone(self, there: _Iterate, share: float, dx: np.ndarray) -> tuple[_Iterate, np.ndarray]:
        """The end of a step with which arcs (A, L, m) that it made worse go less far with their
        states, each as far as is best for it; and, while defects matter, which arcs stay (A,): no
        part of the step is good for these, and their defects at the new p are not much larger."""
        here, stays = self.here, np.zeros(len(self.here.x), bool)
        of_gaps = len(self.here.p) > 0 and not self.closed(self.here)

        def left(at: _Iterate) -> np.ndarray:
            return at.gaps if of_gaps else at.merits

        before = left(here) * (1 + 1e-9)
        for part in OPTIONS.parts_alone if not len(here.p) else OPTIONS.parts_together:
            now = left(there)
            worse = np.flatnonzero(~(now <= before))
            if not len(worse):
                break
            x = here.x[worse] + share * part * dx[worse] if part else here.x[worse]
            back = not part and not len(here.p)
            other = here if back else self.data.moved(there, worse, x)
            better = (left(other)[worse] < now[worse]) | ~np.isfinite(now[worse])
            there = self.data.mixed(there, other, worse[better])
            if of_gaps and part == 0:
                stays[worse] = better & (left(other)[worse] <= OPTIONS.grown**2 * before[worse])
        return there, stays

    def _begun_anew(self, there: _Iterate, stays: np.ndarray) -> tuple[_Iterate, np.ndarray]:
        """The iterate with orbits of the model in place of arcs that stay (A,), from their first
        states, where an orbit costs less than the arc's defects; and which arcs stay then. Where a
        body sticks between two nodes, and slid, no step closes the defects."""
        arcs = np.flatnonzero(stays)
        model = self.data.model.take(arcs)
        if not isinstance(model, Following):
            return there, stays
        other = self.data.moved(there, arcs, model.followed(there.p, there.x[arcs]))
        better = arcs[other.merits[arcs] < there.merits[arcs]]
        stays = stays.copy()
        stays[better] = False
        return self.data.mixed(there, other, better), stays

    def moved(self, there: _Ahead, damping: float) -> tuple[_AtStates, bool]:
        """The problem at the end of a step, in units of the noise that its residuals tell; settled
        where it gained little and, where the noise is estimated, that is the same."""
        before, best, least = self.here, self.best, self.data.least
        after, straightened = there
        if self._apart:
            gained, most = before.merits - after.merits, OPTIONS.closed**2 * after.x[0].size
            cost = before.merits - before.gaps / OPTIONS.defect**2
            ended = (before.gaps <= most) & (after.open == 0)
            ended &= gained <= self.data.tolerance * cost
            moving = self.moving[~(ended | (gained <= 0))[self.moving]]
            return _AtStates(self.data, after, after, moving), bool(ended.all())
        settled = self.closed(before) and self.closed(after)
        settled &= before.merit - after.merit <= self.data.tolerance * before.cost
        here = after
        if least is not None:
            best = here = after.rescaled(self._rows, least)
            sigma = after.units.sigma
            settled &= bool(np.allclose(here.units.sigma, sigma, rtol=OPTIONS.settled, atol=0))
        elif self.closed(here) and (not self.closed(best) or here.merit < best.merit):
            best = here
        short = before.merit - after.merit < OPTIONS.short * self.promised
        bends = short and self.closed(before) and isinstance(self.data.model, Stepping)
        bends = (self.bends or bends) and not straightened
        problem = dataclasses.replace(self, here=here, best=best, bends=bends)
        settled = settled and problem.promised <= self.data.tolerance * here.cost
        return problem, settled or not np.isfinite(here.cost)

    @cached_property
    def promised(self) -> float:
        """Decrease of the cost by a whole step of what is determined, if residuals and defects were
        linear: a short step in a narrow valley lowers it by little."""
        R, n = self._rows.factor, len(self.here.p)
        if not n or not np.isfinite(R).all():
            return 0.0
        U, sizes, _ = np.linalg.svd(R[:, :n] / _sizes(R[:, :n]))
        return 0.5 * float(np.sum((U[:, :n].T @ R[:, n])[sizes > OPTIONS.determined] ** 2))

    def fitted(self, iterations: int, converged: bool) -> Fitted:
        """The fit that ends here."""
        best, measured = self.best if self.best.joined else self.here, self.data.measured
        rows, m = self._rows if best is self.here else _reduced(best), best.x.shape[-1]
        finite = np.isfinite(rows.factor).all()
        return Fitted(
            best.p,
            best.x,
            np.where(measured, best.residuals, np.nan),
            np.where(measured, best.white, np.nan),
            best.units.sigma,
            rows.factor if finite else np.zeros_like(rows.factor),
            rows.scores,
            rows.arcs[:, :, :m],
            rows.transports,
            rows.rows,
            best.open if finite else best.open + np.inf,
            best.cost if best.joined and finite else np.inf,
            iterations,
            converged and bool(finite),
        )


class _Ahead(NamedTuple):
    """The end of a step; straightened: one that is straight since all that bend had failed."""

    iterate: _Iterate
    straightened: bool = False


def _replaced(arcs: np.ndarray, every: np.ndarray, some: np.ndarray) -> np.ndarray:
    if len(arcs) == len(every):
        return some
    whole = every.copy()
    whole[arcs] = some
    return whole


class _Units(NamedTuple):
    """σ of what is measured, the defects (m,) that count as much, the loss, and the whitening."""

    sigma: np.ndarray
    state: np.ndarray
    loss: Loss
    whitening: np.ndarray | None = None

    def white(self, rows: np.ndarray, block: slice | np.ndarray = slice(None)) -> np.ndarray:
        """Rows (a, L, k, ...) of a block of arcs, mixed along each arc into white ones."""
        if self.whitening is None:
            return rows
        by_channel = rows.reshape(*rows.shape[:3], -1).swapaxes(1, 2)
        return (self.whitening[block] @ by_channel).swapaxes(1, 2).reshape(rows.shape)


@dataclasses.dataclass(frozen=True, eq=False)
class _Iterate:
    """State of an iteration. off: residuals (A, L, k) in the units of y. weighted: the roots of
    their weights (A, L, k), where these are not those of the loss."""

    p: np.ndarray
    x: np.ndarray
    defects: Defects
    observed: Observed
    measured: np.ndarray
    off: np.ndarray
    units: _Units
    weighted: np.ndarray | None = None

    @cached_property
    def weights(self) -> np.ndarray:
        """Roots (A, L, k) of the weights of the residuals, 0 of what was not measured."""
        if self.weighted is not None:
            return self.weighted
        return np.where(self.measured, np.sqrt(self.units.loss.weights(self.white)), 0.0)

    @cached_property
    def residuals(self) -> np.ndarray:
        """(A, L, k) in units of σ."""
        with np.errstate(all="ignore"):
            return self.off / self.units.sigma

    @cached_property
    def white(self) -> np.ndarray:
        """The same made white."""
        with np.errstate(all="ignore"):
            return self.units.white(self.residuals)

    @cached_property
    def _size(self) -> tuple[float, float]:
        with np.errstate(all="ignore"):
            cost = float(np.sum(self.units.loss.of(self.white)))
            gap = math.sqrt(np.sum(self.gaps))
        return (cost, gap) if np.isfinite(cost + gap) else (np.inf, np.inf)

    @property
    def cost(self) -> float:
        """Cost of the residuals."""
        return self._size[0]

    @property
    def gap(self) -> float:
        """Norm of the defects in units of the states'."""
        return self._size[1]

    @property
    def merit(self) -> float:
        gap = self.gap / OPTIONS.defect
        return self.cost + gap * gap  # infinite where it overflows, which a power of 2 refuses

    @cached_property
    def merits(self) -> np.ndarray:
        """Merit (A,) of each arc."""
        with np.errstate(all="ignore"):
            cost = np.sum(self.units.loss.of(self.white), axis=(1, 2))
            return cost + self.gaps / OPTIONS.defect**2

    @property
    def joined(self) -> bool:
        """True where each arc is an orbit of the model."""
        return bool(np.isfinite(self.gap)) and not self.open.any()

    @property
    def open(self) -> np.ndarray:
        """Cost of the defects of each arc (A,) that is no orbit, and 0."""
        most = OPTIONS.closed**2 * self.x.shape[-1]
        return np.where(self.gaps <= most, 0.0, self.gaps / OPTIONS.defect**2)

    @cached_property
    def gaps(self) -> np.ndarray:
        """Sum of squares (A,) of each arc's defects, in units of the states'."""
        with np.errstate(all="ignore"):
            return np.sum((self.defects.closing / self.units.state) ** 2, axis=(1, 2))

    def rescaled(self, rows: _Rows, least: np.ndarray) -> _Iterate:
        """Iterate in units of the noise that these residuals tell: of each number as much is left
        as the latent state of its arc, and the coefficients, do not follow."""
        before = self.units.sigma
        off = self.residuals * before
        free = np.where(self.measured, 1.0 - rows.leverage, 0.0)
        free *= max(1.0 - len(self.p) / free.sum(), 1e-3)
        if before.ndim == 1:
            sigma = np.hypot(
                of_residuals(np.where(self.measured, off, np.nan), free, OUTLYING), least
            )
            moved = sigma / before
        else:
            left = np.where(self.measured, self.residuals, np.nan)
            moved = of_residuals(left, free, OUTLYING)
            sigma = np.hypot(moved * before, least)
        # Of a state (q, v) whose positions are measured, velocities change as they do.
        state = self.units.state * np.resize(moved, self.units.state.shape)
        units = self.units._replace(sigma=sigma, state=state)
        return dataclasses.replace(self, off=off, units=units)


class _Rows(NamedTuple):
    """Rows of one iteration: each arc's triangle for its own δx_0 (A, m, m + n + 1), the triangle
    for δp (n + 1, n + 1), each arc's part of its gradient (A, n), the transports (A, m, m) to the
    last states, where asked for how far the arc's own state follows each residual, in [0, 1], and
    where there are no coefficients what the triangles are of (A, L k, m + 1)."""

    arcs: np.ndarray
    factor: np.ndarray
    scores: np.ndarray
    transports: np.ndarray
    leverage: np.ndarray
    rows: np.ndarray

    @property
    def triangle(self) -> np.ndarray:
        """(n + 1, n), of p alone."""
        return self.factor[:, :-1]


def _reduced(at: _Iterate, arcs: np.ndarray | None = None, *, leverage: bool = False) -> _Rows:
    """Rows of these arcs (indices), of all unless given."""
    num_arcs, length, k, m = at.observed.by_state.shape
    num_arcs = num_arcs if arcs is None else len(arcs)
    n = at.observed.by_coefficients.shape[-1]
    size = max(1, OPTIONS.block_bytes // (8 * length * max(k, m) * (m + n + 1)))
    factor, parts = np.zeros((0, n + 1)), []
    for first in range(0, num_arcs, size):
        block = slice(first, first + size)
        J, last = _linearised(at, block if arcs is None else arcs[block])
        R = np.asarray(np.linalg.qr(J, mode="r"))
        rest = R[:, m:, m:]
        stack = np.concatenate([factor, rest.reshape(-1, n + 1)])
        factor = np.asarray(np.linalg.qr(stack, mode="r"))
        scores = (rest[..., :n].swapaxes(1, 2) @ rest[..., n:])[..., 0]
        follows = np.zeros((len(J), length, k))
        if leverage:
            own = np.linalg.qr(J[..., :m])[0]
            follows = np.sum(own**2, axis=-1).reshape(follows.shape)
        parts.append((R[:, :m], scores, last[..., :m], follows, J[:, :0] if n else J))
    arcs, scores, *others = (np.concatenate(p) for p in zip(*parts, strict=True))
    factor = np.concatenate([factor, np.zeros((n + 1 - len(factor), n + 1))])
    return _Rows(arcs, factor, scores, *others)


def _linearised(at: _Iterate, block: slice | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weighted rows (a, L k, m + n + 1) of [δx_0, δp, r] of these arcs, and δx_{L−1}
    (a, m, m + n + 1) by δx_0, by δp, and by the defects before it."""
    defects = Defects(*(part[block] for part in at.defects))
    observed = Observed(*(part[block] for part in at.observed))
    residuals = at.residuals[block]
    sigma = np.broadcast_to(at.units.sigma, at.residuals.shape)[block]
    num_arcs, length, k, m = observed.by_state.shape
    n = observed.by_coefficients.shape[-1]
    S = np.zeros((num_arcs, length, m, m + n + 1))
    S[:, 0, range(m), range(m)] = 1.0
    with np.errstate(all="ignore"):  # along an arc that is no orbit they may overflow
        S[:, 1:, :, m : m + n], S[:, 1:, :, -1] = defects.by_coefficients, defects.closing
        nodes = S.swapaxes(0, 1)
        by_state = defects.by_state.swapaxes(0, 1)
        for by, here, there in zip(by_state, nodes[:-1], nodes[1:], strict=True):
            there += by @ here
        J = observed.by_state @ S
    J[..., m:-1] += observed.by_coefficients
    J /= sigma[..., None]
    J[..., -1] = residuals - J[..., -1]
    J = at.units.white(J, block)
    J *= at.weights[block][..., None]
    return J.reshape(num_arcs, length * k, -1), S[:, -1]


def _sizes(columns: np.ndarray) -> np.ndarray:
    """Norms of columns, 1 of a column of zeros."""
    sizes = np.linalg.norm(columns, axis=0)
    return np.where(sizes > 0, sizes, 1.0)


def _solve(rows: _Rows, defects: Defects, damping: float) -> tuple[np.ndarray, np.ndarray]:
    """δp (n,) and δx (A, L, m), with Levenberg and Marquardt's damping of δp."""
    m, R = rows.arcs.shape[1], rows.factor
    n = R.shape[1] - 1
    dp = np.zeros(n)
    if n:
        scale = _sizes(R[:, :n])
        matrix = np.concatenate([R[:, :n] / scale, np.sqrt(damping) * np.eye(n)])
        target = np.concatenate([R[:, n], np.zeros(n)])
        dp = np.linalg.lstsq(matrix, target, rcond=1e-13)[0] / scale
    right = (rows.arcs[:, :, -1] - rows.arcs[:, :, m : m + n] @ dp)[..., None]
    own, moved = rows.arcs[:, :, :m], np.empty_like(right)
    sizes = np.linalg.norm(own, axis=1)
    units = np.max(sizes, axis=0, initial=0.0, where=np.isfinite(sizes))
    units = np.where(units > 0, units, 1.0)
    pivots = np.abs(np.diagonal(own, axis1=1, axis2=2)) / units
    loose = pivots.min(axis=1) <= OPTIONS.loose * pivots.max(axis=1)
    moved[~loose] = np.linalg.solve(own[~loose], right[~loose])
    if loose.any():
        inverse = np.linalg.pinv(own[loose] / units, rcond=OPTIONS.loose)
        moved[loose] = inverse @ right[loose] / units[:, None]
    pushed = (defects.by_coefficients @ dp + defects.closing)[..., None]
    dx = np.concatenate([moved[:, None], pushed], axis=1)
    nodes, by_state = dx.swapaxes(0, 1), defects.by_state.swapaxes(0, 1)
    for by, here, there in zip(by_state, nodes[:-1], nodes[1:], strict=True):
        there += by @ here
    return dp, dx[..., 0]
