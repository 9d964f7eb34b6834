"""Test of measured velocities against a law found from positions alone.

Most velocities in files are filtered differences of the positions: their scale is a little low,
they come late, and neighbouring values share their noise. Against the velocities v of a law, which
is far smoother than either,

    measured − v  =  a v + τ dv/dt + b + noise

tells the scale 1 + a, the lag −τ and the bias b. Only velocities of which this is next to nothing,
and whose noise is white, tell a fit something that positions did not.

Where no law is found from positions, or noise hides what another would leave, velocities that are
less noisy than the slopes of the positions are read *from the start*, as sensors; they stay where
the law then has no flaw.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from gfnn_jax.data.recording import Recording, channels_of
from gfnn_jax.data.roles import symbols
from gfnn_jax.dataset.stretches import Arcs, Nodes, Stretch, stretches
from gfnn_jax.fitting.evidence import correlation_time
from gfnn_jax.fitting.linearised import Linearised
from gfnn_jax.models.lagrangians.fit import LawFit
from gfnn_jax.signals.derivatives import difference
from gfnn_jax.signals.local_polynomials import choose_half


class Options:
    """Limits at which measured velocities are used (`benchmarks/measured.py`).

    wrong: of the noise, that scale, lag and bias may make up. chance: standard deviations of what
    they make up by accident. coloured: correlation of noise, of ``near`` neighbours, that is no
    accident.
    """

    wrong: float = 0.2
    chance: float = 3.0
    coloured: float = 0.2
    near: int = 8


class Velocity(NamedTuple):
    """A column against the law: scale, lag (s) and bias with the standard errors that its own noise
    makes, σ of that, whether it is white, whether the column is used, and the unit of bias and σ,
    where it is known."""

    scale: tuple[float, float]
    lag: tuple[float, float]
    bias: tuple[float, float]
    sigma: float
    white: bool
    used: bool
    unit: str = ""

    def in_file(self, recording: Recording, name: str) -> Velocity:
        """Convert to the unit that its column has in the file."""
        factor = recording.factors[name]
        bias = self.bias[0] / factor, self.bias[1] / factor
        unit = recording.unit(name)
        return self._replace(bias=bias, sigma=self.sigma / factor, unit=unit)

    @property
    def text(self) -> str:
        """A line for people."""
        why = "used" if self.used else "not used"
        colour = "white" if self.white else "coloured"
        return (
            f"{why}; against the law its scale is {self.scale[0]:.4f} ± {self.scale[1]:.1g}, its "
            f"lag {1e3 * self.lag[0]:.2g} ± {1e3 * self.lag[1]:.1g} ms, its noise {colour} with "
            f"σ {self.sigma:.3g} {self.unit}".rstrip()
        )


def velocities(recording: Recording, fit: LawFit) -> dict[str, Velocity]:
    """Each column of velocities that no sensor explains, against the law of the positions."""
    d, arcs, x, nodes = fit.form.dim, fit.arcs, fit.fitted.x, fit.problem.nodes
    if recording.coordinates != recording.positions:
        return {}
    law = fit.form.lagrangian(fit.p[: fit.form.count])
    if law.powers is not None:
        args = np.stack([nodes[i].stretch.args for i, _, _ in arcs.home])
        law = law.at(np.repeat(args, x.shape[1], axis=0))
    u = _at_nodes(arcs, nodes, [node.stretch.u for node in nodes])
    flat = x.reshape(-1, 2 * d)
    a = law.acceleration(flat[:, :d], flat[:, d:], u.reshape(len(flat), -1))
    a = a.reshape(*x.shape[:2], d)
    found = {}
    for i, name in enumerate(recording.velocities):
        if name in recording.explained:
            continue
        columns = [_column(recording, node.stretch, name) for node in nodes]
        measured = _at_nodes(arcs, nodes, columns)[..., 0]
        finite = np.isfinite(measured) & np.isfinite(arcs.y[..., i])
        if finite.sum() < 10:
            continue
        v = x[..., d + i]
        rows = np.stack([v, a[..., i], np.ones_like(v), measured - v], axis=-1)
        problem = Linearised.of_rows(rows[finite])
        beta = problem.step()
        made = rows[..., :3] @ beta
        left = np.where(finite, rows[..., 3] - made, np.nan)
        sigma = float(np.sqrt(np.nanmean(left**2)))
        tau = correlation_time(left[..., None] / sigma)
        error = sigma * np.sqrt(tau) * problem.errors
        share = float(np.sqrt(np.mean(made[finite] ** 2))) / sigma
        chance = Options.chance / np.sqrt(finite.sum())
        white = _colour(left) < max(Options.coloured, chance) and not _copied(recording, i, name)
        allowed = max(Options.wrong, chance * np.sqrt(3 * tau))
        scale, late = (1 + float(beta[0]), float(error[0])), (-float(beta[1]), float(error[1]))
        off, used = (float(beta[2]), float(error[2])), bool(white and share < allowed)
        found[name] = Velocity(scale, late, off, sigma, bool(white), used)
    return found


def read_from_the_start(recording: Recording) -> Recording | None:
    """The recording whose velocities are read like positions; None where one is noisier than the
    slopes of its position, both of local cubics, or where sensors are given."""
    d = len(recording.positions)
    if recording.explained or not d or len(recording.velocities) != d or recording.sensors:
        return None
    speeds = symbols((*recording.positions, *recording.velocities))[d:]
    both = stretches(recording, (*recording.positions, *recording.velocities), lambda y, _: y)
    if not all(s.even and np.isfinite(s.y).all() for s in both):
        return None
    half, sigma = choose_half([(s.t, s.y[:, :d]) for s in both])
    noise = choose_half([(s.t, s.y[:, d:]) for s in both])[1]
    # Variances of the slope and of the value of a cubic through many samples, times their number
    slopes = sigma * np.sqrt(75 / 4) / (half * np.median(np.diff(both[0].t)))
    copied = any(_copied(recording, i, name) for i, name in enumerate(recording.velocities))
    if copied or np.any(1.5 * noise > slopes):
        return None
    return recording._with(observe=dict(zip(recording.velocities, speeds, strict=True)))


def _colour(left: np.ndarray) -> float:
    """The largest correlation of noise (A, L) with that of near nodes, of either sign."""
    power = np.nanmean(left**2)
    near = range(1, min(Options.near, left.shape[1] - 1) + 1)
    beside = [left[:, k:] * left[:, :-k] for k in near]
    return max(
        (abs(float(np.nanmean(b) / power)) for b in beside if np.isfinite(b).any()), default=0.0
    )


def _copied(recording: Recording, place: int, name: str) -> bool:
    """Return whether a velocity is a mere difference of its position."""
    times = [recording.times(run) for run in recording.runs]
    x, v = (
        np.concatenate([recording.unwrapped(n, run) for run in recording.runs])
        for n in (recording.positions[place], name)
    )
    return difference(times, x, v) is not None


def with_channels(
    recording: Recording, nodes: Sequence[Nodes], arcs: Arcs, names: Sequence[str]
) -> tuple[list[Nodes], Arcs]:
    """Nodes and arcs that show these columns too."""
    wider: dict[int, Stretch] = {}
    extended = []
    for node in nodes:
        s = node.stretch
        if id(s) not in wider:
            y, noise = (
                np.concatenate([own, *(_column(recording, s, n, k) for n in names)], axis=1)
                for k, own in enumerate((s.y, s.noise))
            )
            wider[id(s)] = dataclasses.replace(s, y=y, noise=noise)
        zero = np.pad(node.zero, (0, len(names)))
        y = wider[id(s)].y[node.at]
        extended.append(dataclasses.replace(node, stretch=wider[id(s)], y=y, zero=zero))
    y = _at_nodes(arcs, extended, [node.stretch.y - node.zero for node in extended])
    y = np.where(np.isfinite(arcs.y).any(axis=-1, keepdims=True), y, np.nan)
    noise = _at_nodes(arcs, extended, [node.stretch.noise for node in extended])
    return extended, dataclasses.replace(arcs, y=y, noise=noise)


def _column(recording: Recording, s: Stretch, name: str, which: int = 0) -> np.ndarray:
    """(n, 1) of a column, or of its relative noise, at the samples of a stretch; where nothing was
    read NaN."""
    t = recording.times(s.run)
    at = np.minimum(np.searchsorted(t, s.t), len(t) - 1)
    found = channels_of(recording, [name], s.run)[which][at]
    return np.where((t[at] == s.t)[:, None], found, (np.nan, 1.0)[which])


def _at_nodes(arcs: Arcs, nodes: Sequence[Nodes], columns: Sequence[np.ndarray]) -> np.ndarray:
    """(A, L, k) of columns (n, k) of each node's stretch, as `arcs_of` lays nodes out."""
    length, found = arcs.t.shape[1], []
    for i, a, b in arcs.home:
        index = np.minimum(np.arange(a, a + length), b - 1)
        found.append(columns[i][nodes[i].at[index]])
    return np.array(found)
