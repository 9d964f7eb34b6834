"""Maps with a bracket and no law, and what a bracket is worth: Casimirs and orbits over 10⁶ steps.

    python benchmarks/bracket_maps.py --processor-time     all rows, then the table in RESULTS.md
    python benchmarks/bracket_maps.py --only beside --quick

A map without a law is S in the chart of a known bracket, as far as `fit_lie_map` goes, fitted to
80 % of 1,000 to 1,300 pairs; its error is that of the executed step on 200 further ones, RMS ÷
spread. ``beside``: a free top from the same 400 pairs by the law with its bracket, and by fields
of degree 2: PySINDy's (``pip install gfnn_jax[peers]``), one of finite differences, and one fitted
through the Runge–Kutta step of order 4 that steps all fields; and by a Poisson network (P. Jin et
al., arXiv:2012.03133), coupling layers to (q, p, c), shears of (q, p) that c enters, and back. |M|
and orbits of five fresh starts
are compared with the flow of the true law. M² is a Casimir of the true bracket; the law's may have
another of a top's family, with M² as its H.
"""

from __future__ import annotations

import importlib.util
import sys
import time
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import optax
from harness import FIGURES, TABLES, Numbers, between_markers, markdown, number, provenance, results
from harness import main as run_pieces
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares

import gfnn_jax as gfnn
from gfnn_jax.evaluate.figures_style import save, style
from gfnn_jax.flows.lie import law_flow
from gfnn_jax.models.brackets.lie_maps import fit_lie_map

INVERSE = np.linalg.inv([[1.0, 0.2, 0.1], [0.2, 1.7, 0.3], [0.1, 0.3, 2.5]])
# Steps that are saved: of a rollout all up to the seventh, then every 200th.
SAVED = (1, 2, 5, 10, 20, 50, 100, *(k * 10**e for e in (2, 3, 4, 5) for k in (2, 6, 10)))
SPIN, TOP = gfnn.Bracket.so3(), gfnn.Bracket.se3()
CHAIN = gfnn.Bracket.constant(
    [[0, 1.3, 0.3, -1], [-1.3, 0, 1, 0.3], [-0.3, -1, 0, 1.3], [1, -0.3, -1.3, 0]]
)


def shell(rng, count: int, low: float, high: float) -> np.ndarray:
    z = rng.normal(size=(count, 3))
    return z * (rng.uniform(low, high, count) / np.linalg.norm(z, axis=1))[:, None]


def flow(bracket, gradient, z, dt):
    """Images of z (N, n) by DOP853."""

    def field(_, y):
        y = y.reshape(z.shape)
        return bracket.apply(y, gradient(y)).ravel()

    solved = solve_ivp(field, (0, dt), z.ravel(), method="DOP853", rtol=1e-13, atol=1e-14)
    return solved.y[:, -1].reshape(z.shape)


def kicked(z, angle=0.5):
    """A turn about the second axis, then one about the third by its coordinate."""
    c, s = np.cos(angle), np.sin(angle)
    x, y, w = (z @ np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])).T
    return np.stack([x * np.cos(w) - y * np.sin(w), x * np.sin(w) + y * np.cos(w), w], axis=1)


def case(name: str, rng) -> tuple:
    """(bracket, z0, z1, dt)."""
    if name == "kicked top":
        z = shell(rng, 1200, 0.8, 1.2)
        return SPIN, z, kicked(z), 1.0
    if name == "free top":
        z = shell(rng, 1200, 0.5, 1.2)
        return SPIN, z, flow(SPIN, lambda y: y @ INVERSE, z, 0.3), 0.3
    if name == "heavy top":
        z = np.concatenate([shell(rng, 1500, 0.3, 1.0), shell(rng, 1500, 0.9, 1.1)], axis=1)
        pull = np.tile([0.1, 0.0, 1.0], (len(z), 1))
        return TOP, z, flow(TOP, lambda y: np.c_[y[:, :3] @ INVERSE, pull], z, 0.3), 0.3
    y = np.log(rng.uniform(0.6, 1.6, (1500, 4)))
    rest = np.array([1, 0.9, 1.1, 1])
    return CHAIN, y, flow(CHAIN, lambda y: np.exp(y) - rest, y, 0.3), 0.3


def without_law(name: str, quick: bool) -> Numbers:
    """S of one system: its error, and its Casimirs over 1,000 steps."""
    bracket, z0, z1, dt = case(name, np.random.default_rng(0))
    started = time.process_time()
    found = fit_lie_map(z0[:-200], z1[:-200], bracket, dt, **({"degree": 4} if quick else {}))
    seconds = time.process_time() - started
    images, info = jax.jit(found.piece.step)(jnp.asarray(z0[-200:]))
    off = (np.asarray(images) - z1[-200:]) / found.piece.scale

    def step(both, _):
        z, lost, _ = found.piece.compensated_step(*both)
        return (z, lost), z

    begun = jnp.asarray(z0[:5])
    _, states = jax.jit(partial(jax.lax.scan, step, length=1000))((begun, jnp.zeros_like(begun)))
    drift = [np.nanmax(np.abs(c(np.asarray(states)) / c(z0[:5]) - 1)) for c in bracket.casimirs]
    return {
        "terms": found.piece.family.num_parameters,
        "degree": found.degree,
        "error": float(np.sqrt(np.mean(off**2))),
        "failed": int(np.sum(np.asarray(info.status) > 0)),
        "casimirs": float(max(drift)) if drift else None,
        "cpu_seconds": seconds,
    }


def beside(quick: bool) -> Numbers:
    """A free top by its law with the bracket, and by fields without one."""
    rng, dt, steps = np.random.default_rng(0), 0.1, 10_000 if quick else 1_000_000
    starts = shell(rng, 20, 0.5, 1.2)
    runs = [starts]
    for _ in range(20):
        runs.append(flow(SPIN, lambda y: y @ INVERSE, runs[-1], dt))
    orbits = np.stack(runs, axis=1)
    z0, z1 = orbits[:, :-1].reshape(-1, 3), orbits[:, 1:].reshape(-1, 3)
    fit = gfnn.fit(
        gfnn.Pairs(z0, z1, dt, run=np.repeat(np.arange(20), 20), structure="poisson"),
        max_seconds=None,
    )
    fresh = jnp.asarray(shell(rng, 5, 0.5, 1.2))

    def features(z):
        i, j = np.triu_indices(3)
        return jnp.concatenate([z, z[..., i] * z[..., j]], axis=-1)

    def field(c, z):
        return jnp.matmul(features(z), c, precision="highest")

    def runge_kutta(c, z):
        a = field(c, z)
        b = field(c, z + 0.5 * dt * a)
        d = field(c, z + 0.5 * dt * b)
        e = field(c, z + dt * d)
        return z + dt / 6 * (a + 2 * b + 2 * d + e)

    middle = np.linalg.lstsq(np.asarray(features(0.5 * (z0 + z1))), (z1 - z0) / dt, rcond=None)[0]
    residual = jax.jit(lambda c: (runge_kutta(c.reshape(9, 3), z0) - z1).ravel())
    through = least_squares(
        lambda c: np.asarray(residual(c)), middle.ravel(), xtol=1e-15, ftol=1e-15, gtol=1e-15
    ).x.reshape(9, 3)
    energy = gfnn.from_function(lambda inverse, z: 0.5 * z @ inverse @ z)
    truth = law_flow(energy, INVERSE, SPIN, dt, np.asarray(fresh))

    def rolled(step):
        run = jax.jit(lambda z, n: jax.lax.fori_loop(0, n, lambda _, y: step(y), z))
        saved, states = [n for n in SAVED if n <= steps], [fresh]
        for count in np.diff([0, *saved]):
            states.append(run(states[-1], count))
        return np.asarray(states)

    by_steps: dict[str, Callable] = {
        "field through Runge–Kutta 4": partial(runge_kutta, through),
        "field by finite differences, Runge–Kutta 4": partial(runge_kutta, middle),
    }
    sindy = by_sindy(orbits, dt)
    if sindy is not None:
        by_steps["PySINDy's field, Runge–Kutta 4"] = partial(runge_kutta, sindy)
    reference = rolled(lambda z: truth.step(z)[0])
    short = np.asarray(fit.map.rollout(fresh, 100)[0])[:, [0, *SAVED[:7]]]
    long = np.asarray(fit.map.rollout(fresh, steps, save_every=200)[0])
    own = [n for n in SAVED[7:] if n <= steps]
    states = np.concatenate([short, long[:, np.array(own) // 200]], axis=1).swapaxes(0, 1)
    found = {"law with its bracket": compared(states, reference)}
    found |= {name: compared(rolled(step), reference) for name, step in by_steps.items()}
    trained = trained_network(z0, z1, 500 if quick else TRAINING)
    network = compared(rolled(partial(network_step, trained.params)), reference)
    found[f"Poisson network, {trained.numbers:,} numbers"] = {
        **network,
        "error": trained.error,
        "cpu_seconds": trained.cpu_seconds,
    }
    if sindy is None:
        found["PySINDy's field, Runge–Kutta 4"] = {"absent": "not installed"}
    return found


COUPLINGS, SHEARS, WIDTH, TRAINING = 6, 8, 32, 12_000


class Trained(NamedTuple):
    """A Poisson network: its one-step error RMS ÷ spread, and how long Adam took."""

    params: Any
    numbers: int
    error: float
    cpu_seconds: float


def perceptron(params, x):
    """Numbers (..., out) of one hidden layer."""
    inside, shift, outside = params
    return jnp.tanh(x @ inside + shift) @ outside


def to_darboux(couplings, z, back: bool = False):
    """(q, p, c) of states z (..., 3), each coordinate in turn scaled and moved by the others."""
    order = range(COUPLINGS)
    for k in reversed(order) if back else order:
        own = jnp.arange(3) == k % 3
        scale, move = jnp.split(perceptron(couplings[k], jnp.where(own, 0.0, z)), 2, axis=-1)
        moved = (z - move) * jnp.exp(-scale) if back else z * jnp.exp(scale) + move
        z = jnp.where(own, moved, z)
    return z


def network_step(params, z):
    """The next states (..., 3) by a Poisson network."""
    couplings, shears = params
    y = to_darboux(couplings, z)
    for k, own in enumerate(shears):
        moved = jnp.arange(3) == k % 2
        y = y + jnp.where(moved, perceptron(own, jnp.where(moved, 0.0, y)), 0.0)
    return to_darboux(couplings, y, back=True)


def trained_network(z0, z1, iterations: int) -> Trained:
    """A Poisson network fitted to all pairs at once by Adam, whose rate falls along a cosine."""
    rng, started = np.random.default_rng(0), time.process_time()

    def layer(out: int):
        inside = rng.normal(size=(3, WIDTH)) / np.sqrt(3)
        return inside, 0.3 * rng.normal(size=WIDTH), 0.1 * rng.normal(size=(WIDTH, out))

    params = [layer(2) for _ in range(COUPLINGS)], [layer(1) for _ in range(SHEARS)]
    adam = optax.adam(optax.cosine_decay_schedule(3e-3, iterations, 1e-3))
    spread = z0.std(axis=0)

    def loss(params):
        return jnp.mean(((network_step(params, z0) - z1) / spread) ** 2)

    def more(carry, _):
        params, state = carry
        value, slope = jax.value_and_grad(loss)(params)
        change, state = adam.update(slope, state)
        return (optax.apply_updates(params, change), state), value

    @jax.jit
    def train(params):
        return jax.lax.scan(more, (params, adam.init(params)), length=iterations)

    (params, _), values = jax.block_until_ready(train(jax.tree.map(jnp.asarray, params)))
    numbers = sum(leaf.size for leaf in jax.tree.leaves(params))
    seconds = time.process_time() - started
    return Trained(params, numbers, float(np.sqrt(values[-1])), seconds)


def by_sindy(orbits: np.ndarray, dt: float) -> np.ndarray | None:
    """PySINDy's coefficients (9, 3) of the features of `beside`; None where it is not installed."""
    if importlib.util.find_spec("pysindy") is None:
        return None
    pysindy = importlib.import_module("pysindy")
    library = pysindy.PolynomialLibrary(degree=2, include_bias=False)
    model = pysindy.SINDy(
        optimizer=pysindy.STLSQ(threshold=0.02),
        feature_library=library,
        differentiation_method=pysindy.FiniteDifference(order=4),
    )
    model.fit(list(orbits), t=dt)
    return model.coefficients().T


def compared(states: np.ndarray, reference: np.ndarray) -> Numbers:
    """Largest relative change of |M|, and median error of the orbits, at each saved step, of
    states (S, B, 3)."""
    length = np.linalg.norm(states, axis=-1)
    casimir = np.abs(length / length[0] - 1).max(axis=1)
    orbit = np.median(np.abs(states - reference).max(axis=2), axis=1)
    series = {"steps": [*SAVED][: len(states) - 1]}
    series |= {"casimirs": casimir[1:].tolist(), "orbits": orbit[1:].tolist()}
    return {"casimir": float(casimir[-1]), "orbit": float(orbit[-1]), **series}


def draw(found: Numbers) -> None:
    """Draw changes of |M| and errors of orbits over the steps."""
    with style():
        figure, axes = plt.subplots(1, 2, figsize=(8, 3.2), layout="constrained")
    for name, m in found.items():
        if "absent" not in m:
            for ax, key in zip(axes, ("casimirs", "orbits"), strict=True):
                ax.loglog(m["steps"], np.maximum(m[key], 1e-17), label=name)
    for ax, what in zip(axes, ("|M|, relative change", "error of the orbit"), strict=True):
        ax.set_xlabel("step")
        ax.set_ylabel(what)
    lines, labels = axes[0].get_legend_handles_labels()
    figure.legend(lines, labels, loc="outside upper center", ncols=2, fontsize="x-small")
    save(figure, FIGURES / "bracket_peers.png", dpi=130)


def trained(m: Numbers) -> str:
    """What a network's training took and reached."""
    return f"{m['cpu_seconds']:.0f} CPU s, step {m['error']:.1e}" if "error" in m else "–"


NAMES = ("kicked top", "free top", "heavy top", "four populations in logs")
PIECES = {
    name.replace(" ", "-"): (lambda quick, name=name: without_law(name, quick)) for name in NAMES
} | {"beside": beside}


def tables() -> None:
    found = results(PIECES, "bracket_maps")
    keys = ("terms", "error", "casimirs", "cpu_seconds")
    rows = [
        [name, *(number(result["measured"][key]) for key in keys)]
        for name, result in found.items()
        if name != "beside"
    ]
    heads = ("map without a law", "terms of S", "one step", "Casimirs, 10³ steps", "fit, CPU s")
    text = markdown(heads, rows)
    if "beside" in found:
        peers = found["beside"]["measured"]
        draw(peers)
        rows = [
            [name, m.get("absent") or number(m["casimir"]), number(m.get("orbit")), trained(m)]
            for name, m in peers.items()
        ]
        heads = ("free top, 400 pairs; after 10⁶ steps", "change of M", "orbit", "training")
        text += "\n\n" + markdown(heads, rows)
        text += "\n\n![Changes of M and errors of orbits over 10⁶ steps](figures/bracket_peers.png)"
    between_markers(TABLES, "bracket_maps", f"{text}\n\n{provenance(found)}")


if __name__ == "__main__":
    run_pieces(__doc__ or "", PIECES, "bracket_maps", tables, sys.argv[1:], ("free-top",))
