"""Physical quantities of a learned law: rest positions, frequencies, damping, and how these depend
on the amplitude, each with its unit and its standard error.

A quantity is a function of the coefficients of the law. Its standard error is that of its linear
expansion in these, by the covariance that the fit has left in the map.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq

from gfnn_jax.coordinates import nearest_image
from gfnn_jax.families.friction import DRY, LINEAR, ONE_SIDED, UNIFORM
from gfnn_jax.families.lagrangian import Lagrangian
from gfnn_jax.families.text import in_letters, measured
from gfnn_jax.maps.laws import is_of_law, law_of_map
from gfnn_jax.models.lagrangians.learned_law import LearnedLaw


class Options:
    """Numerical options."""

    nodes: int = 48  # of the quadrature over a swing, whose integrand is smooth
    amplitudes: int = 24  # of the curve of frequencies
    iterations: int = 60  # of Newton's method for a rest position
    starts: int = 5  # of it in each coordinate, and at most in all
    most: int = 625
    step: float = 1e-5  # of derivatives of the acceleration, in sizes of the motion
    # of the largest swing, which stands for none: of smaller ones rounding of V would be seen
    small: float = 1e-2
    gravity: float = 9.80665  # m/s², of a simple pendulum


class Quantity(NamedTuple):
    """One quantity, its standard error (0 where there is none), its unit, and what it means."""

    name: str
    value: float
    std: float
    unit: str
    about: str = ""

    @property
    def shown(self) -> str:
        """The value with the standard error in its last digits: "0.6123(4)"."""
        return measured(self.value, self.std)

    def __str__(self) -> str:
        return f"{self.name} = {self.shown} {self.unit}".rstrip()


class Swings(NamedTuple):
    """Free swings about a rest position: amplitude (n,), and for each frequency in Hz and quality
    factor Q, 2π times the energy over that lost in a period, with standard errors."""

    amplitude: np.ndarray
    frequency: np.ndarray
    frequency_std: np.ndarray
    quality: np.ndarray
    quality_std: np.ndarray

    @property
    def vary(self) -> bool:
        """Tell whether the frequency or Q depends on the amplitude."""
        return any(np.ptp(x) > 1e-6 * x[0] for x in (self.frequency, self.quality) if x[0] < np.inf)


class Physics(NamedTuple):
    """Quantities of a law, and the swings of one with a single degree of freedom."""

    quantities: tuple[Quantity, ...]
    swings: Swings | None = None

    def __str__(self) -> str:
        return "\n".join(map(str, self.quantities))


def physics(law: LearnedLaw) -> Physics:
    """The physical quantities of the law of a recording, as of a fit or a loaded one.

    Inputs are zero and parameters in the middle of their ranges. Of positions at rest those are
    found that are near the data.
    """
    if not is_of_law(law.map):
        return Physics(())
    system = _System.of(law)
    found: list[Quantity] = []
    swings = None
    rests = system.rests()
    stable = [q for q, holds in rests if holds]
    for q, holds in rests:
        if holds or system.law.dim == 1:
            found += system.at_rest(q, holds, len(stable) > 1)
    if system.law.dim == 1 and len(stable) == 1:
        swings = system.swings(stable[0])
        if swings is not None:
            found += _of_swings(swings, system)
    return Physics((*found, *_energies(law)), swings)


class _System(NamedTuple):
    """A law without inputs, its coefficients (θ, ρ, G, γ) and the root of their covariance; where
    its motion was, and how large; names and units of its coordinates, and the standard errors of
    their zeros."""

    law: Lagrangian
    root: np.ndarray
    middle: np.ndarray
    size: np.ndarray
    names: tuple[str, ...]
    units: tuple[str, ...]
    angles: tuple[int, ...]
    zeros: np.ndarray

    @classmethod
    def of(cls, found: LearnedLaw) -> _System:
        map_, law = found.map, law_of_map(found.map)
        sensors, box = map_.sensors, map_.parameters
        assert sensors is not None  # of every map of a recording
        names, root = sensors.positions, np.zeros((0, _count(law)))
        if map_.posterior is not None:
            root = np.asarray(map_.posterior.root)
        if box is not None:
            law = law.at(0.5 * (np.asarray(box.low) + np.asarray(box.high)))
        law = dataclasses.replace(law, coefficients=np.asarray(law.coefficients, float))
        units = {**found.units, **dict.fromkeys(sensors.angles, "rad")}
        middle = np.zeros(law.dim) if sensors.middle is None else np.asarray(sensors.middle)
        rms = np.ones(law.dim) if sensors.reach is None else np.asarray(sensors.reach)[: law.dim]
        places = [i for i, name in enumerate(names) if name in sensors.angles]
        listed = tuple(units.get(name, "") for name in names)
        zeros = np.array([found.zeros.get(name, (0.0, 0.0))[1] for name in names])
        return cls(law, root, middle, np.sqrt(2.0) * rms, names, listed, tuple(places), zeros)

    # Coefficients.

    def changed(self, by: np.ndarray) -> _System:
        """The system with its coefficients moved by these (k,)."""
        ends = np.cumsum([self.law.terms.count, self.law.friction.count, self.law.gains.size])
        of_terms, of_losses, _, of_rate = np.split(by, ends)
        terms, losses = self.law.coefficients + of_terms, np.asarray(self.law.losses) + of_losses
        rate = self.law.uniform + (of_rate[0] if len(of_rate) else 0.0)
        law = dataclasses.replace(self.law, coefficients=terms, losses=losses, uniform=rate)
        return self._replace(law=law)

    def with_errors(
        self, compute: Callable[[_System], np.ndarray]
    ) -> tuple[np.ndarray, np.ndarray]:
        """(values (n,), standard errors (n,)) of a function of the system."""
        values = compute(self)
        deviations = np.sqrt(np.sum(self.root**2, axis=0))
        slopes = np.zeros((len(deviations), len(values)))
        for k in np.flatnonzero(deviations):
            step = np.zeros(len(deviations))
            step[k] = 0.1 * deviations[k]
            slopes[k] = (compute(self.changed(step)) - compute(self.changed(-step))) / (2 * step[k])
        return values, np.sqrt(np.sum((self.root @ slopes) ** 2, axis=0))

    # Rest.

    def rest_from(self, q: np.ndarray) -> np.ndarray | None:
        """The position of rest that Newton's method finds from q (d,), where it finds one."""
        q, v = np.array(q, float), np.zeros(self.law.dim)
        for _ in range(Options.iterations):
            found = self.law.derivatives(q, v)
            step = np.linalg.lstsq(found.by_qq, found.by_q, rcond=None)[0]
            if np.any(np.abs(found.by_qq @ step - found.by_q) > 1e-6 * np.abs(found.by_q).max()):
                return None  # a force that no displacement balances
            step = step * min(1.0, 1.0 / max(np.max(np.abs(step / self.size)), 1e-300))
            q = q - step
            if np.all(np.abs(step) < 1e-12 * self.size):
                return q
        return None

    def rests(self) -> list[tuple[np.ndarray, bool]]:
        """(position, whether it is stable) of each rest position near the data, stable ones
        first."""
        count = max(1, min(Options.starts, int(Options.most ** (1 / self.law.dim))))
        along = np.linspace(-2.0, 2.0, count) if count > 1 else np.zeros(1)
        grid = np.stack(np.meshgrid(*[along] * self.law.dim), axis=-1).reshape(-1, self.law.dim)
        found: list[tuple[np.ndarray, bool]] = []
        reach = np.array(self.size)
        reach[list(self.angles)] = np.inf
        with np.errstate(all="ignore"):
            for start in self.middle + grid * self.size:
                q = self.rest_from(start)
                if q is None or np.any(np.abs(q - self.middle) > 2.5 * reach):
                    continue
                places = list(self.angles)
                q[places] = nearest_image(q, self.angles)[places]
                away = (nearest_image(q - other, self.angles) for other, _ in found)
                if not any(np.allclose(gap, 0.0, atol=1e-6 * self.size.max()) for gap in away):
                    holds = bool(np.all(np.linalg.eigvalsh(-self._curvature(q)) > 0))
                    found.append((q, holds))
        return sorted(found, key=lambda one: (not one[1], *one[0]))

    def _curvature(self, q: np.ndarray) -> np.ndarray:
        """∂²L/∂q∂q (d, d) at rest."""
        return np.asarray(self.law.derivatives(q, 0 * q).by_qq)

    def at_rest(self, q: np.ndarray, stable: bool, several: bool) -> list[Quantity]:
        """The rest position and, where it is stable, the modes of small oscillations about it."""
        d = self.law.dim

        def rest(other: _System) -> np.ndarray:
            found = other.rest_from(q)
            return np.full(d, np.nan) if found is None else found

        values, std = self.with_errors(rest)
        std = np.hypot(std, self.zeros)
        values, std = (np.where(np.abs(x) < 1e-9 * self.size, 0.0, x) for x in (values, std))
        kind = "rest position" if stable else "unstable rest position"
        about = "the potential is least there" if stable else "the forces vanish there"
        rows = zip(self.names, self.units, values, std, strict=True)
        found = [Quantity(f"{kind}, {n}", float(x), float(s), u, about) for n, u, x, s in rows]
        if not stable:
            return found
        at = f" about {', '.join(f'{x:.3g}' for x in q)}" if several else ""
        rates, errors = self.with_errors(lambda other: other._rates(other._near(q)))
        shapes = self._shapes(q) if d > 1 else []
        for k, (real, imag) in enumerate(rates.reshape(-1, 2)):
            std_real, std_imag = errors.reshape(-1, 2)[k]
            which = f"mode {k + 1}" if d > 1 else "small swings"
            found += _mode(which + at, (real, std_real), (imag, std_imag), *shapes[k : k + 1])
        if d == 1 and self.angles:
            found += self._pendulum(q)
        return found + self._dead_band(q)

    def _near(self, q: np.ndarray) -> np.ndarray:
        found = self.rest_from(q)
        return q if found is None else found

    def _viscous(self) -> Lagrangian:
        """The law with the friction that has a part linear in the speed: other kinds make a decay
        that depends on the amplitude, and no damping ratio."""
        kept = np.flatnonzero(np.isin(self.law.friction.kinds, (LINEAR, UNIFORM, ONE_SIDED)))
        friction, losses = self.law.friction.take(kept), np.asarray(self.law.losses)[kept]
        return dataclasses.replace(self.law, friction=friction, losses=losses)

    def _linear(self, q: np.ndarray) -> np.ndarray:
        """The matrix (2d, 2d) of small motion (q, v) about rest."""
        law, d = self._viscous(), self.law.dim
        speed = self.size * max(np.sqrt(np.max(np.abs(self._curvature(q)))), 1e-12)
        steps = Options.step * np.concatenate([self.size, speed])
        moved = np.concatenate([np.diag(steps), -np.diag(steps)])
        a = law.acceleration(q + moved[:, :d], moved[:, d:])
        matrix = np.zeros((2 * d, 2 * d))
        matrix[:d, d:] = np.eye(d)
        matrix[d:] = ((a[: 2 * d] - a[2 * d :]) / (2 * steps)[:, None]).T
        return matrix

    def _rates(self, q: np.ndarray) -> np.ndarray:
        """(real, imaginary) parts of the d slowest conjugate pairs, one after another (2d,)."""
        values = np.linalg.eigvals(self._linear(q))
        values = values[np.argsort(np.abs(values), kind="stable")][::2]
        return np.stack([values.real, np.abs(values.imag)], axis=1).ravel()

    def _shapes(self, q: np.ndarray) -> list[str]:
        """The ratios of the coordinates in each mode, the largest 1."""
        values, vectors = np.linalg.eig(self._linear(q))
        shapes = []
        for k in np.argsort(np.abs(values), kind="stable")[::2]:
            shape = vectors[: self.law.dim, k]
            shape = (shape / shape[np.argmax(np.abs(shape))]).real
            shapes.append(" : ".join(f"{x:.2f}" for x in shape))
        return shapes

    def _pendulum(self, q: np.ndarray) -> list[Quantity]:
        """ω₀² about rest, which of a simple pendulum is g/l, and that pendulum's length."""

        def compute(other: _System) -> np.ndarray:
            at = other._near(q)
            squared = (-other._curvature(at) / other.law.masses(at)).item()
            return np.array([squared, Options.gravity / squared])

        (squared, length), (error, of_length) = self.with_errors(compute)
        named = "length of a simple pendulum of this frequency"
        about = f"g/ω₀² with g = {Options.gravity:g} m/s²"
        rate = Quantity("ω₀², of a pendulum g/l", squared, error, "1/s²")
        return [rate, Quantity(named, length, of_length, "m", about)]

    def _dead_band(self, q: np.ndarray) -> list[Quantity]:
        """Distance from rest within which dry friction holds a body of one degree of freedom."""
        if self.law.dim > 1 or not np.any(self.law.friction.kinds == DRY):
            return []

        def compute(other: _System) -> np.ndarray:
            held = np.sum(np.asarray(other.law.losses)[other.law.friction.kinds == DRY])
            return np.array([held / abs(other._curvature(other._near(q)).item())])

        (width,), (error,) = self.with_errors(compute)
        about = "dry friction holds the body within this distance of rest"
        return [Quantity("dead band, ±", width, error, self.units[0], about)]

    # Swings of one degree of freedom.

    def swings(self, q: np.ndarray) -> Swings | None:
        """Frequency and Q of swings about rest, up to those of the data."""
        largest = float(self.size[0])
        amplitude = largest * np.linspace(Options.small, 1.0, Options.amplitudes)

        def compute(other: _System) -> np.ndarray:
            start = float(other._near(q)[0])
            pairs = [other._swing(start, a) for a in amplitude]
            return np.concatenate([[p[0] for p in pairs], [p[1] for p in pairs]])

        with np.errstate(all="ignore"):
            values, std = self.with_errors(compute)
        frequency, quality = np.split(values, 2)
        known = np.isfinite(frequency)
        if not known[0] or np.sum(known) < 2:
            return None
        of_frequency, of_quality = np.split(std, 2)
        columns = (amplitude, frequency, of_frequency, quality, of_quality)
        return Swings(*(x[known] for x in columns))

    def _swing(self, rest: float, amplitude: float) -> tuple[float, float]:
        """(frequency, Q) of a swing that turns ``amplitude`` beyond rest: quadratures over the
        angle φ of q = middle + half · sin φ, in which the integrands are smooth."""
        law = self.law
        right = rest + amplitude
        energy = self._potential(right)

        def above(q: float) -> float:
            return self._potential(q) - energy

        ends = (rest - k * amplitude for k in np.linspace(1, 4, 16))
        left = next((end for end in ends if above(end) >= 0), None)
        if left is None:
            return np.nan, np.nan
        left = float(brentq(above, left, rest))  # pyright: ignore[reportArgumentType]
        half, middle = 0.5 * (right - left), 0.5 * (right + left)
        nodes, weights = np.polynomial.legendre.leggauss(Options.nodes)
        angle = 0.5 * np.pi * nodes
        q = (middle + half * np.sin(angle))[:, None]
        free = energy - np.array([self._potential(x) for x in q[:, 0]])
        if np.any(free <= 0):
            return np.nan, np.nan
        speed = np.sqrt(2 * free / law.masses(q)[:, 0, 0])
        path = 0.5 * np.pi * weights * half * np.cos(angle)
        period = 2 * np.sum(path / speed)
        lost, _ = law.power(q, speed[:, None])
        per_period = 2 * np.sum(path * lost.sum(axis=-1) / speed)
        stored = energy - self._potential(rest)
        return 1 / period, 2 * np.pi * stored / per_period if per_period > 0 else np.inf

    def _potential(self, q: float) -> float:
        one = np.array([q])
        return float(self.law.energy(one, 0 * one))


def _count(law: Lagrangian) -> int:
    return law.terms.count + law.friction.count + law.gains.size


def _mode(
    name: str, real: tuple[float, float], imag: tuple[float, float], shape: str = ""
) -> list[Quantity]:
    """Frequency, damping ratio, Q and time of decay of a mode of eigenvalues real ± i·imag."""
    size = np.hypot(real[0], imag[0])
    if imag[0] <= 1e-9 * size:
        return [Quantity(f"{name}: rate of decay", -real[0], real[1], "1/s", "overdamped")]
    of_shape = f"amplitudes {shape}" if shape else ""
    rate, of_rate = imag[0] / (2 * np.pi), imag[1] / (2 * np.pi)
    found = [Quantity(f"{name}: frequency", rate, of_rate, "Hz", of_shape)]
    if abs(real[0]) <= 1e-9 * size:
        return found
    ratio, of_ratio = -real[0] / size, real[1] / size
    decay, of_decay = -1 / real[0], real[1] / real[0] ** 2
    return [
        *found,
        Quantity(f"{name}: damping ratio ζ", ratio, of_ratio, "", "by viscous friction"),
        Quantity(f"{name}: quality factor Q", 1 / (2 * ratio), of_ratio / (2 * ratio**2), ""),
        Quantity(f"{name}: time of decay to 1/e", decay, of_decay, "s", "of the amplitude"),
    ]


def _of_swings(swings: Swings, system: _System) -> list[Quantity]:
    a, unit = swings.amplitude[-1], system.units[0]
    at = f"swings of ± {a:.3g} {unit}".rstrip()
    drift = swings.frequency[-1] / swings.frequency[0] - 1
    against = f"{100 * drift:+.2g} % against small swings" if abs(drift) > 1e-6 else "as small ones"
    rate, error = float(swings.frequency[-1]), float(swings.frequency_std[-1])
    found = [Quantity(f"{at}, without friction: frequency", rate, error, "Hz", against)]
    if np.isfinite(swings.quality[-1]):
        about = "2π × energy ÷ energy lost in a period, by all friction"
        if system.law.friction.count > system._viscous().friction.count:
            about += "; it depends on the amplitude, for not all friction is viscous"
        quality, error = float(swings.quality[-1]), float(swings.quality_std[-1])
        found.append(Quantity(f"{at}: quality factor Q", quality, error, "", about))
    return found


def _energies(law: LearnedLaw) -> list[Quantity]:
    """Mean energy per second by cause."""
    unit = "units of L per s"

    def relative(coefficient: float, std: float) -> float:
        return std / abs(coefficient) if coefficient else 0.0

    if not law.energy:
        return []
    of_losses = {t.term: relative(t.coefficient, t.std) for t in law.friction.terms}
    found = []
    for name, e in law.energy["lost"].items():
        std = abs(e) * of_losses.get(name, 0.0)
        found.append(Quantity(f"energy lost per second by {in_letters(name)}", e, std, unit))
    for name, e in law.energy["supplied"].items():
        strongest = max(law.gains[name].values(), key=lambda pair: abs(pair[0]))
        std = abs(e) * relative(*strongest)
        found.append(Quantity(f"energy supplied per second by {name}", e, std, unit))
    return found
