"""A controller of a law that was learned: a plan, a regulator about it, and its margin.

`plan` finds the motion of an arm from rest to upright by one joint's torque: multiple shooting over
the steps of a map, all states unknown, solved by IPOPT within the bounds of the torque
(`pip install "gfnn-jax[machines]"`); then of several draws of the posterior at once. `regulator` is
the time-varying LQR about it, from the map's own derivatives. `draws_of` follows many draws of the
law's posterior at once, with friction that sticks: how many of them `followed` brings up is the
margin that the data leave.

States are x = (q, v), or z = (q, p), of absolute angles, zero where links hang. `RECORD` is one run
of a robot arm of two links moved by motors, each fourth of its samples: F. Wiebe et al., IEEE
Robotics and Automation Letters 9 (2024), design C.1 (BSD-3); s, rad, N m, the second angle is
relative.
"""

from __future__ import annotations

import dataclasses
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import casadi
import numpy as np
from scipy.linalg import solve_discrete_are

import gfnn_jax as gfnn
from gfnn_jax.maps.estimates import law_of, substeps_of
from gfnn_jax.maps.inputs import Signals
from gfnn_jax.maps.laws import law_of_map, map_of_law

RECORD = Path(__file__).with_name("robot_arm.csv")
LENGTHS = np.array([0.2, 0.3])  # m
UP = np.array([np.pi, np.pi, 0.0, 0.0])
WIDTH = 0.3  # rad/s, over which a plan smooths dry friction: its derivatives have no jumps
STATE, TORQUE = 0.1, 1.0  # weights of a plan: of (z − UP)² ÷ sizes², and of the torque²
FAR, EFFORT = (10.0, 10.0, 0.1, 0.1), 30.0  # of a regulator: of q², v² off the plan, and torque²
# Draws beside the mean in a plan, so many times as far from it; the weight of their distance² from
# it ÷ sizes².
SIDE, NEAR, STRAY = 4, 0.3, 100.0
RHYTHMS, DRAWS, ENOUGH, PLANNED = (4.0, 5.0, 6.0), 50, 0.95, 0.7  # rad/s; of `controller`
WARM, MOST = 40, 100  # iterations by Gauss and Newton, then by the exact Hessian
FEW, DAMPED = 12, 1.0  # of a plan that goes on from another: iterations, added to the Hessian
Plant = Callable[[np.ndarray, np.ndarray], np.ndarray]  # x (n, 4) = (q, v), torques (n,) -> x


class Plan(NamedTuple):
    """States x (N + 1, 4) = (q, v) and torques u (N,) that are held for h seconds each; the
    variables (…) of its problem, from which another one goes on."""

    x: np.ndarray
    u: np.ndarray
    h: float
    variables: np.ndarray


class Regulator(NamedTuple):
    """A plan, gains (N, 4) of the states' distances from it, and the gain (4,) after its end."""

    plan: Plan
    gains: np.ndarray
    last: np.ndarray

    def torque(self, k: int, x: np.ndarray, limit: float) -> np.ndarray:
        """The torques (n,) of period k at states x (n, 4)."""
        plan = self.plan
        if k < len(plan.u):
            wanted = plan.u[k] - (x - plan.x[k]) @ self.gains[k]
        else:
            wanted = -(x - plan.x[-1]) @ self.last
        return np.clip(wanted, -limit, limit)


class Motor(NamedTuple):
    """A learned law with the torque of one joint alone, and its step over h seconds in CasADi, z,
    u, dp -> Z; sizes (4,) of z; changes dp (n, p) of its coefficients in draws of its posterior."""

    law: Any
    step: casadi.Function
    sizes: np.ndarray
    h: float
    draws: np.ndarray

    def speeds(self, z: Any, dp: Any) -> Any:
        """Velocities (2, n) at states z (4, n), by a short step."""
        short = 1e-6  # s
        return (self.step(z=z, u=0, dp=dp, h=short)["Z"][:2, :] - z[:2, :]) / short


def motor(fit: gfnn.Fit, joint: int, h: float) -> Motor:
    """The motor at a joint of a learned law, its dry friction smoothed; the step is accurate for
    speeds of some 6 rad/s."""
    law, own = law_of_map(fit.map), law_of(fit.map)
    widths = np.where(law.friction.dry, WIDTH, law.friction.widths)
    friction = dataclasses.replace(law.friction, widths=widths)
    law = dataclasses.replace(law, gains=law.gains[:, [joint]], friction=friction)
    others = len(own.p) - 4
    varied = NEAR * np.random.default_rng(3).normal(size=(SIDE, len(own.root))) @ own.root
    draws = varied[:, [*range(others), others + joint, others + 2 + joint]]
    rng = np.random.default_rng(0)
    q, v = rng.uniform(-np.pi, np.pi, (200, 2)), rng.normal(0, 6, (200, 2))
    z = np.concatenate([q, law.momentum(q, v)], axis=1)
    torques = {"signals": Signals(("torque",)), "inputs": rng.uniform(-6, 6, (200, 1))}
    map_ = map_of_law(law, z, h, angles=(0, 1), tolerance=1e-3, **torques)
    with tempfile.TemporaryDirectory() as folder:
        path = gfnn.export(map_, "casadi", Path(folder) / "step.casadi")
        return Motor(law, casadi.Function.load(str(path)), np.asarray(map_.scale), h, draws)


def plan(
    of: Motor, steps: int, limit: float, rhythm: float, about: Regulator | None = None
) -> Plan:
    """The motion from hanging to upright in so many steps, of little torque, found from a line
    there and a torque that swings by ``rhythm`` (rad/s).

    about: a regulator, from whose plan this one goes on. The draws of the motor then move beside
    the mean, each by its torque and the regulator's of its distance from the mean: the plan is that
    from which they stray little.

    Raises RuntimeError where none is found: give more steps or torque.
    """
    beside = of.draws if about is not None else of.draws[:0]
    sizes, each = np.append(np.tile(of.sizes, 1 + len(beside)), 1.0), 4 * (1 + len(beside))
    width = each + 1
    count = width * steps + each  # z of all plants and u of each step, and the last z
    x = casadi.MX.sym("x", count)
    table = casadi.reshape(casadi.vertcat(x, 0), width, steps + 1) * sizes
    z, u, gaps = table[:4, :], table[-1, :-1], []
    far = (z - UP) / of.sizes
    cost = 0.5 * (STATE * casadi.sumsqr(far) + TORQUE * casadi.sumsqr(u))
    move = of.step.map(steps)
    for n, dp in enumerate([np.zeros(of.draws.shape[1]), *beside]):
        own, torque = table[4 * n : 4 * n + 4, :], u
        if n and about is not None:
            off = own[:, :-1] - z[:, :-1]
            fast = [of.speeds(a[:, :-1], d) for a, d in ((own, dp), (z, 0 * dp))]
            moved = casadi.vertcat(off[:2, :], fast[0] - fast[1])
            torque = u - casadi.sum1(casadi.DM(about.gains.T) * moved)
            stray = casadi.sumsqr((own - z) / of.sizes)
            cost += 0.5 * STRAY / len(beside) * stray
        after = move(z=own[:, :-1], u=torque, dp=dp)["Z"]
        gaps.append(casadi.vec((after - own[:, 1:]) / of.sizes))
    given = [casadi.MX.sym(name, n) for name, n in (("p", 0), ("f", 1), ("g", each * steps))]
    damped = DAMPED if len(beside) else 0.0
    curved = casadi.triu(casadi.hessian(cost, x)[0] + damped * casadi.DM.eye(count))
    plain = casadi.Function(
        "plain", [x, *given], [given[1] * curved], ["x", "p", "lam_f", "lam_g"], ["hess"]
    )
    line = np.linspace(0, 1, steps + 1)[:, None]
    guess, low = np.zeros((steps + 1, width)), np.full((steps + 1, width), -np.inf)
    guess[:, :-1] = np.tile(UP / of.sizes, 1 + len(beside)) * line
    guess[:, -1] = np.sin(rhythm * of.h * steps * line[:, 0])
    if about is not None:
        begun = about.plan.variables
        guess = np.concatenate([np.tile(begun[:, :4], 1 + len(beside)), begun[:, -1:]], axis=1)
    high = -low
    low[:, -1], high[:, -1] = -limit, limit
    low[0, :-1] = high[0, :-1] = 0.0
    low[-1, :4] = high[-1, :4] = UP / of.sizes
    bounds = {"lbx": low.ravel()[:count], "ubx": high.ravel()[:count], "lbg": 0, "ubg": 0}
    found: Any = {"x": guess.ravel()[:count]}
    ways: list[tuple[int, Any]] = [(WARM, {"hess_lag": plain}), (MOST, {})]
    for most, own in ways if about is None else [(FEW, {"hess_lag": plain})]:
        quiet = {"print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes"}
        options = {"ipopt.max_iter": most, "ipopt.tol": 1e-4, **quiet, **own}
        problem = {"x": x, "f": cost, "g": casadi.vertcat(*gaps)}
        solver = casadi.nlpsol("plan", "ipopt", problem, options)
        duals = {f"{key}0": found[key] for key in ("lam_x", "lam_g") if key in found}
        found = solver(x0=found["x"], **duals, **bounds)
    if np.abs(found["g"].full()).max() > 1e-3:
        raise RuntimeError(f"no motion was found: {solver.stats()['return_status']}")
    rows = np.append(found["x"].full().ravel(), 0.0).reshape(steps + 1, width)
    motion = rows[:, :4] * of.sizes
    speeds = of.speeds(casadi.DM(motion.T), np.zeros(of.draws.shape[1])).full().T
    return Plan(np.concatenate([motion[:, :2], speeds], axis=1), rows[:-1, -1], of.h, rows)


def regulator(of: Motor, plan: Plan) -> Regulator:
    """The time-varying LQR about a plan, and the LQR at its end, of states (q, v)."""
    slopes = of.step.factory("slopes", ["z", "u", "h"], ["jac:Z:z", "jac:Z:u"])

    def turned(x: np.ndarray) -> np.ndarray:
        """Derivatives (4, 4) of z by x."""
        near, width = x + 1e-6 * np.concatenate([np.eye(4), -np.eye(4)]), 2e-6
        p = of.law.momentum(near[:, :2], near[:, 2:])
        return np.concatenate([np.eye(2, 4), ((p[:4] - p[4:]) / width).T])

    def at(x, u, after):
        z = np.concatenate([x[:2], of.law.momentum(x[None, :2], x[None, 2:])[0]])
        A, B = (part.full() for part in slopes(z, u, of.h))
        return np.linalg.solve(turned(after), A @ turned(x)), np.linalg.solve(turned(after), B)

    def gain(A, B, P):
        return np.linalg.solve(EFFORT + B.T @ P @ B, B.T @ P @ A)

    A, B = at(UP, 0.0, UP)
    Q, gains = np.diag(FAR), []
    P = solve_discrete_are(A, B, Q, [[EFFORT]])
    last = gain(A, B, P)[0]
    for k in reversed(range(len(plan.u))):
        A, B = at(plan.x[k], plan.u[k], plan.x[k + 1])
        gains.append(gain(A, B, P)[0])
        P = Q + A.T @ P @ (A - B @ gains[-1][None])
    return Regulator(plan, np.array(gains[::-1]), last)


def draws_of(fit: gfnn.Fit, joint: int, h: float, count: int, seed: int = 0) -> Plant:
    """So many plants side by side: draws of the posterior of the law, whose dry friction sticks."""
    law = law_of(fit.map)
    p = law.p + np.random.default_rng(seed).normal(size=(count, len(law.root))) @ law.root
    parts = int(substeps_of(law.sensors, h))

    def after(x: np.ndarray, torques: np.ndarray) -> np.ndarray:
        u = np.zeros((count, parts, 6, law.form.num_inputs))
        u[..., joint] = torques[:, None, None]
        return law.form.step(p, x, np.full(count, h), u, order=0).states

    return after


def designers(joint: int, h: float, friction: bool) -> Plant:
    """The plant by the parameters that the arm's designers publish (design C.1, model 1.0 of
    github.com/dfki-ric-underactuated-lab/double_pendulum, BSD-3), with their friction and rotors,
    or without, as their leaderboard simulates it; by Runge and Kutta's steps of 2 ms, as there."""
    (m1, m2), (r1, r2), l1, g = (0.5234602302, 0.6255677234), (0.2, 0.2556930544), 0.2, 9.81
    (I1, I2), rotor, gear = (0.0318871996, 0.0508698481), 6.287203963e-05 * friction, 6.0
    linear, dry = 0.001 * friction, np.array([0.16, 0.12]) * friction
    relative = np.array([[1.0, 0.0], [-1.0, 1.0]])  # angles of the joints, of absolute ones

    def rate(x: np.ndarray, force: np.ndarray) -> np.ndarray:
        q, v = x[:, :2] @ relative.T, x[:, 2:] @ relative.T
        both, (c, s) = m2 * l1 * r2, (np.cos(q[:, 1]), np.sin(q[:, 1]))
        M = np.empty((len(x), 2, 2))
        M[:, 0, 0] = I1 + I2 + m2 * l1**2 + 2 * both * c + (gear**2 + 1) * rotor
        M[:, 0, 1] = M[:, 1, 0] = I2 + both * c - gear * rotor
        M[:, 1, 1] = I2 + gear**2 * rotor
        turning = (
            both * s[:, None] * np.stack([(2 * v[:, 0] + v[:, 1]) * v[:, 1], -(v[:, 0] ** 2)], 1)
        )
        weight = m2 * g * r2 * np.sin(x[:, 1])
        weights = np.stack([(m1 * r1 + m2 * l1) * g * np.sin(x[:, 0]) + weight, weight], axis=1)
        lost = linear * v + dry * np.arctan(100 * v)
        a = np.linalg.solve(M, (force + turning - weights - lost)[..., None])[..., 0]
        return np.concatenate([x[:, 2:], a @ np.linalg.inv(relative).T], axis=1)

    def after(x: np.ndarray, torques: np.ndarray) -> np.ndarray:
        force = np.zeros((len(x), 2))
        force[:, joint], count = torques, round(h / 2e-3)
        for _ in range(count):
            k1 = rate(x, force)
            k2 = rate(x + h / count / 2 * k1, force)
            k3 = rate(x + h / count / 2 * k2, force)
            k4 = rate(x + h / count * k3, force)
            x = x + h / count / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        return x

    return after


def followed(
    by: Regulator, plant: Plant, count: int, seconds: float, limit: float
) -> tuple[np.ndarray, np.ndarray]:
    """States x (periods + 1, n, 4) = (q, v) of plants from rest under a regulator, and the torques
    (periods, n)."""
    x, torques = np.zeros((count, 4)), []
    states = [x]
    for k in range(round(seconds / by.plan.h)):
        torques.append(by.torque(k, x, limit))
        x = plant(x, torques[-1])
        states.append(x)
    return np.array(states), np.array(torques)


def up_from(states: np.ndarray, h: float) -> np.ndarray:
    """Seconds (n,) from which on the tip stays above 0.9 of its reach, to the end; inf where it is
    not there for the last two seconds."""
    height = -np.cos(states[..., :2]) @ LENGTHS / LENGTHS.sum()
    low = ~(height > 0.9)
    since = h * (len(low) - np.argmax(low[::-1], axis=0))
    return np.where(since < h * len(low) - 2.0, since, np.inf)


def controller(
    fit: gfnn.Fit, joint: int, h: float, seconds: float, limit: float
) -> tuple[Motor, Regulator, float]:
    """The motor at a joint, the regulator that brings up most of the draws of a law, and their
    part. Plans begun in several rhythms end in several motions, and each goes on to one from which
    draws stray less: they are tried until one brings up `ENOUGH`. A plan takes `PLANNED` of the
    torque, and leaves the rest to its regulator.

    Raises RuntimeError where no plan is found.
    """
    of, found = motor(fit, joint, h), []
    some = draws_of(fit, joint, h, DRAWS, seed=1)

    def tried(rhythm: float, about: Regulator | None = None) -> Regulator:
        by = regulator(of, plan(of, round(seconds / h), PLANNED * limit, rhythm, about))
        x, _ = followed(by, some, DRAWS, seconds + 3.0, limit)
        found.append((float(np.isfinite(up_from(x, h)).mean()), by))
        return by

    for rhythm in RHYTHMS:
        try:
            tried(rhythm, tried(rhythm))
        except RuntimeError:
            if rhythm == RHYTHMS[-1] and not found:
                raise
        if max((margin for margin, _ in found), default=0.0) >= ENOUGH:
            break
    margin, by = max(found, key=lambda each: each[0])
    return of, by, margin
