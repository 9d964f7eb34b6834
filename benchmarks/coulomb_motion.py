"""Motion with Coulomb's dry friction by SciPy, from event to event.

Between events each joint slides, with a friction of a constant size against its speed, or sticks,
held by a force of at most that size. An event is a sliding speed that comes to zero, or a holding
force that comes to its size. Where a joint sticks by more than its friction it is let go, the one
farthest beyond it first.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

_AT_REST = 1e-9  # of a joint's speed, in its units
_ROUNDING = 1e-12  # of a force that a joint holds for ever
_EVENTS = 100_000  # of one motion
_FIRST = 1e-6  # step behind an event, of what is left: a joint let go may stick again within one


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

    def follow(self, x: np.ndarray, times: np.ndarray, u=None, **options) -> np.ndarray:
        """States (n, 2d) at times (n,), from x (2d,) at the first one, with an input u held.

        options: of `scipy.integrate.solve_ivp`. Raises RuntimeError where that fails.
        """
        found, t, last = np.full((len(times), len(x)), np.nan), *times[[0, -1]]
        found[0] = x
        s = self.joints @ x[len(x) // 2 :]
        modes = self._released(x, np.where(abs(s) < _AT_REST, 0.0, np.sign(s)), u)
        for _ in range(_EVENTS):
            done = self._to_an_event(x, modes, t, last, u, options)
            if done.status < 0:
                raise RuntimeError(f"no solution beyond t = {done.t[-1]:g}: {done.message}")
            inside = (times > t) & (times <= done.t[-1])
            if inside.any():
                found[inside] = done.sol(times[inside]).T
            if done.status == 0:
                return found
            t, x = done.t[-1], self._at_rest(done.y[:, -1])
            modes = self._changed(x, modes, np.array([len(at) > 0 for at in done.t_events]), u)
        raise RuntimeError(f"expected at most {_EVENTS:,} events, came to t = {t:g}")

    def _to_an_event(self, x, modes, t, last, u, options):
        """The motion from x at t until a joint slides or sticks that did not, or to the last t."""
        d = len(x) // 2

        def rate(_, z):
            return np.append(z[d:], self.accelerate(z, modes, u)[0])

        def event(joint):
            def left(_, z):
                if modes[joint]:
                    return modes[joint] * (self.joints[joint] @ z[d:])
                held = self.accelerate(z, modes, u)[1][joint]
                return self.sizes[joint] * (1 + _ROUNDING) - abs(held)

            left.terminal, left.direction = True, -1
            return left

        events = [event(joint) for joint in range(len(modes))]
        first = {"first_step": _FIRST * (last - t)} | options
        return solve_ivp(rate, (t, last), x, events=events, dense_output=True, **first)

    def _changed(self, x: np.ndarray, modes: np.ndarray, ended: np.ndarray, u) -> np.ndarray:
        """The modes behind an event of the joints that have ``ended`` theirs: one that stuck slides
        to where it was held from; one that slid sticks where its friction can hold it."""
        held = self.accelerate(x, modes, u)[1]
        after = np.where(ended, np.where(modes == 0, np.sign(held), 0.0), modes)
        return self._released(x, after, u)

    def _released(self, x: np.ndarray, modes: np.ndarray, u) -> np.ndarray:
        """The modes without joints that stick by a force beyond their friction, which slide to
        where it held them from: the one farthest beyond first."""
        modes = modes.copy()
        for _ in range(len(modes)):
            held = self.accelerate(x, modes, u)[1]
            beyond = np.where(modes == 0, abs(held) - self.sizes, 0.0)
            joint = int(np.argmax(beyond))
            if not beyond[joint] > 0:
                break
            modes[joint] = np.sign(held[joint])
        return modes

    def _at_rest(self, x: np.ndarray) -> np.ndarray:
        """The state with speeds of 0 where they are close to it."""
        v = x[len(x) // 2 :]
        s = self.joints @ v
        rest = np.where(abs(s) < _AT_REST, s, 0.0)
        return np.append(x[: len(v)], v - np.linalg.pinv(self.joints) @ rest)
