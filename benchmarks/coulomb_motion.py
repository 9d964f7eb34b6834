"""Motion with Coulomb's dry friction by SciPy, from event to event.

Between events each joint slides, with a friction of a constant size against its speed, or sticks,
held by a force of at most that size. An event is a sliding speed that comes to zero, or a holding
force that comes to its size: there, and at a start, those that can slide or stick are tried until
one agrees with itself.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

_AT_REST = 1e-9  # of a joint's speed, in its units
_TURNS = 1e-9  # share of friction's size by which a force that still holds is below it


class Body(NamedTuple):
    """masses(q) -> (d, d), and force(q, v, u) -> (d,) without dry friction; joints: the directions
    (F, d) of the speeds s = joints v, on each of which dry friction of such a size (F,) acts."""

    masses: Callable
    force: Callable
    joints: np.ndarray
    sizes: np.ndarray

    def accelerate(self, x: np.ndarray, modes: np.ndarray, u) -> tuple[np.ndarray, np.ndarray]:
        """v̇ (d,) of a state (2d,), and the force (F,) on each joint: of one that slides forward,
        1, or backward, −1, its size; of one that sticks, 0, what holds it."""
        d, held = len(x) // 2, modes == 0
        mass, force = self.masses(x[:d]), self.force(x[:d], x[d:], u)
        pull, hold = modes * self.sizes, self.joints[held]
        equations = np.block([[mass, hold.T], [hold, np.zeros((len(hold), len(hold)))]])
        known = np.append(force - self.joints.T @ pull, np.zeros(len(hold)))
        found = np.linalg.solve(equations, known)
        pull[held] = found[d:]
        return found[:d], pull

    def modes(self, x: np.ndarray, u) -> np.ndarray:
        """Which joints slide and which stick in a state."""
        d = len(x) // 2
        s = self.joints @ x[d:]
        choices = [(0, 1, -1) if abs(one) < _AT_REST else (np.sign(one),) for one in s]
        for modes in map(np.array, itertools.product(*choices)):
            a, pull = self.accelerate(x, modes, u)
            slides = (abs(s) >= _AT_REST) | (modes * (self.joints @ a) > -_AT_REST)
            holds = abs(pull) < self.sizes * (1 - _TURNS)
            if np.where(modes == 0, holds, slides).all():
                return modes
        raise ValueError(f"expected a state whose joints slide or stick, got {x}")

    def follow(self, x: np.ndarray, times: np.ndarray, u=None, **options) -> np.ndarray:
        """States (n, 2d) at times (n,), from x (2d,) at the first one, with an input u held.

        options: of `scipy.integrate.solve_ivp`.
        """
        found, t, last = np.full((len(times), len(x)), np.nan), *times[[0, -1]]
        found[0] = x
        while t < last:
            done = self._to_an_event(x, t, last, u, options)
            inside = (times > t) & (times <= done.t[-1])
            if inside.any():
                found[inside] = done.sol(times[inside]).T
            t, x = done.t[-1], self._at_rest(done.y[:, -1])
        return found

    def _to_an_event(self, x, t, last, u, options):
        """The motion from x at t until a joint slides or sticks that did not, or to the last t."""
        modes, d = self.modes(x, u), len(x) // 2

        def rate(_, z):
            return np.append(z[d:], self.accelerate(z, modes, u)[0])

        def left(joint, z):
            if modes[joint]:
                return modes[joint] * (self.joints[joint] @ z[d:])
            return self.sizes[joint] - abs(self.accelerate(z, modes, u)[1][joint])

        def event(joint):
            def of(_, z):
                return left(joint, z)

            of.terminal, of.direction = True, -1
            return of

        events = [event(joint) for joint in range(len(modes))]
        return solve_ivp(rate, (t, last), x, events=events, dense_output=True, **options)

    def _at_rest(self, x: np.ndarray) -> np.ndarray:
        """The state with speeds of 0 where they are close to it."""
        v = x[len(x) // 2 :]
        s = self.joints @ v
        rest = np.where(abs(s) < _AT_REST, s, 0.0)
        return np.append(x[: len(v)], v - np.linalg.pinv(self.joints) @ rest)
