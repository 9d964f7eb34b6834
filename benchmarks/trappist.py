"""TRAPPIST-1: masses and orbits of seven planets from the times of their transits.

    python benchmarks/trappist.py --record DIR    trappist1_transits.csv and _reference.csv in DIR
    python benchmarks/trappist.py --record DIR --quick    three iterations, into runs/

The law is given: eight bodies in a plane that attract each other. Unknown are seven masses (of the
star's), and of each orbit, in Jacobi's coordinates, its period, the time of a conjunction, e cos ω
and e sin ω. A transit is an event: the planet's coordinate across the line of sight is the star's,
and falls. The flow is the package's composition of order 8 (Kahan and Li), with its derivatives in
all 35 unknowns; from the nearest step Newton's method leads to the event. The package's
Levenberg–Marquardt descends on least squares and then on Student's t (Agol et al., PSJ 2 (2021) 1:
ν 3.36, scale² 0.709), from flat starts (masses 1e-5, e 0, periods and times by straight lines) and
from the published values.

Standard errors are by the Hessian of the cost: differences of its gradient in directions that the
linearised problem makes alike. Forecasts are of later times by fits of the first ones, in which
e cos ω and e sin ω have a normal prior; its width is found in turn with them, from
0.01 on. Bands take a factor: that by which the fit of the first 60 % would have held 95 % of the
next 20 %.
"""

from __future__ import annotations

import dataclasses
import functools
import sys
from pathlib import Path
from typing import Any, NamedTuple

# Sets float64, so it comes before all of JAX.
from harness import (
    RESULTS,
    TABLES,
    Numbers,
    between_markers,
    main,
    markdown,
    number,
    once,
    provenance,
    read,
    results,
)

# isort: split
import jax
import jax.numpy as jnp
import numba
import numpy as np
import pandas as pd

from gfnn_jax.flows.lie import COMPOSITION
from gfnn_jax.solve.levenberg_marquardt import Nielsen, Tried, descended

RECORD = "--record"
PLANETS = "bcdefgh"
N = len(PLANETS)
UNKNOWNS = ("mass", "period", "time", "e_cos", "e_sin")  # seven of each, in this order
FLAT_MASS, FLAT_E = 1e-5, 1e-3  # of the star's; of e cos ω and e sin ω, where 0 has no derivative
FINE = 14  # steps in the shortest period
BEFORE = 1.0  # days, that the flow begins before the first transit and ends after the last
LARGEST_E, LARGEST_MASS = 0.1, 3e-4  # of a step that is tried
PRIOR_E, ROUNDS = 0.01, 3  # width of the prior that fits begin with, and how often it is found
FEW = 8  # iterations, of each time
FREEDOM, SCALE = 3.36, 0.709  # ν and the square of the scale, of the residuals ÷ their errors
SQUARES = 1e6  # ν of least squares
SETTLED = 1e-3  # decrease that ends a descent: absolute of Student's cost, relative of squares
FIRST, AGAIN = 1e-2, 1e-4  # damping of the first step, and where a descent goes on
LEAST = 0.1  # decrease ÷ promised one of a step that counts
MOST, QUICK = 40, 3  # iterations of each of the two losses
SMALL = 0.01  # difference of the Hessian, in standard deviations of the linearised problem
NEWTON = 4  # iterations to an event
BAND, INSIDE = 1.96, 0.95  # standard deviations and their share
SHARES = (0.6, 0.8)  # of the rows, that are fitted and forecast
SECONDS = 86_400.0  # in a day


class Transits(NamedTuple):
    """Planet (n,) from 0 on, number of the orbit, time and its error in days."""

    planet: np.ndarray
    epoch: np.ndarray
    t: np.ndarray
    sigma: np.ndarray

    @classmethod
    def of(cls, folder: Path) -> Transits:
        table = pd.read_csv(folder / "trappist1_transits.csv").sort_values("t")
        planet, *others = (table[name].to_numpy() for name in ("planet", "epoch", "t", "sigma"))
        return cls(planet - 1, *others)

    def some(self, rows: Any) -> Transits:
        return Transits(*(column[rows] for column in self))

    def lines(self) -> np.ndarray:
        """Period and time of epoch 0 (7, 2) of each planet by a straight line."""
        each = (self.some(self.planet == k) for k in range(N))
        return np.array([np.polyfit(one.epoch, one.t, 1, w=1 / one.sigma) for one in each])


@jax.jit
def begun(x, start):
    """Positions and velocities (2, 8, 2) and masses (8,) at a time, of unknowns (35,)."""
    mass, period, time, e_cos, e_sin = x.reshape(5, N)
    m = jnp.concatenate([jnp.ones(1), mass])
    e, turn = jnp.hypot(e_cos, e_sin), jnp.arctan2(e_sin, e_cos)
    inside = jnp.cumsum(m)
    along = 2 * jnp.pi / period
    a = (inside[1:] / along**2) ** (1 / 3)
    root = jnp.sqrt(1 - e**2)
    f = jnp.pi / 2 - turn  # at a conjunction the planet is in front of the star, at angle π/2
    at = jnp.arctan2(root * jnp.sin(f), e + jnp.cos(f))
    mean = at - e * jnp.sin(at) + along * (start - time)
    E = mean + e * jnp.sin(mean)
    for _ in range(6):  # Kepler's equation
        E = E - (E - e * jnp.sin(E) - mean) / (1 - e * jnp.cos(E))
    speed = along / (1 - e * jnp.cos(E))
    own = jnp.stack([jnp.cos(E) - e, root * jnp.sin(E)])
    moving = speed * jnp.stack([-jnp.sin(E), root * jnp.cos(E)])
    c, s = jnp.cos(turn), jnp.sin(turn)
    jacobi = a * jnp.einsum("ijk,njk->nik", jnp.array([[c, -s], [s, c]]), jnp.stack([own, moving]))
    centre, places = jnp.zeros((2, 2)), [jnp.zeros((2, 2))]
    for k in range(N):  # each planet from the centre of mass of all bodies inside it
        places.append(centre + jacobi[:, :, k])
        centre = centre + mass[k] / inside[k + 1] * jacobi[:, :, k]
    return jnp.stack(places, axis=1) - centre[:, None], m


_slopes_at_start = jax.jit(jax.jacfwd(lambda x, start: begun(x, start)[0]))


@numba.njit(cache=True, fastmath={"contract", "reassoc"}, error_model="numpy")
def moved(z, d, m, h):
    """Move a state (2, 8, 2) by a time h, and its derivatives (2, 8, 2, k) in masses and in others,
    in place: one composition of leapfrogs. The k unknowns begin with the masses of the planets."""
    q, v, dq, dv = z[0], z[1], d[0], d[1]
    bodies, unknowns = len(m), d.shape[3]
    for weight in COMPOSITION:
        kick = weight * h
        for half in range(2):
            q += 0.5 * kick * v
            dq += 0.5 * kick * dv
            if half:
                break
            for i in range(bodies):
                for j in range(i):
                    x, y = q[j, 0] - q[i, 0], q[j, 1] - q[i, 1]
                    inverse = 1 / (x * x + y * y)
                    cubed = kick * inverse * np.sqrt(inverse)
                    v[i, 0] += m[j] * cubed * x
                    v[i, 1] += m[j] * cubed * y
                    v[j, 0] -= m[i] * cubed * x
                    v[j, 1] -= m[i] * cubed * y
                    for k in range(unknowns):
                        dx, dy = dq[j, 0, k] - dq[i, 0, k], dq[j, 1, k] - dq[i, 1, k]
                        along = 3 * inverse * (x * dx + y * dy)
                        ax, ay = cubed * (dx - along * x), cubed * (dy - along * y)
                        dv[i, 0, k] += m[j] * ax
                        dv[i, 1, k] += m[j] * ay
                        dv[j, 0, k] -= m[i] * ax
                        dv[j, 1, k] -= m[i] * ay
                    if unknowns:
                        dv[j, 0, i - 1] -= cubed * x
                        dv[j, 1, i - 1] -= cubed * y
                        if j:
                            dv[i, 0, j - 1] += cubed * x
                            dv[i, 1, j - 1] += cubed * y


@numba.njit(cache=True)
def across(z, m, h, steps):
    """(steps + 1, 2, 7): how far each planet is from the star across the line of sight, and how
    fast it goes there, after each step."""
    z, none = z.copy(), np.zeros((2, len(m), 2, 0))
    found = np.empty((steps + 1, 2, len(m) - 1))
    for n in range(steps + 1):
        if n:
            moved(z, none, m, h)
        found[n] = z[:, 1:, 0] - z[:, :1, 0]
    return found


@numba.njit(cache=True)
def crossed(z, d, m, h, near, planet, late):
    """Times (n,) from the steps ``near`` (n,), which rise, to the transits, begun at ``late`` (n,),
    and derivatives (n, k) of these times."""
    z, d, at = z.copy(), d.copy(), 0
    times, slopes = late.copy(), np.empty((len(late), d.shape[3]))
    none = d[:, :, :, :0]
    for n in range(len(late)):
        while at < near[n]:
            moved(z, d, m, h)
            at += 1
        body = planet[n] + 1
        for trial in range(NEWTON):
            there = z.copy()
            if trial < NEWTON - 1:
                moved(there, none, m, times[n])
                slope = none
            else:
                slope = d.copy()
                moved(there, slope, m, times[n])
            speed = there[1, body, 0] - there[1, 0, 0]
            slopes[n, : slope.shape[3]] = (slope[0, 0, 0] - slope[0, body, 0]) / speed
            times[n] -= (there[0, body, 0] - there[0, 0, 0]) / speed
    return times, slopes


@dataclasses.dataclass(frozen=True)
class Student:
    """−2 log of Student's density of residuals ÷ their errors, but for its constant, and weights.

    freedom: ν, of which a large one makes least squares.
    """

    freedom: float = FREEDOM

    def of(self, r):
        return (self.freedom + 1) * np.log1p(r**2 / (self.freedom * SCALE))

    def weights(self, r):
        """ρ'/2r."""
        return (self.freedom + 1) / (self.freedom * SCALE + r**2)

    def bends(self, r):
        """ρ''/2, but a tenth of the weight where it is less, as of outliers."""
        size = self.freedom * SCALE
        return self.weights(r) * np.maximum((size - r**2) / (size + r**2), 0.1)


STUDENT = Student()


@dataclasses.dataclass(frozen=True)
class Setting:
    """What does not change in a descent. rows: how many are fitted, the first in time. prior:
    standard deviation of e cos ω and e sin ω."""

    transits: Transits
    rows: int
    prior: float = np.inf

    @functools.cached_property
    def lines(self) -> np.ndarray:
        return self.transits.some(slice(self.rows)).lines()

    @functools.cached_property
    def start(self) -> float:
        return float(self.transits.t[0]) - BEFORE

    @functools.cached_property
    def h(self) -> float:
        return float(self.lines[:, 0].min()) / FINE

    def near(self, z: np.ndarray, m: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """Numbers (n,) of the steps that are nearest to the transits and the times from these to
        them, to first order; None where the flow has not all of them."""
        own = self.transits
        steps = int((own.t[-1] + BEFORE - self.start) / self.h)
        found = across(z, m, self.h, steps)
        near, late = np.zeros(len(own.t), int), np.zeros(len(own.t))
        for k, (period, first) in enumerate(self.lines):
            x, rate = found[:, :, k].T
            at = np.flatnonzero((x[:-1] > 0) & (x[1:] <= 0))
            at = at + (x[at] > -x[at + 1])
            after = -x[at] / rate[at]
            epochs = np.rint((self.start + self.h * at + after - first) / period).astype(int)
            mine = own.planet == k
            place = np.searchsorted(epochs, own.epoch[mine])
            if np.any(place >= len(at)) or np.any(epochs[place] != own.epoch[mine]):
                return None
            near[mine], late[mine] = at[place], after[place]
        return near, late


@dataclasses.dataclass(frozen=True)
class Descent:
    """The `Problem` of a descent at unknowns x (35,). times: (n,) of all transits."""

    setting: Setting
    loss: Student
    x: np.ndarray
    near: np.ndarray
    late: np.ndarray
    said: bool = True

    @classmethod
    def at(cls, setting: Setting, loss: Student, x: np.ndarray) -> Descent | None:
        e = np.hypot(x[3 * N : 4 * N], x[4 * N :])
        if np.any((x[:N] <= 0) | (x[:N] > LARGEST_MASS)) or np.any(e > LARGEST_E):
            return None
        z, m = map(np.asarray, begun(x, setting.start))
        place = setting.near(z, m)
        return None if place is None else cls(setting, loss, x, *place)

    def crossed(self, slopes: bool) -> tuple[np.ndarray, np.ndarray]:
        own, order = self.setting, np.argsort(self.near, kind="stable")
        z, m = map(np.asarray, begun(self.x, own.start))
        d = np.asarray(_slopes_at_start(self.x, own.start)) if slopes else np.zeros((*z.shape, 0))
        back, given = np.argsort(order), (self.near[order], own.transits.planet[order])
        late, changes = crossed(z, d, m, own.h, *given, self.late[order])
        return own.start + own.h * self.near + late[back], changes[back]

    @functools.cached_property
    def times(self) -> np.ndarray:
        return self.crossed(False)[0]

    @functools.cached_property
    def slopes(self) -> np.ndarray:
        """Derivatives (n, 35) of the times."""
        return self.crossed(True)[1]

    @functools.cached_property
    def residuals(self) -> np.ndarray:
        own = self.setting
        return ((self.times - own.transits.t) / own.transits.sigma)[: own.rows]

    @functools.cached_property
    def cost(self) -> float:
        held = self.x[3 * N :] / self.setting.prior
        return float(np.sum(self.loss.of(self.residuals)) + held @ held)

    @functools.cached_property
    def jacobian(self) -> np.ndarray:
        own = self.setting
        return (self.slopes / own.transits.sigma[:, None])[: own.rows]

    @functools.cached_property
    def gradient(self) -> np.ndarray:
        """Half the gradient (35,) of the cost."""
        held = self.x / self.setting.prior**2
        held[: 3 * N] = 0
        return self.jacobian.T @ (self.loss.weights(self.residuals) * self.residuals) + held

    @functools.cached_property
    def system(self) -> tuple[np.ndarray, np.ndarray]:
        """Rows (n + 14, 35) of weighted derivatives, and their residuals."""
        r, held = self.residuals, np.eye(len(self.x))[3 * N :] / self.setting.prior
        root = np.sqrt(self.loss.bends(r))
        A = np.concatenate([root[:, None] * self.jacobian, held])
        return A, np.append(self.loss.weights(r) / root * r, held @ self.x)

    def tried(self, damping: float, failures: int) -> Tried:
        A, r = self.system
        size = np.linalg.norm(A, axis=0)
        damped = np.concatenate([A / size, np.sqrt(damping) * np.eye(len(size))])
        change = np.linalg.lstsq(damped, -np.append(r, np.zeros(len(size))), rcond=None)[0] / size
        there = Descent.at(self.setting, self.loss, self.x + change)
        decrease = -np.inf if there is None else self.cost - there.cost
        promised = float(r @ r - np.sum((r + A @ change) ** 2))
        return Tried(there, decrease if decrease > LEAST * promised else -1.0, damping, promised)

    def moved(self, there: Descent, damping: float) -> tuple[Descent, bool]:
        print(f"    cost {there.cost:.4f}, damping {damping:.1e}", flush=True)
        enough = SETTLED * (1.0 if self.loss is STUDENT else there.cost)
        return there, self.cost - there.cost < enough

    def covariance(self) -> np.ndarray:
        """(35, 35), of the linearised problem."""
        A, _ = self.system
        size = np.linalg.norm(A, axis=0)
        return np.linalg.inv((A / size).T @ (A / size)) / np.outer(size, size)

    def hessian(self) -> tuple[np.ndarray, np.ndarray]:
        """Half the Hessian (35, 35) of the cost in directions, and these (35, 35): columns that the
        linearised problem makes the unit matrix."""
        size = np.sqrt(np.diag(self.covariance()))
        ways = size[:, None] * np.linalg.cholesky(self.covariance() / np.outer(size, size))
        rows = []
        for way in ways.T:
            there = Descent.at(self.setting, self.loss, self.x + SMALL * way)
            assert there is not None
            rows.append(ways.T @ (there.gradient - self.gradient) / SMALL)
        return 0.5 * (np.array(rows) + np.array(rows).T), ways


def flat(setting: Setting) -> np.ndarray:
    one = np.ones(N)
    return np.concatenate([FLAT_MASS * one, *setting.lines.T, FLAT_E * one, FLAT_E * one])


def published(folder: Path) -> np.ndarray:
    table = pd.read_csv(folder / "trappist1_reference.csv")
    names = ("mass_ratio", "period", "t0", "e_cos_w", "e_sin_w")
    return np.concatenate([table[name].to_numpy() for name in names])


def fitted(setting: Setting, x: np.ndarray, quick: bool) -> Descent:
    """Where least squares and then Student's t lead."""
    for loss in (Student(SQUARES), STUDENT):
        problem = Descent.at(setting, loss, x)
        assert problem is not None, "the start loses a transit"
        x = descended(problem, Nielsen(), QUICK if quick else MOST, FIRST).problem.x
    end = Descent.at(setting, STUDENT, x)
    assert end is not None
    return end


def with_prior(setting: Setting, quick: bool) -> Descent:
    """The fit whose prior is as wide as the e-vectors that it finds, with their variances."""
    narrow = dataclasses.replace(setting, prior=PRIOR_E)
    end = fitted(narrow, flat(narrow), quick)
    for _ in range(ROUNDS):
        e, variances = end.x[3 * N :], np.diag(end.covariance())[3 * N :]
        width = float(np.sqrt(np.mean(e**2 + variances)))
        start = Descent.at(dataclasses.replace(setting, prior=width), STUDENT, end.x)
        assert start is not None
        end = descended(start, Nielsen(), QUICK if quick else FEW, AGAIN).problem
    return end


def whole(folder: Path, quick: bool, *, from_published: bool) -> Numbers:
    """The fit of all rows."""
    transits = Transits.of(folder)
    setting = Setting(transits, len(transits.t))
    start = published(folder) if from_published else flat(setting)
    end, _, seconds = once(lambda: fitted(setting, start, quick))
    table = {"found": end.x.tolist(), "published": published(folder).tolist()}
    return {"cost": end.cost, "processor_seconds": seconds} | table


def errors(folder: Path, quick: bool) -> Numbers:
    """Standard errors (35,) where the fit from flat starts ended, by the Hessian and without the
    second derivatives of the times."""
    transits, out = Transits.of(folder), Path("runs/trappist") if quick else RESULTS
    x = np.array(read({"flat": out / "trappist-flat.json"})["flat"]["measured"]["found"])
    end = Descent.at(Setting(transits, len(transits.t)), STUDENT, x)
    assert end is not None
    (hessian, ways), _, seconds = once(end.hessian)
    return {
        "errors": np.sqrt(np.diag(ways @ np.linalg.inv(hessian) @ ways.T)).tolist(),
        "linearised": np.sqrt(np.diag(end.covariance())).tolist(),
        "least_curvature": float(np.linalg.eigvalsh(hessian)[0]),
        "processor_seconds": seconds,
    }


def forecast(folder: Path, quick: bool, *, share: float) -> Numbers:
    """The fit of the first rows in time, and what it says of the next fifth. Its bands take the
    factor that the fit before would have needed."""
    transits, out = Transits.of(folder), Path("runs/trappist") if quick else RESULTS
    before = read({"before": out / "trappist-first-60.json"}) if share > SHARES[0] else {}
    factor = before["before"]["measured"]["needed"] if before else 1.0
    first, last = (int(s * len(transits.t)) for s in (share, share + 0.2 + 1e-9))
    end, _, seconds = once(lambda: with_prior(Setting(transits, first), quick))
    held = slice(first, last)
    later = transits.some(held)
    left = np.abs(end.times[held] - later.t)
    model = np.einsum("ni,ij,nj->n", end.slopes, end.covariance(), end.slopes)[held]
    noise = SCALE * FREEDOM / (FREEDOM - 2) * later.sigma**2
    period, start = end.setting.lines[later.planet].T
    straight = np.abs(start + period * later.epoch - later.t)
    tried = np.geomspace(1, 100, 400)
    within = [np.mean(left < BAND * np.sqrt(f**2 * model + noise)) for f in (factor, *tried)]
    enough = np.array(within[1:]) >= INSIDE
    return {
        "rows": last - first,
        "cost": end.cost,
        "prior": end.setting.prior,
        "median_seconds": SECONDS * float(np.median(left)),
        "straight_seconds": SECONDS * float(np.median(straight)),
        "factor": factor,
        "within": float(within[0]),
        "within_without_factor": float(within[1]),
        "needed": float(tried[np.argmax(enough)] if enough.any() else tried[-1]),
        "band_seconds": SECONDS * float(np.median(BAND * np.sqrt(factor**2 * model + noise))),
        "found": end.x.tolist(),
        "processor_seconds": seconds,
    }


# Each of its own file, so that a run goes on where it was stopped.
PIECES: dict[str, Any] = {
    "flat": functools.partial(whole, from_published=False),
    "published": functools.partial(whole, from_published=True),
    "errors": errors,
    "first-60": functools.partial(forecast, share=SHARES[0]),
    "first-80": functools.partial(forecast, share=SHARES[1]),
}


def apart(x: np.ndarray, y: np.ndarray) -> list[str]:
    """The largest relative differences of masses, periods and e-vectors, in per cent."""
    (m, P, _, *e), (n, Q, _, *f) = x.reshape(5, N), y.reshape(5, N)
    turned = np.hypot(*(np.array(e) - np.array(f))) / np.hypot(*f)
    return [number(100 * float(np.max(d))) for d in (abs(m / n - 1), abs(P / Q - 1), turned)]


def tables() -> None:
    """The table of RESULTS.md."""
    found = results(PIECES, "trappist")
    if len(found) < len(PIECES):
        return
    own, other, error, _, last = (found[name]["measured"] for name in PIECES)
    x, size = np.array(own["found"]), np.array(error["errors"])
    past = np.array(own["published"]).reshape(5, N)
    rows = [
        [planet, *(f"{v:.6g} ± {s:.1g}" for v, s in zip(a, b, strict=True)), f"{mass:.4g}"]
        for planet, a, b, mass in zip(
            PLANETS, x.reshape(5, N).T, size.reshape(5, N).T, past[0], strict=True
        )
    ]
    between = apart(x, np.array(other["found"]))
    wider = number(float(np.median(size / np.array(error["linearised"]))))
    text = (
        f"Cost {own['cost']:.3f} from flat starts and {other['cost']:.3f} from the published "
        f"values; the two fits differ by at most {between[0]} % in a mass, {between[1]} % in a "
        f"period and {between[2]} % in an e-vector. {number(own['processor_seconds'])} s of a "
        f"processor for the fit, {number(error['processor_seconds'])} s for the errors, which are "
        f"{wider} times the linearised ones in the median. The last {last['rows']} times, from the "
        f"first 80 % ({number(last['processor_seconds'])} s): median error "
        f"{number(last['median_seconds'])} s (straight lines {number(last['straight_seconds'])}), "
        f"{100 * last['within']:.0f} % within 95 % bands, {number(last['band_seconds'])} s wide on "
        f"either side in the median; without the factor {number(last['factor'])}, told by the 20 % "
        f"before, {100 * last['within_without_factor']:.0f} %. The prior's width is found as "
        f"{number(last['prior'])}."
    )
    heads = ("planet", "mass ÷ star's", "period, days", "conjunction", "e cos ω", "e sin ω")
    table = markdown((*heads, "mass, published"), rows)
    between_markers(TABLES, "trappist", f"{table}\n\n{text}\n\n{provenance(found)}")


if __name__ == "__main__":
    arguments, record = sys.argv[1:], Path()
    if RECORD in arguments:
        at = arguments.index(RECORD)
        record = Path(arguments[at + 1])
        del arguments[at : at + 2]
    PIECES |= {name: functools.partial(piece, record) for name, piece in PIECES.items()}
    main(__doc__ or "", PIECES, "trappist", tables, arguments)
