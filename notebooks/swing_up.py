"""A controller of a law that was learned: a plan, a regulator about it, and its margin.

`plan` finds the motion of an arm from rest to upright by one joint's torque: multiple shooting over
the steps of a map, all states unknown, solved by IPOPT within the bounds of the torque
(`pip install "gfnn-jax[machines]"`). `regulator` is the time-varying LQR about it, from the map's
own derivatives. `draws_of` follows many draws of the law's posterior at once, with friction that
sticks: how many of them `followed` brings up is the margin that the data leave.

States are z = (q, p) of absolute angles, zero where links hang. `RECORD` is one run of a robot arm
of two links moved by motors, each fourth of its samples: F. Wiebe et al., IEEE Robotics and
Automation Letters 9 (2024), design C.1 (BSD-3); s, rad, N m, the second angle is relative.
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
from gfnn_jax.maps.laws import law_of_map, map_of_law, sticking

RECORD = Path(__file__).with_name("robot_arm.csv")
LENGTHS = np.array([0.2, 0.3])  # m
UP = np.array([np.pi, np.pi, 0.0, 0.0])
WIDTH = 0.3  # rad/s, over which a plan smooths dry friction: its derivatives have no jumps
STATE, TORQUE = 0.1, 1.0  # weights of a plan: of (z − UP)² ÷ sizes², and of the torque²
FAR, EFFORT = (10.0, 10.0, 0.1, 0.1), 30.0  # of a regulator: of q², v² off the plan, and torque²
RHYTHMS, DRAWS, ENOUGH, PLANNED = (5.0, 6.0), 50, 0.9, 0.7  # rad/s; of `controller`
WARM, MOST = 40, 100  # iterations by Gauss and Newton, then by the exact Hessian
Plant = Callable[[np.ndarray, np.ndarray], np.ndarray]  # x (n, 4) = (q, v), torques (n,) -> x


class Plan(NamedTuple):
    """States z (N + 1, 4) and torques u (N,) that are held for h seconds each."""

    z: np.ndarray
    u: np.ndarray
    h: float


class Regulator(NamedTuple):
    """A plan, gains (N, 4) of the states' distances from it, and the gain (4,) after its end."""

    plan: Plan
    gains: np.ndarray
    last: np.ndarray

    def torque(self, k: int, z: np.ndarray, limit: float) -> np.ndarray:
        """The torques (n,) of period k at states z (n, 4)."""
        plan = self.plan
        if k < len(plan.u):
            wanted = plan.u[k] - (z - plan.z[k]) @ self.gains[k]
        else:
            wanted = -(z - plan.z[-1]) @ self.last
        return np.clip(wanted, -limit, limit)


class Motor(NamedTuple):
    """A learned law with the torque of one joint alone, and its step over h seconds in CasADi, z, u
    -> Z; sizes (4,) of z."""

    law: Any
    step: casadi.Function
    sizes: np.ndarray
    h: float


def motor(fit: gfnn.Fit, joint: int, h: float) -> Motor:
    """The motor at a joint of a learned law, its dry friction smoothed; the step is accurate for
    speeds of some 6 rad/s."""
    law = sticking(law_of_map(fit.map), WIDTH, 1.0)
    law = dataclasses.replace(law, gains=law.gains[:, [joint]])
    rng = np.random.default_rng(0)
    q, v = rng.uniform(-np.pi, np.pi, (200, 2)), rng.normal(0, 6, (200, 2))
    z = np.concatenate([q, law.momentum(q, v)], axis=1)
    torques = {"signals": Signals(("torque",)), "inputs": rng.uniform(-6, 6, (200, 1))}
    map_ = map_of_law(law, z, h, angles=(0, 1), tolerance=1e-3, **torques)
    with tempfile.TemporaryDirectory() as folder:
        path = gfnn.export(map_, "casadi", Path(folder) / "step.casadi")
        return Motor(law, casadi.Function.load(str(path)), np.asarray(map_.scale), h)


def plan(of: Motor, steps: int, limit: float, rhythm: float) -> Plan:
    """The motion from hanging to upright in so many steps, of little torque, found from a line
    there and a torque that swings by ``rhythm`` (rad/s).

    Raises RuntimeError where none is found: give more steps or torque.
    """
    sizes, width = np.append(of.sizes, 1.0), 5
    count = width * steps + 4  # z and u of each step, and the last z
    x = casadi.MX.sym("x", count)
    table = casadi.reshape(casadi.vertcat(x, 0), width, steps + 1) * sizes
    z, u = table[:4, :], table[4, :-1]
    gaps = (of.step.map(steps)(z=z[:, :-1], u=u)["Z"] - z[:, 1:]) / of.sizes
    weights = np.tile([STATE] * 4 + [TORQUE], steps + 1)[:count]
    far = (z - UP) / of.sizes
    cost = 0.5 * (STATE * casadi.sumsqr(far) + TORQUE * casadi.sumsqr(u))
    given = [casadi.MX.sym(name, n) for name, n in (("p", 0), ("f", 1), ("g", 4 * steps))]
    plain = casadi.Function(
        "plain",
        [x, *given],
        [given[1] * casadi.DM(casadi.diag(casadi.DM(weights)))],
        ["x", "p", "lam_f", "lam_g"],
        ["triu_hess_gamma_x_x"],
    )
    line = np.linspace(0, 1, steps + 1)[:, None]
    guess, low = np.zeros((steps + 1, width)), np.full((steps + 1, width), -np.inf)
    guess[:, :4], guess[:, 4] = UP / of.sizes * line, np.sin(rhythm * of.h * steps * line[:, 0])
    high = -low
    low[:, 4], high[:, 4] = -limit, limit
    low[0, :4] = high[0, :4] = 0.0
    low[-1, :4] = high[-1, :4] = UP / of.sizes
    bounds = {"lbx": low.ravel()[:count], "ubx": high.ravel()[:count], "lbg": 0, "ubg": 0}
    found: Any = {"x": guess.ravel()[:count]}
    for most, own in ((WARM, {"hess_lag": plain}), (MOST, {})):
        quiet = {"print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes"}
        options = {"ipopt.max_iter": most, "ipopt.tol": 1e-4, **quiet, **own}
        problem = {"x": x, "f": cost, "g": casadi.vec(gaps)}
        solver = casadi.nlpsol("plan", "ipopt", problem, options)
        duals = {f"{key}0": found[key] for key in ("lam_x", "lam_g") if key in found}
        found = solver(x0=found["x"], **duals, **bounds)
    if not solver.stats()["success"]:
        raise RuntimeError(f"no motion was found: {solver.stats()['return_status']}")
    rows = np.append(found["x"].full().ravel(), 0.0).reshape(steps + 1, width) * sizes
    return Plan(rows[:, :4], rows[:-1, 4], of.h)


def regulator(of: Motor, plan: Plan) -> Regulator:
    """The time-varying LQR about a plan, and the LQR at its end."""
    back = np.eye(4)
    back[2:, 2:] = np.linalg.inv(of.law.masses(UP[None, :2])[0])
    Q = back.T @ np.diag(FAR) @ back  # of momenta
    slopes = of.step.factory("slopes", ["z", "u", "h"], ["jac:Z:z", "jac:Z:u"])

    def at(z, u):
        return (part.full() for part in slopes(z, u, of.h))

    def gain(A, B, P):
        return np.linalg.solve(EFFORT + B.T @ P @ B, B.T @ P @ A)

    A, B = at(UP, 0.0)
    P = solve_discrete_are(A, B, Q, [[EFFORT]])
    last, gains = gain(A, B, P)[0], []
    for z, u in zip(plan.z[-2::-1], plan.u[::-1], strict=True):
        A, B = at(z, u)
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
    by: Regulator, of: Motor, plant: Plant, count: int, seconds: float, limit: float
) -> tuple[np.ndarray, np.ndarray]:
    """States x (periods + 1, n, 4) = (q, v) of plants from rest under a regulator, and the torques
    (periods, n). The regulator knows the masses of its own law."""
    x, torques = np.zeros((count, 4)), []
    states = [x]
    for k in range(round(seconds / of.h)):
        z = np.concatenate([x[:, :2], of.law.momentum(x[:, :2], x[:, 2:])], axis=1)
        torques.append(by.torque(k, z, limit))
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
    part. Plans begun in several rhythms end in several motions: they are tried until one brings up
    `ENOUGH`. A plan takes `PLANNED` of the torque, and leaves the rest to its regulator.

    Raises RuntimeError where no plan is found.
    """
    of, found = motor(fit, joint, h), []
    some = draws_of(fit, joint, h, DRAWS, seed=1)
    for rhythm in RHYTHMS:
        try:
            by = regulator(of, plan(of, round(seconds / h), PLANNED * limit, rhythm))
        except RuntimeError:
            if rhythm == RHYTHMS[-1] and not found:
                raise
            continue
        x, _ = followed(by, of, some, DRAWS, seconds + 3.0, limit)
        found.append((float(np.isfinite(up_from(x, h)).mean()), by))
        if found[-1][0] >= ENOUGH:
            break
    margin, by = max(found, key=lambda each: each[0])
    return of, by, margin
