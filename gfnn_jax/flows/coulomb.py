"""Motion with Coulomb's dry friction: bodies slide, or stick.

Dry friction of a law is smoothed over speeds ε, |s| as √(s² + ε²) − ε, so that a body that it holds
creeps. Here ε = 0. With s = c·v for each direction c of dry friction,

    M a = f(q, v) − Σ c λ,      λ = ρ sign(s) where s slides,      |λ| ≤ ρ, c·a = 0 where it sticks

(J. J. Moreau, in "Nonsmooth Mechanics and Applications" (1988) 1). As long as no direction changes
from one to the other the motion is smooth, followed by Runge–Kutta steps. A step in which a sliding
speed turns, or a λ that holds passes ρ, ends there: at the root of a cubic through the speeds and
their slopes at the step's ends, or of a line through λ.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from gfnn_jax.families.lagrangian import DRY, Lagrangian
from gfnn_jax.flows.motion import runge_kutta

_EVENTS = 64  # of a lane in one step, after which it has no solution
_ALIKE = 1e-9  # of the largest mobility, added for directions that depend on each other
_HALVINGS = 40  # of a step, to the root of its cubic


@dataclasses.dataclass(frozen=True, eq=False)
class Coulomb:
    """A law without its dry friction, and that: directions c (F, d), forces ρ (F,).

    States are x = (q, v) (B, 2d); ``modes`` (B, F) says which directions slide forward, 1, or
    backward, −1, and which stick, 0; inputs are u (B, inputs).
    """

    smooth: Lagrangian
    directions: np.ndarray
    losses: np.ndarray

    @staticmethod
    def of(law: Lagrangian) -> Coulomb:
        """Coulomb's friction in the place of the dry friction of a law."""
        dry = law.friction.kinds == DRY
        smooth = dataclasses.replace(law, friction=law.friction.take(~dry), losses=law.losses[~dry])
        return Coulomb(smooth, law.friction.directions[dry].astype(float), law.losses[dry])

    def speeds(self, x: np.ndarray) -> np.ndarray:
        """s = c·v (B, F)."""
        return x[:, self.smooth.dim :] @ self.directions.T

    def begin(self, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        """The modes in which states start."""
        return self._released(x, np.sign(self.speeds(x)), u)

    def advance(
        self, x: np.ndarray, modes: np.ndarray, h: np.ndarray, u: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """States and modes a time h (B,) later, the inputs constant meanwhile; NaN of lanes with
        more events than can be followed."""
        x, modes, left = x.copy(), modes.copy(), h.copy()
        lanes = np.flatnonzero(left > 0)
        for _ in range(_EVENTS):
            if not len(lanes):
                break
            part = np.ones(len(lanes))
            new, slope, held = self._step(x[lanes], modes[lanes], left[lanes], u[lanes])
            part, event = self._first(x[lanes], new, modes[lanes], left[lanes], slope, held)
            cut = np.flatnonzero(part < 1)
            if len(cut):
                some, which = lanes[cut], event[cut]
                new[cut], _, held = self._step(
                    x[some], modes[some], part[cut] * left[some], u[some]
                )
                modes[some], new[cut] = self._changed(new[cut], modes[some], which, held, u[some])
            x[lanes], left[lanes] = new, (1 - part) * left[lanes]
            lanes = lanes[left[lanes] > 0]
        x[lanes] = np.nan
        return x, modes

    def _rates(self, x, modes, u) -> tuple[np.ndarray, np.ndarray]:
        """Accelerations a (B, d) and forces λ (B, F)."""
        d, c = self.smooth.dim, self.directions
        M, force = self.smooth.balance(x[:, :d], x[:, d:], u)
        held, inverse = self.losses * modes, np.linalg.inv(M)
        a = np.einsum("bij,bj->bi", inverse, force - held @ c)
        if modes.all():
            return a, held
        pushed = inverse @ c.T  # (B, d, F)
        holding = _among(modes == 0, c @ pushed, a @ c.T)
        return a - np.einsum("bif,bf->bi", pushed, holding), held + holding

    def _step(self, x, modes, h, u):
        """The states h (B,) later in the same modes; accelerations along c, and λ, at the step's
        begin and end: each (2, B, F)."""
        d, slopes, forces = self.smooth.dim, [], []

        def rate(_: int, inside: np.ndarray) -> np.ndarray:
            a, held = self._rates(inside, modes, u)
            slopes.append(a @ self.directions.T)
            forces.append(held)
            return np.concatenate([inside[:, d:], a], axis=1)

        new = runge_kutta(rate, x, h[:, None])
        rate(0, new)
        ends = [0, -1]
        return new, np.array(slopes)[ends], np.array(forces)[ends]

    def _first(self, x, new, modes, h, slope, held):
        """The part (B,) of a step at which its first direction changes, 1 where none does, and
        which one (B,)."""
        part = np.ones(modes.shape)
        before, after = self.speeds(x) * modes, self.speeds(new) * modes
        turns = np.nonzero((modes != 0) & (after < 0))
        if len(turns[0]):
            along = (h[:, None] * modes * slope)[:, *turns]
            part[turns] = _root(before[turns], after[turns], *along)
        spare = self.losses - np.abs(held)  # (2, B, F)
        lost = np.nonzero((modes == 0) & (spare[1] < 0))
        begun, ended = spare[:, *lost]
        part[lost] = np.maximum(begun, 0) / (np.maximum(begun, 0) - ended)
        event = np.argmin(part, axis=1)
        return part[np.arange(len(part)), event], event

    def _changed(self, x, modes, event, held, u):
        """Modes of states in which the direction ``event`` (B,) changes its own, and the states
        with speeds of 0 where they stick."""
        k = np.arange(len(x)), event
        modes = modes.copy()
        modes[k] = np.where(modes[k] == 0, np.sign(held[1][k]), 0)
        d, c = self.smooth.dim, self.directions
        M = self.smooth.masses(x[:, :d])
        pushed = np.linalg.solve(M, np.broadcast_to(c.T, (len(x), *c.T.shape)))
        impulse = _among(modes == 0, c @ pushed, self.speeds(x))
        v = x[:, d:] - np.einsum("bif,bf->bi", pushed, impulse)
        x = np.concatenate([x[:, :d], v], axis=1)
        return self._released(x, modes, u), x

    def _released(self, x, modes, u) -> np.ndarray:
        """Modes without the directions that stick by a λ beyond ρ, the farthest beyond it first:
        they slide to where λ held them from."""
        modes = modes.copy()
        for _ in range(len(self.losses)):
            _, held = self._rates(x, modes, u)
            beyond = np.where(modes == 0, np.abs(held) - self.losses, 0.0)
            lanes = np.flatnonzero(beyond.max(axis=1, initial=0.0) > 0)
            if not len(lanes):
                break
            k = lanes, np.argmax(beyond, axis=1)[lanes]
            modes[k] = np.sign(held[k])
        return modes


def _among(stuck: np.ndarray, mobility: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """λ (B, F) of directions that are ``stuck``, 0 of others: mobility λ = wanted among them, the
    least λ where they depend on each other (Tikhonov's, iterated once)."""
    count = stuck.shape[1]
    both = stuck[:, :, None] & stuck[:, None, :]
    size = np.abs(mobility).max(axis=(1, 2), initial=0.0)[:, None]
    own = np.where(stuck, _ALIKE * size, 1.0)[:, :, None] * np.eye(count)
    mobility = np.where(both, mobility, 0.0)
    wanted = np.where(stuck, wanted, 0.0)[..., None]
    found = np.linalg.solve(mobility + own, wanted)
    return (found + np.linalg.solve(mobility + own, wanted - mobility @ found))[..., 0]


def _root(before, after, slope_before, slope_after) -> np.ndarray:
    """The part of a step at which the cubic with these values and slopes at its ends, first above
    and then below zero, crosses it."""
    low, high = np.zeros(len(before)), np.ones(len(before))
    for _ in range(_HALVINGS):
        s = 0.5 * (low + high)
        r = 1 - s
        value = r * r * ((1 + 2 * s) * before + s * slope_before)
        value += s * s * ((1 + 2 * r) * after - r * slope_after)
        low, high = np.where(value > 0, s, low), np.where(value > 0, high, s)
    return high
