"""Measured records and peers: the same training parts, forecasts of the same held-out thirds.

    python benchmarks/peers.py                     pendulum, two_carts, double_pendulum, arm2
    python benchmarks/peers.py --only pendulum --overwrite
    python benchmarks/peers.py --quick             the pendulum, little training, into runs/

The records are those that come with the package. Each peer ends in an acceleration q̈ = a(q, v)
that JAX integrates (diffrax): a rigid body whose equations are written by hand, its constants
fitted by SciPy; a neural ODE (flax, optax, diffrax); PySINDy, its library given by hand, by
derivatives and in weak form (pip install '.[peers]'; left out where it is not installed). All see
positions only. The state before a forecast is estimated by least squares from 20 samples through
the own equations of each, as `benchmarks/measured.py` does through ours, which is fitted in the
same run. Seconds are of the processor, compilation included.
"""

from __future__ import annotations

import functools
import time
import warnings
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

# Sets float64, so it comes before all of JAX.
from harness import (
    RESULTS,
    SEED,
    TABLES,
    Numbers,
    between_markers,
    main,
    markdown,
    provenance,
    read,
)
from measured import RECORDS, SAMPLES, forecasts, held_windows, split

import diffrax  # isort: skip
import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax
from scipy.interpolate import CubicHermiteSpline
from scipy.optimize import least_squares

import gfnn_jax as gfnn
from gfnn_jax.dataset.stretches import stretches
from gfnn_jax.signals.local_polynomials import choose_half, smooth

Acceleration = Callable[[Any, jax.Array, jax.Array], jax.Array]  # (params, q, v) -> q̈, (d,) each
LENGTH = 24  # samples of an arc that a peer is fitted to
FINER = 4  # points of the even grid of a weak form, per sample
DOMAINS = 100  # of the weak form, per arc
THRESHOLDS = (0.0, 0.003, 0.01, 0.03, 0.1, 0.3)  # of PySINDy's sparse regression, tried in turn


class System(NamedTuple):
    """What peers are told of a record: the equations with their constants, a library, features
    of a network, the largest step of an integrator (s), and these in words."""

    body: Acceleration
    constants: tuple[float, ...]
    library: Callable[[Any, Any], tuple[Any, ...]]
    features: Callable[[jax.Array], jax.Array]
    step: float
    told: str


class Arcs(NamedTuple):
    """Arcs of samples: times from the first sample on t (n, length) in s, positions y (n, length,
    d), and states x0 (n, 2d) at the first sample by local cubics."""

    t: np.ndarray
    y: np.ndarray
    x0: np.ndarray


# The systems, and what a person would write of them


def pendulum(c: Any, q: jax.Array, v: jax.Array) -> jax.Array:
    """θ̈ = −k sin(θ + θ₀) − c θ̇."""
    return -c[0] * jnp.sin(q + c[2]) - c[1] * v


def carts(c: Any, q: jax.Array, v: jax.Array) -> jax.Array:
    """Two masses between three springs, with linear friction."""
    first = -c[0] * q[0] + c[1] * q[1] + c[2] - c[3] * v[0]
    second = c[4] * q[0] - c[5] * q[1] + c[6] - c[7] * v[1]
    return jnp.array([first, second])


def double_pendulum(c: Any, q: jax.Array, v: jax.Array) -> jax.Array:
    """L = ½ω₁² + a ω₂² + b ω₁ω₂ cos(θ₁ − θ₂) + g₁ cos θ₁ + g₂ cos θ₂, with linear friction at the
    pivot and in the joint, and quadratic friction there too where it has constants."""
    a, b, g1, g2, *friction = c
    difference = q[0] - q[1]
    cross = b * jnp.cos(difference)
    mass = jnp.array([[1.0, cross], [cross, 2 * a]])
    speeds = jnp.array([v[0], v[1] - v[0]])
    pivot, joint = jnp.asarray(friction[:2]) * speeds
    if len(friction) == 4:
        pivot, joint = jnp.array([pivot, joint]) + jnp.asarray(friction[2:]) * speeds * abs(speeds)
    force = jnp.array(
        [
            -b * v[1] ** 2 * jnp.sin(difference) - g1 * jnp.sin(q[0]) - pivot + joint,
            b * v[0] ** 2 * jnp.sin(difference) - g2 * jnp.sin(q[1]) - joint,
        ]
    )
    return jnp.linalg.solve(mass, force)


def _pendulum_library(q: Any, v: Any) -> tuple[Any, ...]:
    return (jnp.sin(q[0]), jnp.cos(q[0]), jnp.sin(2 * q[0]), v[0], v[0] * jnp.abs(v[0]))


def _cart_library(q: Any, v: Any) -> tuple[Any, ...]:
    return (q[0], q[1], v[0], v[1], jnp.ones_like(q[0]))


def _double_pendulum_library(q: Any, v: Any) -> tuple[Any, ...]:
    """The terms of the solved equations; 1/(1 − k cos² Δ), k unknown, by its harmonics of Δ."""
    d = q[0] - q[1]
    terms = (
        jnp.sin(q[0]),
        jnp.sin(q[1]),
        jnp.sin(q[0] - 2 * q[1]),
        jnp.sin(2 * q[0] - q[1]),
        v[0] ** 2 * jnp.sin(d),
        v[1] ** 2 * jnp.sin(d),
        v[0] ** 2 * jnp.sin(2 * d),
        v[1] ** 2 * jnp.sin(2 * d),
        v[0],
        v[1],
    )
    return tuple(term * jnp.cos(2 * k * d) for k in range(4) for term in terms)


def _angles(q: jax.Array) -> jax.Array:
    return jnp.concatenate([jnp.sin(q), jnp.cos(q)])


SYSTEMS = {
    "pendulum": System(
        pendulum,
        (5.0, 0.01, 0.0),
        _pendulum_library,
        _angles,
        0.06,
        "θ̈ = −k sin θ − c θ̇; sin, cos, ω, ω abs(ω)",
    ),
    "two_carts": System(
        carts,
        (10.0, 5.0, 0.0, 0.1, 5.0, 10.0, 0.0, 0.1),
        _cart_library,
        lambda q: q / 50,
        0.034,
        "two masses, three springs, linear friction; 1, x, v",
    ),
    "double_pendulum": System(
        double_pendulum,
        (0.2, 0.4, 60.0, 20.0, 0.01, 0.01),
        _double_pendulum_library,
        _angles,
        0.011,
        "the textbook's Lagrangian; the 40 terms of its solved equations",
    ),
    "arm2": System(
        double_pendulum,
        (0.2, 0.4, -60.0, -20.0, 0.01, 0.01, 0.0, 0.0),
        _double_pendulum_library,
        _angles,
        0.01,
        "the textbook's Lagrangian, linear and quadratic friction; the 40 terms of its solved "
        "equations",
    ),
}


# Integration, shared by all


@functools.partial(jax.jit, static_argnums=(0, 4, 5))
def positions(
    a: Acceleration, params: Any, x0: jax.Array, t: jax.Array, step: float, forward: bool = True
) -> jax.Array:
    """Positions (n, m, d) at times t (n, m), rising from 0, from states x0 (n, 2d); infinite where
    the equations run away. Differentiated in forward mode, else in reverse."""
    adjoint = diffrax.ForwardMode() if forward else diffrax.RecursiveCheckpointAdjoint()
    dim = x0.shape[-1] // 2

    def field(_: Any, x: jax.Array, params: Any) -> jax.Array:
        return jnp.concatenate([x[dim:], a(params, x[:dim], x[dim:])])

    def one(x0: jax.Array, t: jax.Array) -> jax.Array:
        solved = diffrax.diffeqsolve(
            diffrax.ODETerm(field),
            diffrax.Tsit5(),
            0.0,
            t[-1],
            step,
            x0,
            params,
            saveat=diffrax.SaveAt(ts=t),
            adjoint=adjoint,
            throw=False,
            max_steps=4096,
        )
        assert solved.ys is not None  # times were asked for
        return solved.ys[:, :dim]

    return jax.vmap(one)(x0, t)


@functools.partial(jax.jit, static_argnums=(0, 5))
def estimated(
    a: Acceleration, params: Any, x0: jax.Array, t: jax.Array, y: jax.Array, step: float
) -> jax.Array:
    """States (n, 2d) at the first samples: least squares to the positions y (n, m, d) at t (n, m),
    12 damped Gauss–Newton iterations from x0 (n, 2d)."""

    def one(x0: jax.Array, t: jax.Array, y: jax.Array) -> jax.Array:
        def residual(x: jax.Array) -> jax.Array:
            return (positions(a, params, x[None], t[None], step)[0] - y).ravel()

        def iterate(state: tuple[jax.Array, jax.Array], _: None) -> Any:
            x, damping = state
            r, j = residual(x), jax.jacfwd(residual)(x)
            normal = j.T @ j
            new = x - jnp.linalg.solve(normal + damping * jnp.diag(jnp.diag(normal)), j.T @ r)
            better = jnp.sum(residual(new) ** 2) < jnp.sum(r**2)
            return (jnp.where(better, new, x), damping * jnp.where(better, 0.1, 10.0)), None

        return jax.lax.scan(iterate, (x0, jnp.asarray(1e-3)), None, length=12)[0][0]

    return jax.vmap(one)(x0, t, y)


# The peers: each turns training arcs into an acceleration and its parameters


def by_hand(system: System, arcs: Arcs, quick: bool) -> tuple[Acceleration, Any]:
    """The equations' constants and the state at the start of each arc, by SciPy's least squares."""
    spread = arcs.y.std(axis=(0, 1))
    num = len(system.constants)

    def residual(unknown: Any) -> Any:
        x0 = unknown[num:].reshape(arcs.x0.shape)
        found = positions(system.body, unknown[:num], x0, arcs.t, system.step)
        return ((found - arcs.y) / spread).ravel()

    jacobian = jax.jit(jax.jacfwd(residual))
    start = np.concatenate([_constants(system, arcs), arcs.x0.ravel()])
    found = least_squares(
        residual,
        start,
        jac=lambda x: np.asarray(jacobian(x)),  # pyright: ignore[reportArgumentType]
        x_scale="jac",
        loss="soft_l1",  # pyright: ignore[reportArgumentType]
        f_scale=0.01,
        max_nfev=10 if quick else 60,
    )
    return system.body, jnp.asarray(found.x[:num])


def _constants(system: System, arcs: Arcs) -> np.ndarray:
    """Constants by which the equations give the accelerations of local cubics."""
    half = choose_half([(t, y) for t, y in zip(arcs.t, arcs.y, strict=True)])[0]
    parts = [smooth(t, y, half)[0] for t, y in zip(arcs.t, arcs.y, strict=True)]
    q, v, a = (np.concatenate([getattr(s, name)[2:-2] for s in parts]) for name in "qva")
    body = jax.jit(jax.vmap(system.body, in_axes=(None, 0, 0)))
    found = least_squares(
        lambda c: (np.asarray(body(c, q, v)) - a).ravel() / a.std(),
        system.constants,
        loss="soft_l1",
        f_scale=0.1,
    )
    return found.x


class Network(nn.Module):
    """Two hidden layers of 48: (features of q, v) -> q̈ ÷ its size."""

    dim: int

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        for _ in range(2):
            x = nn.tanh(nn.Dense(48, param_dtype=float)(x))
        return nn.Dense(self.dim, param_dtype=float)(x)


def neural_ode(system: System, arcs: Arcs, quick: bool) -> tuple[Acceleration, Any]:
    """A network for q̈, and the states at the start of the arcs, by Adam through diffrax."""
    n, _, dim = arcs.y.shape
    spread = arcs.y.std(axis=(0, 1))
    speed = arcs.x0[:, dim:].std(axis=0)
    size = speed**2 / spread  # of an acceleration
    network = Network(dim)

    def acceleration(params: Any, q: jax.Array, v: jax.Array) -> jax.Array:
        return size * network.apply(params, jnp.concatenate([system.features(q), v / speed]))

    key = jax.random.key(SEED)
    features = jax.eval_shape(system.features, jnp.zeros(dim)).shape[0]
    weights = network.init(key, jnp.zeros(features + dim))
    scale = np.concatenate([spread, speed])
    unknown = (weights, jnp.zeros((n, 2 * dim)))  # what is added to the states, in their scales
    steps = 40 if quick else 2_000
    schedule = optax.cosine_decay_schedule(5e-3, steps)
    optimizer = optax.adam(schedule)

    def loss(unknown: Any, rows: jax.Array) -> jax.Array:
        weights, shift = unknown
        x0 = jnp.asarray(arcs.x0)[rows] + 0.1 * scale * shift[rows]
        found = positions(acceleration, weights, x0, jnp.asarray(arcs.t)[rows], system.step, False)
        return jnp.mean(((found - jnp.asarray(arcs.y)[rows]) / spread) ** 2)

    @jax.jit
    def train(unknown: Any, state: Any, key: jax.Array) -> Any:
        rows = jax.random.choice(key, n, (min(16, n),), replace=False)
        updates, state = optimizer.update(jax.grad(loss)(unknown, rows), state)
        return optax.apply_updates(unknown, updates), state

    state = optimizer.init(unknown)
    for k in range(steps):
        unknown, state = train(unknown, state, jax.random.fold_in(key, k))
    return acceleration, unknown[0]


def pysindy_sparse(system: System, arcs: Arcs, quick: bool) -> tuple[Acceleration, Any]:
    """Sparse regression on the library of the accelerations of smoothed positions, or of the
    smoothed speeds in weak form. The kind and the threshold are those whose equations, from three
    quarters of the arcs, follow the last quarter best; they are then fitted to all."""
    import pysindy as ps

    half = choose_half([(t, y) for t, y in zip(arcs.t, arcs.y, strict=True)])[0]
    smoothed = [smooth(t, y, half)[0] for t, y in zip(arcs.t, arcs.y, strict=True)]
    few = slice(None, -max(1, len(smoothed) // 4))
    check = slice(few.stop, None)

    def acceleration(params: Any, q: jax.Array, v: jax.Array) -> jax.Array:
        return params @ jnp.stack(system.library(q, v))

    def sparse(threshold: float) -> Any:
        return ps.STLSQ(threshold=threshold, alpha=1e-6, normalize_columns=True)

    best, chosen = np.inf, None
    for kind in (_derivatives, _weak_form):
        regression = kind(system, arcs.t[few], smoothed[few])
        for threshold in THRESHOLDS[:2] if quick else THRESHOLDS:
            params = jnp.asarray(regression(sparse(threshold)))
            x0, t, y = arcs.x0[check], arcs.t[check], arcs.y[check]
            x0 = estimated(acceleration, params, x0, t, y, system.step)
            error = float(jnp.mean((positions(acceleration, params, x0, t, system.step) - y) ** 2))
            if error < best:
                best, chosen = error, (kind, threshold)
    if chosen is None:
        raise RuntimeError("PySINDy's equations run away along every arc, at each threshold")
    kind, threshold = chosen
    return acceleration, jnp.asarray(kind(system, arcs.t, smoothed)(sparse(threshold)))


def _derivatives(
    system: System, times: np.ndarray, smoothed: Sequence[Any]
) -> Callable[[Any], np.ndarray]:
    """Return the regression of the accelerations of local cubics: optimizer -> (d, terms)."""
    inner = slice(2, -2)  # cubics are poor at the ends of an arc
    columns = [
        np.stack(np.broadcast_arrays(*system.library(s.q.T, s.v.T)), axis=1) for s in smoothed
    ]
    features = np.concatenate([c[inner] for c in columns])
    rates = np.concatenate([s.a[inner] for s in smoothed])
    return lambda sparse: sparse.fit(features, rates).coef_


def _weak_form(
    system: System, times: np.ndarray, smoothed: Sequence[Any]
) -> Callable[[Any], np.ndarray]:
    """Return the regression of −∫ψ̇ v on ∫ψ φ(q, v), ψ bumps on an even grid, by PySINDy's weak
    library: optimizer -> (d, terms)."""
    import pysindy as ps

    dim = smoothed[0].q.shape[1]
    grid = np.linspace(0, min(t[-1] for t in times), FINER * times.shape[1])
    states = []
    for t, s in zip(times, smoothed, strict=True):
        q = CubicHermiteSpline(t, s.q, s.v)
        states.append(np.hstack([q(grid), q(grid, 1)]))

    def term(k: int) -> Callable[..., np.ndarray]:
        # PySINDy tells the variables of a term by the names of its arguments.
        names = ", ".join(f"x{i}" for i in range(2 * dim))
        scope = {
            "of": lambda *x: np.asarray(system.library(np.stack(x[:dim]), np.stack(x[dim:]))[k])
        }
        return eval(f"lambda {names}: of({names})", scope)

    count = len(system.library(np.ones((dim, 1)), np.ones((dim, 1))))
    terms = ps.CustomLibrary(
        [term(k) for k in range(count)],
        [lambda *_, k=k: f"f{k}" for k in range(count)],
        interaction_only=True,
    )

    def regression(sparse: Any) -> np.ndarray:
        # PySINDy draws its domains from the global generator.
        np.random.seed(SEED)  # noqa: NPY002
        weak = ps.WeakPDELibrary(terms, spatiotemporal_grid=grid, K=DOMAINS)
        model = ps.SINDy(optimizer=sparse, feature_library=weak)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return model.fit(states, t=grid).coefficients()[dim:]

    return regression


PEERS = {"rigid body by hand": by_hand, "neural ODE": neural_ode, "PySINDy": pysindy_sparse}


# Measuring


def arcs_of(parts: Sequence[Any], length: int = LENGTH) -> Arcs:
    """Arcs of ``length`` samples, half of each shared with the next, of stretches without gaps."""
    half = choose_half([(s.t, s.y) for s in parts])[0]
    t, y, x0 = [], [], []
    for s in parts:
        local = smooth(s.t, s.y, half)[0]
        for k in range(0, len(s.t) - length + 1, length // 2):
            t.append(s.t[k : k + length] - s.t[k])
            y.append(s.y[k : k + length])
            x0.append(np.concatenate([local.q[k], local.v[k]]))
    return Arcs(np.array(t), np.array(y), np.array(x0))


def judged(name: str, a: Acceleration, params: Any, held: Any) -> dict[str, float | None]:
    """Median error of the worst coordinate at the times ahead of `measured.py`, in its unit."""
    times, unit, _, _ = RECORDS[name]
    system = SYSTEMS[name]
    ends, ahead, seen = held_windows(held, times)
    t, y, x0, later = [], [], [], []
    half = choose_half([(s.t, s.y) for s, _ in ends])[0]
    for (s, k), to in zip(ends, ahead, strict=True):
        rows = slice(k - SAMPLES + 1, k + 1)
        local = smooth(s.t[rows], s.y[rows], min(half, SAMPLES // 2))[0]
        t.append(s.t[rows] - s.t[rows.start])
        y.append(s.y[rows])
        x0.append(np.concatenate([local.q[0], local.v[0]]))
        later.append(to - s.t[rows.start])
    start = estimated(a, params, np.array(x0), np.array(t), np.array(y), system.step)
    error = np.abs(np.asarray(positions(a, params, start, np.array(later), system.step)) - seen)
    found: dict[str, float | None] = {}
    for n, time_ahead in enumerate(times):
        there = np.isfinite(seen[:, n]).all(axis=1)
        some = np.where(np.isfinite(error[there, n]), error[there, n], np.inf)
        worst = float(np.median(some, axis=0).max()) if there.any() else np.nan
        found[str(time_ahead)] = worst * unit if np.isfinite(worst) else None
    return found


def measure(name: str, quick: bool) -> Numbers:
    """Fit ours and each peer to the first two thirds of a record, and judge the forecasts of its
    last."""
    record = gfnn.records.RECORDS[name]
    recording = gfnn.read(
        gfnn.records.path(name), positions=list(record.positions), angles=list(record.angles)
    )
    training, held = split(recording, 2)
    system = SYSTEMS[name]
    arcs = arcs_of(list(stretches(training)))
    found: Numbers = {
        "told": system.told,
        "num_arcs": len(arcs.t),
        OURS: ours(name, training, held),
    }
    for peer, fit in PEERS.items():
        started = time.process_time()
        try:
            a, params = fit(system, arcs, quick)
        except ImportError:
            print(f"{peer} is not installed", flush=True)
            continue
        seconds = time.process_time() - started
        found[peer] = {
            "median": judged(name, a, params, held),
            "seconds": seconds,
            "num_parameters": sum(p.size for p in jax.tree.leaves(params)),
        }
        print(f"{name}, {peer}: {found[peer]}", flush=True)
    return found


def ours(name: str, training: Any, held: Any) -> Numbers:
    """The law that the package finds, and its forecasts."""
    times, unit, _, _ = RECORDS[name]
    started = time.process_time()
    fit = gfnn.fit(training)
    seconds = time.process_time() - started
    errors, _ = forecasts(fit.map, held, times)
    median = {str(t): None if e is None else e * unit for t, e in zip(times, errors, strict=True)}
    return {"median": median, "seconds": seconds, "formula": fit.formula}


OURS = "gfnn_jax"
PIECES = {name: functools.partial(measure, name) for name in SYSTEMS}


def tables() -> None:
    """The table of RESULTS.md."""
    found = read({name: RESULTS / f"peers-{name}.json" for name in SYSTEMS})
    if not found:
        return
    rows = []
    for name, result in found.items():
        m = result["measured"]
        body, library = m["told"].split("; ")
        angles = "which columns are angles" if gfnn.records.RECORDS[name].angles else "positions"
        told = {"rigid body by hand": body, "PySINDy": library}
        rows += [
            [name, method, told.get(method, angles), *_cells(m[method])]
            for method in (OURS, *PEERS)
            if method in m
        ]
    heads = ("record", "method", "told", "median error ahead", "CPU s")
    between_markers(TABLES, "peers", f"{markdown(heads, rows)}\n\n{provenance(found)}")


def _cells(m: Numbers) -> tuple[str, str]:
    ahead = "; ".join(f"{t} s {e:.3g}" for t, e in m["median"].items() if e is not None)
    return ahead or "runs away", f"{m['seconds']:.0f}"


if __name__ == "__main__":
    main(__doc__ or "", PIECES, "peers", tables, None, quick_pieces=("pendulum",))
