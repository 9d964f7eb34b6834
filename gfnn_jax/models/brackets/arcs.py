"""ż = B(z)∇H(z) − Ez fitted to sequences with noise: arcs whose states are latent, the coefficients
of H and of friction and the constants of the bracket together (`solve.latent_arcs`). NumPy."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import numpy as np

from gfnn_jax.brackets import Bracket, standard_constants
from gfnn_jax.fitting.evidence import EVIDENCE
from gfnn_jax.fitting.triangle import Spectrum
from gfnn_jax.models.brackets.algebra import changed
from gfnn_jax.models.brackets.poisson_field import PoissonField
from gfnn_jax.solve.latent_arcs import (
    Defects,
    Fitted,
    Observed,
    Readings,
    flow_defects,
    observed_whole,
)


class Options:
    """Options of fits to arcs (benchmarks/brackets.py)."""

    rate: float = 0.2  # largest h‖f'‖ of a Runge–Kutta step
    most_substeps: int = 16
    nodes: int = 64  # of an arc, at most
    used: float = 0.8  # part of the states, at least, that an arc's length may leave in use
    # distance of a constant of the bracket from a whole number that it may be, and the rise of
    # χ² for each that is made one
    near: float = 0.02
    whole: float = 4.0
    rounds: int = 12  # of dropping terms, the weaker half of those that may go in each
    states: int = 400  # at which the field's rates are taken
    # of the noise: residuals that are none
    least: float = 1e-3


@dataclasses.dataclass(frozen=True)
class FreeBracket:
    """A bracket whose constants are fitted too: entries of ``form``, or of the ``basis``, that are
    no whole numbers. places: (K, 2) of these entries."""

    bracket: Any
    places: np.ndarray

    @classmethod
    def of(cls, bracket: Bracket) -> FreeBracket:
        """The bracket with every entry that is no whole number."""
        if getattr(bracket, "blocks", None):
            entries = bracket.basis  # pyright: ignore[reportAttributeAccessIssue]
        elif hasattr(bracket, "form"):
            entries = np.triu(bracket.form)  # pyright: ignore[reportAttributeAccessIssue]
        else:
            entries = np.zeros((0, 0))
        return cls(bracket, np.argwhere(entries != np.round(entries)))

    @property
    def values(self) -> np.ndarray:
        """(K,) of these entries."""
        lie = hasattr(self.bracket, "basis")
        entries = self.bracket.basis if lie else getattr(self.bracket, "form", np.zeros((0, 0)))
        return entries[tuple(self.places.T)] if len(self.places) else np.zeros(0)

    def moved(self, values: np.ndarray) -> Any:
        """The bracket with other values (K,)."""
        if not len(self.places):
            return self.bracket
        i, j = self.places.T
        if hasattr(self.bracket, "basis"):
            basis = self.bracket.basis.copy()
            basis[i, j] = values
            return Bracket.lie(self.bracket.blocks, basis, self.bracket.names)
        form = self.bracket.form.copy()
        form[i, j], form[j, i] = values, -values
        return dataclasses.replace(self.bracket, form=form)

    def columns(self, z: np.ndarray, gradient: np.ndarray, damping: np.ndarray) -> np.ndarray:
        """∂(B∇H − Ez)/∂values (N, n, K), E (n, n) diagonal where L z has standard constants."""
        out = np.zeros((*z.shape, len(self.places)))
        for k, (i, j) in enumerate(self.places):
            if hasattr(self.bracket, "basis"):
                basis = self.bracket.basis.astype(complex)
                basis[i, j] += 1e-30j
                standard = standard_constants(self.bracket.blocks)
                slope = np.imag(changed(standard, np.linalg.inv(basis))) / 1e-30
                out[..., k] = np.einsum("abc,nc,nb->na", slope, z, gradient, optimize=True)
                own = np.linalg.inv(self.bracket.basis)[:, i]  # dE = [E, L⁻¹ dL]
                out[..., k] += np.outer(z @ damping[j], own) - np.outer(z[:, j], damping @ own)
            else:
                log = self.bracket.name == "log-canonical"
                unit = z[:, i] * z[:, j] if log else 1.0
                out[:, i, k], out[:, j, k] = unit * gradient[:, j], -unit * gradient[:, i]
        return out


@dataclasses.dataclass(frozen=True, eq=False)
class PoissonArcs:
    """The law as `Readings.fit` wants it: p is (c, values of the bracket). dt: between nodes, a
    number or (A, L − 1). substeps: Runge–Kutta steps of order 4 between nodes."""

    field: PoissonField
    free: FreeBracket
    dt: Any
    substeps: int

    def take(self, arcs: np.ndarray) -> PoissonArcs:
        """The same of some of the arcs."""
        return self if np.ndim(self.dt) == 0 else dataclasses.replace(self, dt=self.dt[arcs])

    def observe(self, p: np.ndarray, x: np.ndarray) -> Observed:
        """The states themselves."""
        return observed_whole(x, len(p))

    def defects(self, p: np.ndarray, x: np.ndarray) -> Defects:
        """Ends of the steps from all nodes but the last, less the next nodes."""
        arcs, length, m = x.shape
        h = np.reshape(np.broadcast_to(self.dt, (arcs, length - 1)), (-1, 1))
        count = self.field.num
        c, field = p[:count], self.field.with_bracket(self.free.moved(p[count:]))
        free = FreeBracket(field.bracket, self.free.places)

        def rates(z, slope):
            gradient = field.library.gradient(field.of_h(c), z)
            moving = field.jacobian(c, z) @ slope
            moving[..., m : m + count] += field.columns(z)
            moving[..., m + count :] += free.columns(z, gradient, field.damping(c))
            return field.rate(c, z), moving

        return flow_defects(rates, x, h, len(p), self.substeps)


class ArcsFit(NamedTuple):
    """A law fitted to arcs: the field, c, a root of the covariance of c, the noise σ (n,), and the
    residuals' RMS, which outliers raise (n,)."""

    field: PoissonField
    c: np.ndarray
    root: np.ndarray
    sigma: np.ndarray
    left: np.ndarray


def fit_arcs(
    field: PoissonField, c: np.ndarray, y: np.ndarray, dt: float, sigma: np.ndarray
) -> ArcsFit:
    """Fit H, friction and the bracket's constants to arcs y (A, L, n), dt between nodes. Terms
    below four standard errors are dropped, the weaker half of them at a time, for terms that are
    alike hide one another; constants that may be whole numbers are. sigma: (n,) noise to start
    from."""
    some = y.reshape(-1, y.shape[2])[:: max(1, y[..., 0].size // Options.states)]
    rate = np.quantile(np.abs(field.jacobian(c, some)).sum(axis=2).max(axis=1), 0.99)
    substeps = int(np.clip(np.ceil(rate * dt / Options.rate), 1, Options.most_substeps))

    def fitted_to(field: PoissonField, free: FreeBracket, p: np.ndarray, x: np.ndarray) -> Fitted:
        model = PoissonArcs(field, free, dt, substeps)
        return Readings(model, y, sigma).fit(p, x, sigma, least=Options.least * sigma)

    free = FreeBracket.of(field.bracket)
    fitted = fitted_to(field, free, np.concatenate([c, free.values]), y)
    for _ in range(Options.rounds):
        count = field.num
        errors = np.sqrt(np.sum(_root(fitted)[:, :count] ** 2, axis=0))
        strength = np.abs(fitted.p[:count]) / np.maximum(errors, 1e-300)
        weak = np.sum(strength <= EVIDENCE.significant)
        kept = np.sort(np.argsort(strength)[(weak + 1) // 2 :])
        if len(kept) == count or not np.any(kept < field.library.num_parameters):
            break
        field = field.take(kept.tolist())
        p = np.concatenate([fitted.p[:count][kept], fitted.p[count:]])
        fitted = fitted_to(field, free, p, fitted.x)
    count = field.num
    values = fitted.p[count:]
    whole = np.abs(values - np.round(values)) <= Options.near
    if whole.any():
        bracket = free.moved(np.where(whole, np.round(values), values))
        fixed = FreeBracket(bracket, free.places[~whole])
        p = np.concatenate([fitted.p[:count], values[~whole]])
        tried = fitted_to(field, fixed, p, fitted.x)
        sizes = [np.sum(one.residuals**2 * (one.sigma / sigma) ** 2) for one in (tried, fitted)]
        if sizes[0] - sizes[1] <= Options.whole * whole.sum():
            free, fitted = fixed, tried
    found = field.with_bracket(free.moved(fitted.p[count:]))
    left = fitted.sigma * np.sqrt(np.mean(fitted.residuals.reshape(-1, y.shape[2]) ** 2, axis=0))
    return ArcsFit(found, fitted.p[:count], _root(fitted)[:, :count], fitted.sigma, left)


def _root(fitted: Fitted) -> np.ndarray:
    """Root of the covariance of p where directions that nothing tells, as of a change of z that
    keeps the motion, are held."""
    return Spectrum.of(fitted.triangle, np.zeros(len(fitted.triangle)), 0.0, 1e-6).told


def arcs_of(z0: np.ndarray, z1: np.ndarray, run: np.ndarray, place: np.ndarray) -> list[np.ndarray]:
    """Sequences of states (L, n) that pairs of one run after another make, in equal steps."""
    goes_on = (run[1:] == run[:-1]) & (np.diff(place) == 1) & (z1[:-1] == z0[1:]).all(axis=1)
    starts = np.flatnonzero(np.append(True, ~goes_on))
    ends = np.append(starts[1:], len(z0))
    return [np.concatenate([z0[a:b], z1[b - 1 : b]]) for a, b in zip(starts, ends, strict=True)]


def equal_arcs(sequences: list[np.ndarray]) -> np.ndarray:
    """The sequences cut into arcs of one length (A, L, n), the longest that leaves few states out:
    an arc begins with the state that the one before ends with; what is shorter is left out."""
    ends = np.array([len(states) for states in sequences]) - 1
    lengths = np.arange(min(Options.nodes - 1, ends.max()), 0, -1)
    used = np.array([np.sum(ends // length * length) for length in lengths])
    length = lengths[np.argmax(used >= Options.used * used.max())] + 1
    parts = [
        states[first : first + length]
        for states in sequences
        for first in range(0, len(states) - length + 1, length - 1)
    ]
    return np.array(parts)


def lagged(sequences: list[np.ndarray], steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of states (N, n) that are so many steps apart."""
    long = [s for s in sequences if len(s) > steps]
    return np.concatenate([s[:-steps] for s in long]), np.concatenate([s[steps:] for s in long])
