"""A storage ring of PyAT: particles tracked through it, and the coordinates they have there."""

from __future__ import annotations

import contextlib
import io
import logging
import warnings
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from harness import SEED

AMPLITUDE = 2e-3  # metres, in x and in y
# (x, p_x, y, p_y) of PyAT as (x, y, p_x, p_y), which is its own inverse.
ORDER = [0, 2, 1, 3]


class Ring(NamedTuple):
    """A lattice without cavities and radiation; optics where a turn begins, beta and alpha (2,).
    orbits: closed orbit (4,) in PyAT's order at the element of that number."""

    lattice: Any
    beta: np.ndarray
    alpha: np.ndarray
    orbits: dict[int, np.ndarray]

    def track(
        self, z, points: tuple[int, ...] = (), turns: int = 1, delta: float | np.ndarray = 0.0
    ) -> np.ndarray:
        """States (turns, points, N, 4) after these elements of each turn; the last one unless
        told. delta: energy deviation, a number or (N,). NaN where a particle is lost."""
        points = points or (len(self.lattice),)
        start = np.zeros((6, len(z)), order="F")
        start[:4], start[4] = (np.asarray(z)[:, ORDER] + self.orbit(0)).T, delta
        out, *_ = self.lattice.track(start, nturns=turns, refpts=list(points))
        orbits = np.stack([self.orbit(i) for i in points])
        return (out[:4].transpose(3, 2, 1, 0) - orbits[:, None])[..., ORDER]

    def orbit(self, element: int) -> np.ndarray:
        if element not in self.orbits:
            _, found = self.lattice.find_orbit4(refpts=[element])
            self.orbits[element] = found[0, :4]
        return self.orbits[element]

    def half_axes(self, x: float, y: float) -> np.ndarray:
        """(4,) of the ellipsoid of these amplitudes."""
        return np.array([x, y, x / self.beta[0], y / self.beta[1]])

    def normalised(self, z) -> np.ndarray:
        """Complex √(2J) exp(−iφ) of both planes (..., 2): Courant and Snyder's coordinates."""
        q, p = z[..., :2], z[..., 2:]
        return (q - 1j * (self.alpha * q + self.beta * p)) / np.sqrt(self.beta)

    def boundaries(self, count: int) -> tuple[int, ...]:
        """The elements after which the cells lie that cut the ring into so many equal parts."""
        s = self.lattice.get_s_pos(range(len(self.lattice) + 1))
        inner = (int(np.argmin(np.abs(s - s[-1] * k / count))) for k in range(1, count))
        return (*inner, len(self.lattice))


@cache
def ring(name: str) -> Ring:
    """A lattice of PyAT's machine_data."""
    try:
        import machine_data
        from at import load_lattice
    except ImportError as error:
        raise SystemExit("expected PyAT: python -m pip install '.[accelerator]'") from error
    folder = Path(next(iter(machine_data.__path__)))
    logging.disable(logging.WARNING)
    # Thousands of warnings of old element classes.
    with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")
        lattice: Any = load_lattice(folder / name).disable_6d(copy=True)
        optics, _, _ = lattice.get_optics()
    return Ring(lattice, optics.beta, optics.alpha, {})


def ellipsoid(half_axes, count: int, seed: int) -> np.ndarray:
    """States (count, 4), uniform within it."""
    rng = np.random.default_rng([SEED, seed])
    u = rng.normal(size=(count, 4))
    u *= rng.uniform(size=(count, 1)) ** 0.25 / np.linalg.norm(u, axis=1, keepdims=True)
    return u * half_axes
