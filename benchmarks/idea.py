"""Five figures that explain the idea, in one style; numbers in them are computed here.

    python benchmarks/idea.py

They go into benchmarks/figures as idea_*.png, for docs/how-it-works.md. Each is drawn from a system
of a few lines, in NumPy, within seconds.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from gfnn_jax.evaluate.figures_style import COLOURS, GREY, HEIGHT, WIDTH, save, style

FIGURES = Path(__file__).parent / "figures"
BLUE, RED, GREEN = COLOURS[:3]
Field = Callable[[np.ndarray], np.ndarray]


def panels(count: int, **options) -> tuple[Figure, list[Axes]]:
    """A figure with panels side by side."""
    figure = Figure(figsize=(0.8 * WIDTH * count, 1.1 * HEIGHT))
    return figure, list(np.ravel(figure.subplots(1, count, **options)))


# 1. A chart, and the implicit step.


def pendulum(w: np.ndarray) -> np.ndarray:
    """∇S of S = ½ p² − cos q at w (..., 2)."""
    return np.stack([np.sin(w[..., 0]), w[..., 1]], axis=-1)


def step(z: np.ndarray, h: float, gradient: Field = pendulum, c: float = 0.0):
    """(Z, w, residual before each update) of Z = z + h J ∇S(w), w = ½(z + Z) + C(Z − z), of one
    state (2,)."""
    size = np.array([0.5 + c, 0.5 - c])
    w, residuals = z + size * h * turned(gradient(z)), []
    for _ in range(6):
        r = w - z - size * h * turned(gradient(w))
        residuals.append(float(np.abs(r).max()))
        slopes = [(gradient(w + d) - gradient(w - d)) / 2e-5 for d in 1e-5 * np.eye(2)]
        of_w = np.eye(2) - h * size[:, None] * turned(np.array(slopes)).T
        w = w - np.linalg.solve(of_w, r)
    return z + h * turned(gradient(w)), w, residuals


def turned(gradient: np.ndarray) -> np.ndarray:
    """J times a gradient (..., 2)."""
    return np.stack([gradient[..., 1], -gradient[..., 0]], axis=-1)


def chart() -> Figure:
    """Draw a step, the points at which charts evaluate S, and Newton's method."""
    figure, (plane, solve) = panels(2)
    z, h = np.array([0.9, 0.9]), 0.9
    image, w, residuals = step(z, h)
    q, p = np.meshgrid(np.linspace(0.6, 2.1, 60), np.linspace(-0.15, 1.15, 60))
    plane.contour(q, p, 0.5 * p**2 - np.cos(q), 9, colors="0.8", linewidths=0.8)
    arrow = {"arrowstyle": "->", "color": BLUE, "lw": 2, "shrinkA": 0, "shrinkB": 0}
    plane.annotate("", (image[0], image[1]), (z[0], z[1]), arrowprops=arrow)
    for at, text, side in ((z, "z = (q, p)", (-4, 8)), (image, "Z = (Q, P)", (8, -6))):
        plane.plot(*at, "o", color="black")
        plane.annotate(text, (at[0], at[1]), side, textcoords="offset points")
    corners = {
        "midpoint w": (w, "D"),
        "type 2: (q, P)": (np.array([z[0], image[1]]), "s"),
        "type 3: (Q, p)": (np.array([image[0], z[1]]), "^"),
    }
    for colour, (name, (at, marker)) in zip((RED, GREEN, COLOURS[3]), corners.items(), strict=True):
        plane.plot(*at, marker, ls="none", ms=7, color=colour, label=name)
    plane.plot([], [], color="0.8", label="level lines of S")
    plane.legend(loc="upper right", title="S is evaluated at")
    plane.set(xlabel="q", ylabel="p", title=r"Z = z + h J ∇S(w): along the level line of S at w")
    solve.semilogy(np.maximum(residuals, 1e-17), "o-", color=BLUE)
    solve.axhline(2.2e-16, color="black", ls=":", lw=1, label="roundoff")
    solve.set(xlabel="Newton update", ylabel="residual of the equation for w")
    solve.set_title("w is unknown: one small equation, solved to roundoff")
    solve.legend()
    return figure


# 2. Why exact symplecticity bounds the error.


def _rolled(advance: Callable[[np.ndarray], np.ndarray], z: np.ndarray, count: int) -> np.ndarray:
    states = [z]
    for _ in range(count):
        states.append(advance(states[-1]))
    return np.array(states)


def symplectic() -> Figure:
    """Draw two maps with the same one-step error: their orbits, energies and positions.

    The exact map turns z by an angle that grows with |z|, as for H = ½|z|² + ⅛|z|⁴.
    """
    h, error, count = 0.2, 2e-4, 2_000

    def flow(z: np.ndarray) -> np.ndarray:
        angle = h * (1 + 0.5 * np.sum(z**2))
        c, s = np.cos(angle), np.sin(angle)
        return np.array([c * z[0] + s * z[1], c * z[1] - s * z[0]])

    def kicked(z: np.ndarray) -> np.ndarray:
        """The flow, and a force that has a potential: symplectic."""
        z = flow(z)
        return z + np.array([0.0, error * np.sqrt(2) * np.sin(3 * z[0])])

    def any_map(z: np.ndarray) -> np.ndarray:
        """The flow, and an error of the same size that has none."""
        z = flow(z)
        return z + np.array([0.0, error * np.sqrt(2) * z[1]])

    figure, (plane, energy, position) = panels(3)
    n, first = np.arange(1, count + 1), np.array([1.0, 0.0])
    exact = _rolled(flow, first, count)
    maps = (("not symplectic", any_map, RED, "--"), ("symplectic", kicked, BLUE, "-"))
    for name, map_, colour, line in maps:
        states = _rolled(map_, first, count)
        plane.plot(*states.T, ".", ms=1.5, color=colour, label=name)
        square = np.sum(states**2, axis=1)
        off = np.abs(0.5 * square + 0.125 * square**2 - 0.625)[1:] / 0.625
        energy.loglog(n, np.maximum.accumulate(off), line, color=colour, label=name)
        away = np.linalg.norm(states - exact, axis=1)[1:]
        position.loglog(n, np.maximum.accumulate(away), line, color=colour, label=name)
    for power, size in ((1, 4e-4), (2, 1.5e-5)):
        shown = n[size * n**power < 3]
        text = "∝ n" if power == 1 else "∝ n²"
        position.loglog(shown, size * shown**power, ":", color="black", lw=0.8)
        last = (shown[-1], size * shown[-1] ** power)
        beside = (-24, 4) if power == 1 else (-32, -8)
        position.annotate(text, last, beside, textcoords="offset points")
    plane.set_aspect("equal", "datalim")
    plane.set(xlabel="q", ylabel="p", title=f"one orbit, {count:,} steps")
    energy.set(xlabel="step n", ylabel="largest relative error so far")
    energy.set_title("energy: bounded, or growing")
    position.set(xlabel="step n", ylabel="largest error so far", title="position: as n, or as n²")
    plane.legend(loc="center", markerscale=4)
    for ax in (energy, position):
        ax.legend(loc="upper left", markerscale=4)
    return figure


# 3. From weak form to arcs.


def _oscillation(t: np.ndarray, k: float, c: float, x0: float, v0: float) -> np.ndarray:
    """x(t) of x'' = −k x − c x'."""
    fast = np.sqrt(k - c**2 / 4)
    return np.exp(-c * t / 2) * (
        x0 * np.cos(fast * t) + (v0 + c * x0 / 2) / fast * np.sin(fast * t)
    )


def _weak(t: np.ndarray, x: np.ndarray, half: int) -> tuple[float, np.ndarray]:
    """(k, a test function) by ∫ φ'' x = −k ∫ φ x + c ∫ φ' x, for φ = (1 − s²)⁴."""
    dt = t[1] - t[0]
    s = np.arange(-half, half + 1) / half
    bump = (1 - s**2) ** 4
    one, two = (np.gradient(bump, dt), np.gradient(np.gradient(bump, dt), dt))
    rows = [
        [np.dot(f, x[i : i + len(s)]) for f in (bump, one, two)]
        for i in range(0, len(x) - len(s), half // 2)
    ]
    table = np.array(rows)
    solved = np.linalg.lstsq(np.stack([-table[:, 0], table[:, 1]], axis=1), table[:, 2], rcond=None)
    return float(solved[0][0]), bump


def _arcs(t: np.ndarray, x: np.ndarray, length: int, start: tuple[float, float]):
    """(k, its standard error, fitted arcs) by least squares over arcs whose states are latent."""
    from scipy.optimize import least_squares

    parts = [slice(i, i + length) for i in range(0, len(t) - length + 1, length)]
    v = np.gradient(x, t)

    def fitted(p: np.ndarray) -> list[np.ndarray]:
        states = p[2:].reshape(-1, 2)
        return [
            _oscillation(t[s] - t[s][0], p[0], p[1], *z) for s, z in zip(parts, states, strict=True)
        ]

    def off(p: np.ndarray) -> np.ndarray:
        return np.concatenate([f - x[s] for f, s in zip(fitted(p), parts, strict=True)])

    first = np.array([*start, *np.ravel([[x[s][0], v[s][0]] for s in parts])])
    found = least_squares(off, first)
    sigma2 = 2 * found.cost / max(len(found.fun) - len(first), 1)
    error = float(np.sqrt(sigma2 * np.linalg.inv(found.jac.T @ found.jac)[0, 0]))
    return (
        float(found.x[0]),
        error,
        [(t[s], f) for s, f in zip(parts, fitted(found.x), strict=True)],
    )


def arcs() -> Figure:
    """Draw the three stages of a fit of a recording: weak form, short arcs, longer arcs."""
    k, c, dt = 4.0, 0.1, 0.05
    t = np.arange(0.0, 8 * np.pi, dt)
    x = _oscillation(t, k, c, 1.0, 0.0) + 0.05 * np.random.default_rng(2).standard_normal(len(t))
    figure, (first, second, third) = panels(3)
    half = 24
    weak, bump = _weak(t, x, half)
    for ax in (first, second):
        ax.plot(t, x, ".", ms=2, color=GREY, label="measured")
        ax.set(xlabel="t", ylabel="x", xlim=(0, 4 * np.pi), ylim=(-1.6, 1.6))
    for i in range(0, 4 * half, half // 2):
        label = "test functions φ" if not i else None
        first.plot(t[i : i + len(bump)], bump - 1.5, color=RED, lw=0.9, label=label)
    first.set_title("1. weak form: ∫φ''x = −k∫φx + c∫φ'x")
    first.legend(loc="upper right", ncols=2)
    lengths = (32, 63, 126, 251, 502)
    found = [_arcs(t, x, n, (weak, 0.0)) for n in lengths]
    for place, (when, arc) in enumerate(found[0][2]):
        second.plot(
            when, arc, color=BLUE, label="arcs, each with its own state" if not place else None
        )
        second.axvline(when[0], color="0.85", lw=0.6, zorder=0)
    second.set_title("2. arcs: the state of each is fitted with the law")
    second.legend(loc="upper right", ncols=2)
    periods = np.array(lengths) * dt / np.pi
    third.axhline(k, color="black", ls=":", lw=1, label="true")
    values, errors = np.array([(one[0], one[1]) for one in found]).T
    third.errorbar(
        periods,
        values,
        2 * errors,
        fmt="o-",
        color=BLUE,
        capsize=3,
        label="arcs, ± 2 standard errors",
    )
    exact, rng = _oscillation(t, k, c, 1.0, 0.0), np.random.default_rng(3)
    draws = [_weak(t, exact + 0.05 * rng.standard_normal(len(t)), half)[0] for _ in range(100)]
    spread = {"fmt": "s", "color": RED, "capsize": 3, "label": "weak form, ± 2 σ of 100 draws"}
    third.errorbar(0.5 * periods[0], weak, 2 * np.std(draws), **spread)
    third.set_xscale("log")
    third.set_xticks(periods, [f"{one:.1f}" for one in periods])
    third.minorticks_off()
    third.set(
        xlabel="length of the arcs (periods)",
        ylabel="stiffness k",
        title="3. longer arcs: smaller errors",
    )
    third.legend()
    return figure


# 4. Brackets.


def brackets() -> Figure:
    """Draw a rigid body: states on a sphere, and what two integrators do to it."""
    inertia = np.array([1.0, 2.0, 3.0])

    def field(m: np.ndarray) -> np.ndarray:
        w = m / inertia
        return np.array(
            [m[1] * w[2] - m[2] * w[1], m[2] * w[0] - m[0] * w[2], m[0] * w[1] - m[1] * w[0]]
        )

    def midpoint(m: np.ndarray, h: float) -> np.ndarray:
        image = m + h * field(m)
        for _ in range(30):
            image = m + h * field(0.5 * (m + image))
        return image

    def runge_kutta(m: np.ndarray, h: float) -> np.ndarray:
        a = field(m)
        b = field(m + h / 2 * a)
        c = field(m + h / 2 * b)
        return m + h / 6 * (a + 2 * b + 2 * c + field(m + h * c))

    figure = Figure(figsize=(1.6 * WIDTH, 1.1 * HEIGHT))
    ball = figure.add_subplot(1, 2, 1, projection="3d")
    drift = figure.add_subplot(1, 2, 2)
    u, v = np.meshgrid(np.linspace(0, 2 * np.pi, 40), np.linspace(0, np.pi, 20))
    sphere = np.cos(u) * np.sin(v), np.sin(u) * np.sin(v), np.cos(v)
    ball.plot_surface(*sphere, color="0.9", alpha=0.35, linewidth=0)  # pyright: ignore[reportAttributeAccessIssue]
    starts = [(a, 0.0, s * np.sqrt(1 - a**2)) for a in (0.25, 0.5, 0.75) for s in (1, -1)]
    starts += [(s * np.sqrt(1 - a**2), 0.0, a) for a in (0.25, 0.5) for s in (1, -1)]
    for place, start in enumerate(starts):
        orbit = _rolled(lambda m: midpoint(m, 0.1), np.array(start), 260)
        ball.plot(
            *orbit.T, lw=0.9, color=BLUE, label="orbits: H is constant" if not place else None
        )
    ball.set(xlabel="m₁", ylabel="m₂", zlabel="m₃", title="ṁ = m × ∇H: on the sphere |m|² = C")
    ball.set_box_aspect((1, 1, 1))  # pyright: ignore[reportArgumentType]
    ball.legend(loc="upper left")
    count, h = 5_000, 0.3
    for name, advance, colour in (
        ("fourth-order Runge–Kutta", runge_kutta, RED),
        ("a step that keeps the bracket", midpoint, BLUE),
    ):
        states = _rolled(
            lambda m, advance=advance: advance(m, h), np.array([0.6, 0.2, 0.77]), count
        )
        off = np.abs(np.sum(states**2, axis=1) / np.sum(states[0] ** 2) - 1)
        n = np.unique(np.geomspace(1, count, 200).astype(int))
        drift.loglog(n, np.maximum(np.maximum.accumulate(off)[n], 1e-17), color=colour, label=name)
    drift.axhline(2.2e-16, color="black", ls=":", lw=1, label="roundoff")
    drift.set(xlabel="step n", ylabel="relative change of the Casimir |m|²")
    drift.set_title("Casimirs are kept, whatever H was learned")
    drift.legend(loc="center right")
    return figure


# 5. What a certificate says.


def certificate() -> Figure:
    """Draw errors of forecasts of held-out data, and two bands about them."""
    rng = np.random.default_rng(5)
    t = np.linspace(0.0, 8.0, 161)

    def errors(count: int) -> np.ndarray:  # of phase, that grows, and of the state at the start
        phase, amplitude, begin = rng.standard_normal((3, count, 1))
        swing = 2 * np.pi * t
        noise = 0.05 * rng.standard_normal((count, len(t)))
        return (
            0.25 * t * phase * np.cos(swing)
            + 0.5 * amplitude * np.sin(swing)
            + 0.5 * begin * np.cos(swing)
            + noise
        )

    held_out, new = errors(300), errors(400)
    sigma = held_out.std(axis=0)
    largest = np.sort(np.max(np.abs(held_out) / sigma, axis=1))
    factor = largest[int(np.ceil(0.95 * (len(largest) + 1))) - 1]
    figure, axes = panels(2, sharey=True)
    for ax, width, what in (
        (axes[0], 2.0, "± 2 σ at each time"),
        (axes[1], factor, "95 % of whole trajectories"),
    ):
        inside = np.abs(new) < width * sigma
        whole = inside.all(axis=1)
        for one, held in zip(new[:20], whole[:20], strict=True):
            ax.plot(t, one, lw=0.7, color="0.45" if held else RED)
        ax.fill_between(t, -width * sigma, width * sigma, color=BLUE, alpha=0.25, label=what)
        ax.plot([], [], color=RED, lw=0.8, label="leaves the band at some time")
        ax.set(xlabel="time ahead", xlim=(0, 8))
        of_samples, of_all = 100 * inside.mean(), 100 * whole.mean()
        ax.set_title(f"{of_samples:.0f} % of samples, {of_all:.0f} % of trajectories inside")
        ax.legend(loc="lower left")
    axes[0].set_ylabel("error of forecasts of new data")
    return figure


def main() -> None:
    """Draw all five."""
    for draw in (chart, symplectic, arcs, brackets, certificate):
        with style():
            save(draw(), FIGURES / f"idea_{draw.__name__}.png", dpi=130)
        print(FIGURES / f"idea_{draw.__name__}.png")


if __name__ == "__main__":
    main()
