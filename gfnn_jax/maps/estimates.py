"""A map and its sensors: states estimated from a recording, and forecasts with bands.

The samples before a time are fitted by one arc of the law, its first state unknown: that gives the
state there with its covariance, and where zeros of channels wander, these too. A forecast is the
orbit from it, on zeros that go back to their mean. Its band holds the error of that state, of the
law's coefficients, the noise of a sample, and the law's own misfit, as forecasts of data that it
was not learned from have shown it. Where friction is stronger at one time than at another, by its
temperature or load, its level, all of it times 1 + λ, is one more unknown of each window.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from gfnn_jax.data.recording import Recording, args_of, channels_of
from gfnn_jax.data.roles import is_wave, wave
from gfnn_jax.errors import InputError
from gfnn_jax.families.friction import UNIFORM, Friction
from gfnn_jax.families.lagrangian import Lagrangian, functions_of
from gfnn_jax.flows.motion import Form
from gfnn_jax.flows.schedules import TAPS, at_stages
from gfnn_jax.maps.laws import law_of_map
from gfnn_jax.maps.parameters import Parameters
from gfnn_jax.maps.sensors import TUBE, Sensors
from gfnn_jax.signals.local_polynomials import smooth
from gfnn_jax.signals.splines import splines
from gfnn_jax.solve.latent_arcs import Defects, Fitted, Observed, Readings
from gfnn_jax.solve.linear import covariance_root

FEWEST = 5  # samples from which a state is estimated


class _Options:
    """Windows, and the steps in which their states are followed."""

    most: int = 160  # samples of a window that are used
    fine: float = 0.16  # radians of the fastest motion in a step
    small: float = 2e-3  # radians of the fastest motion, over which velocities are differenced
    few: int = 4  # steps between inputs, of which those in between are filled in
    at_once: int = 4_096  # steps whose derivatives are taken together
    settled: float = 1e-3  # of the cost, at 2 % of a standard deviation of the state
    draws: int = 400  # of errors of a trajectory, whose largest multiple of a band is looked for


class Window(NamedTuple):
    """Samples of one run before a time: t (n,), channels y (n, k), that run's inputs, the noise
    (n, k) of each value in units of its channel's, None where it is the same of all, and the
    parameters (k,) of the run's system."""

    t: np.ndarray
    y: np.ndarray
    inputs_t: np.ndarray
    inputs: np.ndarray
    noise: np.ndarray | None = None
    args: np.ndarray | None = None


class Law(NamedTuple):
    """A law in use: its form with all coefficients given, a root of their covariance (rootᵀ root),
    and its sensors. Where its coefficients depend on parameters, `at` is that of one system."""

    form: Form
    p: np.ndarray
    root: np.ndarray
    sensors: Sensors

    @property
    def friction(self) -> np.ndarray:
        """p (n,) of friction, 0 elsewhere: what a level multiplies."""
        first, own = self.form.basis.shape[1], np.zeros_like(self.p)
        losses = slice(first, first + self.form.friction.count)
        own[losses] = self.p[losses]
        return own

    def at(self, args: np.ndarray | None) -> Law:
        """The law of the system with these parameters (k,)."""
        if self.form.powers is None:
            return self
        if args is None:
            raise ValueError("expected the parameters of the system: the law depends on them")
        weights = functions_of(self.form.powers, args)
        form = dataclasses.replace(self.form, powers=None)
        return Law(form, weights * self.p, weights * self.root, self.sensors)


def of_windows(
    laws: Sequence[Law], which: np.ndarray, windows: Sequence[Window]
) -> tuple[Sequence[Law], np.ndarray]:
    """The laws of the windows' systems, and which of them (B,) each window follows, of laws that
    may depend on parameters and ``which`` (B,) of these."""
    if laws[0].form.powers is None:
        return laws, which
    keys = [
        (int(k), *np.asarray(window.args).tolist())
        for k, window in zip(which, windows, strict=True)
    ]
    unique = list(dict.fromkeys(keys))
    found = [laws[k].at(np.array(args)) for k, *args in unique]
    return found, np.array([unique.index(key) for key in keys])


def law_in_use(law: Lagrangian, root: np.ndarray | None, sensors: Sensors) -> Law:
    """Prepare a Lagrangian and the root (m, n) of the covariance of (θ, ρ, G), and of γ where there
    is uniform friction. Dry friction that creeps by less than the sensors see slides or sticks."""
    count, losses = law.terms.count, law.losses
    sharp = law.friction.dry & (law.friction.widths <= sensors.creep)
    widths = np.where(sharp, 0.0, law.friction.widths)
    rows = dataclasses.replace(law.friction, widths=widths).rows()
    order = np.arange(count + law.friction.count + law.gains.size)
    if law.uniform != 0:  # γ, the last of all, stands behind ρ in a form
        rows, losses = [*rows, ((0,) * law.dim, UNIFORM, 0.0)], np.append(losses, law.uniform)
        order = np.insert(order, count + law.friction.count, len(order))
    friction = Friction.of(rows, law.dim)
    powers = law.powers
    if powers is not None and law.uniform != 0:  # γ is one number for all systems
        last = count + law.friction.count
        powers = (*powers[:last], (0,) * len(powers[0]), *powers[last:])
    form = Form(law.terms, np.zeros(count), np.eye(count), friction, law.num_inputs, powers)
    p = np.concatenate([law.coefficients, losses, np.ravel(law.gains)])
    known = np.zeros((0, len(p))) if root is None else np.asarray(root)[:, order]
    return Law(form, p, known, sensors)


def law_of(map_: Any) -> Law:
    """Law of a map that was learned from a recording; a map keeps it as `law_in_use`."""
    law = jax.tree.map(np.asarray, law_of_map(map_))
    root = None if map_.posterior is None else map_.posterior.root
    return law_in_use(law, root, map_.sensors)


def estimate(map_: Any, recording: Recording) -> tuple[np.ndarray, np.ndarray]:
    """Implement `maps.forecasts.estimate` for the map of a law."""
    law = map_.law_in_use
    windows = windows_of(law.sensors, recording, map_.parameters)
    d = law.form.dim
    x, covariance = estimates_of([law], np.zeros(len(windows), int), windows)
    x, covariance = x[:, : 2 * d], covariance[:, : 2 * d, : 2 * d]
    lagrangian = law.form.lagrangian(law.p)
    if lagrangian.powers is not None:
        lagrangian = lagrangian.at(np.stack([np.asarray(window.args) for window in windows]))
    found = lagrangian.derivatives(x[:, :d], x[:, d:])
    z = np.concatenate([x[:, :d], found.by_v], axis=1)
    turn = np.zeros_like(covariance)
    turn[:, :d, :d] = np.eye(d)
    turn[:, d:, :d], turn[:, d:, d:] = found.by_vq, found.by_vv
    return z, turn @ covariance @ turn.swapaxes(1, 2)


def forecast(
    map_: Any,
    recording: Recording,
    times: np.ndarray,
    inputs: Recording | None = None,
    coverage: float | None = None,
    whole: float | None = None,
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray], tuple[str, ...], np.ndarray]:
    """Implement `maps.forecasts.forecast` for the map of a law: values, std, outside, and how many
    standard deviations (runs,) hold whole trajectories with the probability ``whole``. Where it
    or a coverage is asked for, std holds rivals too."""
    law = map_.law_in_use
    sensors = law.sensors
    windows = windows_of(sensors, recording, map_.parameters)
    last = np.array([np.max(w.t) for w in windows])
    if not np.all(times[0] >= last):
        raise InputError(
            f"expected rising times, none before the latest end of a run ({last.max():g} s), got "
            f"{times[0]:g} s"
        )
    if sensors.inputs and inputs is None and all(map(is_wave, sensors.inputs)):
        windows = [_with_waves(window, sensors, float(times[-1])) for window in windows]
    elif sensors.inputs and inputs is None:
        raise InputError(
            f"the law has inputs ({', '.join(sensors.inputs)}): give them for the times of the "
            "forecast, --inputs FILE"
        )
    if inputs is not None and sensors.inputs:
        windows = [
            _with_inputs(window, inputs, sensors, run)
            for window, run in zip(windows, recording.runs, strict=True)
        ]
        for window, run in zip(windows, recording.runs, strict=True):
            _check_inputs(window.inputs_t, float(np.max(window.t)), float(times[-1]), run)
    laws, which = of_windows([law], np.zeros(len(windows), int), windows)
    x, covariance = estimates_of(laws, which, windows)
    ahead = np.broadcast_to(times, (len(windows), len(times)))
    orbits = propagate(laws, which, windows, x, covariance, last, ahead)
    if coverage is not None or whole is not None:
        orbits = _with_rivals(sensors, orbits, windows, last, ahead)
    names = sensors.observation_model.channels
    values = {n: orbits.values[..., k] for k, n in enumerate(names)}
    std = {n: orbits.std[..., k] for k, n in enumerate(names)}
    for i, n in enumerate(sensors.positions):
        if n not in values:
            values[n] = orbits.states[..., i]
            std[n] = np.sqrt(orbits.covariances[..., i, i])
    outside = _outside(map_.parameters, recording, windows)
    beyond = _beyond(map_, [laws[k] for k in which], recording, times, orbits.states)
    tubes = np.full(len(windows), np.nan)
    if whole is not None:
        far = times[-1] - last
        wider = np.array([sensors.widening(seconds, whole) for seconds in far])
        # That readings of a record err by less than its law says is no promise of others.
        of_law, held_out = (orbits.largest(one, ahead)[:, -1] for one in (whole, TUBE))
        tubes = np.maximum(of_law, wider * held_out)
        beyond += _uncertified(sensors, recording, far)
    return values, std, outside + beyond, tubes


def _with_rivals(
    sensors: Sensors, orbits: Orbits, windows: Sequence[Window], last: np.ndarray, ahead: np.ndarray
) -> Orbits:
    """The orbits with the second moments, about them, of the forecasts of all laws that the data
    allow; of one that leaves for far away as of one that does not part from them."""
    which = np.zeros(len(windows), int)
    for other, share in sensors.rivals:
        laws = [law_in_use(other, None, sensors)]
        theirs = propagate(laws, which, windows, *estimates_of(laws, which, windows), last, ahead)
        apart = theirs.values - orbits.values
        own = np.sqrt(share) * np.where(np.isfinite(apart), apart, 0.0)[..., None]
        orbits = orbits._replace(modes=np.concatenate([orbits.modes, own], axis=-1))
    return orbits


def _uncertified(sensors: Sensors, recording: Recording, ahead: np.ndarray) -> tuple[str, ...]:
    """Lines about runs that are forecast farther than held-out forecasts went, (runs,) seconds."""
    if not sensors.held_out:
        return ("no forecast could be held out: the band over all times is the law's own",)
    most = sensors.leads[sensors.held_out - 1]
    return tuple(
        f"run {run}: no held-out forecast went farther than {most:.3g} s: the band over "
        f"{seconds:.3g} s is extrapolated"
        for run, seconds in zip(recording.runs, ahead, strict=True)
        if seconds > 1.01 * most
    )


def _beyond(
    map_: Any, laws: Sequence[Law], recording: Recording, times: np.ndarray, states: np.ndarray
) -> tuple[str, ...]:
    """A line for each run whose forecast (q, v), of the states (runs, n, 2d), leaves the domain."""
    lines, d, angles = [], states.shape[-1] // 2, list(map_.coordinates.angles)
    for run, law, x in zip(recording.runs, laws, states, strict=True):
        momenta = law.form.lagrangian(law.p).momentum(x[:, :d], x[:, d:])
        z = np.concatenate([x[:, :d], momenta], axis=1)
        turns = np.round((z[:, angles] - np.asarray(map_.angle_centre)) / (2 * np.pi))
        z[:, angles] -= 2 * np.pi * turns
        left = ~np.asarray(map_.domain.contains(z))
        if np.any(left):
            lines.append(
                f"run {run}: {np.mean(left):.0%} of the forecast, first at t = "
                f"{times[np.argmax(left)]:g} s, lies beyond the motion that the law was learned "
                "from: errors there may be larger than the bands say"
            )
    return tuple(lines)


def _outside(
    parameters: Parameters | None, recording: Recording, windows: Sequence[Window]
) -> tuple[str, ...]:
    """A line for each parameter of a run that lies beyond those that the law was learned from."""
    if parameters is None:
        return ()
    low, high = (np.asarray(end) for end in (parameters.low, parameters.high))
    least, most = (np.asarray(bound) for bound in parameters.bounds)
    return tuple(
        f"run {run}: {name} = {value:g} is outside {low[k]:g} to {high[k]:g}, which the law was "
        "learned from"
        for run, window in zip(recording.runs, windows, strict=True)
        for k, (name, value) in enumerate(
            zip(parameters.names, np.asarray(window.args), strict=True)
        )
        if not least[k] <= value <= most[k]
    )


def windows_of(
    sensors: Sensors, recording: Recording, parameters: Parameters | None = None
) -> list[Window]:
    """The last samples of each run. Raises InputError where a column is missing or they are few."""
    channels = sensors.observation_model.channels
    varied = () if parameters is None else parameters.names
    needed = (*sensors.observation_model.needed, *sensors.inputs, *varied)
    missing = [n for n in needed if n not in recording.columns and not is_wave(n)]
    if missing:
        raise InputError(
            f"{recording.source}: has no columns {', '.join(missing)}, which the law was learned "
            "from"
        )
    windows = []
    for run in recording.runs:
        t = recording.times(run)
        y, noise = channels_of(recording, channels, run)
        u = [recording.values(n, run) for n in sensors.inputs]
        u = np.stack(u, axis=1) if u else np.zeros((len(t), 0))
        known = np.isfinite(u).all(axis=1)
        q = sensors.coordinates_of(y, t)
        finite = np.isfinite(q).any(axis=1)
        if np.min(np.isfinite(q).sum(axis=0)) < FEWEST:
            raise InputError(
                f"{recording.source}: run {run}: expected at least {FEWEST} samples to estimate "
                f"the state from, got {np.min(np.isfinite(q).sum(axis=0))}"
            )
        times, places, noise = t[finite], y[finite], noise[finite]
        latest = [t[np.isfinite(column)][-FEWEST] for column in q.T]
        recent = times >= min(latest)
        recent |= times >= times.max() - sensors.window
        args = None if parameters is None else args_of(recording, run, varied)
        window = Window(times[recent], places[recent], t[known], u[known], noise[recent], args)
        windows.append(thinned(window))
    return windows


def thinned(window: Window) -> Window:
    """The window with every so many of its samples, counted from the last one, of each set of
    channels that are read together: more tell no more."""
    every = -(-len(window.t) // _Options.most)
    if every == 1:
        return window
    which = np.unique(np.isfinite(window.y), axis=0, return_inverse=True)[1].ravel()
    kept = [np.flatnonzero(which == k)[::-every] for k in range(which.max() + 1)]
    keep = np.sort(np.concatenate(kept))
    noise = None if window.noise is None else window.noise[keep]
    return window._replace(t=window.t[keep], y=window.y[keep], noise=noise)


def _with_inputs(window: Window, inputs: Recording, sensors: Sensors, run: str) -> Window:
    """The window with inputs behind its own."""
    run = run if len(inputs.runs) > 1 else next(iter(inputs.runs))
    t = inputs.times(run)
    u = np.stack([inputs.values(n, run) for n in sensors.inputs], axis=1)
    later = (t > np.max(window.inputs_t, initial=-np.inf)) & np.isfinite(u).all(axis=1)
    return window._replace(
        inputs_t=np.concatenate([window.inputs_t, t[later]]),
        inputs=np.concatenate([window.inputs, u[later]]),
    )


def _with_waves(window: Window, sensors: Sensors, end: float) -> Window:
    """The window with inputs that are functions of time as far as a forecast needs them."""
    t, step = window.inputs_t, float(np.median(np.diff(window.inputs_t)))
    later = t[-1] + step * np.arange(1, TAPS + 2 + max(0, int((end - t[-1]) / step)))
    u = np.array([wave(name, later) for name in sensors.inputs], float).T
    return window._replace(
        inputs_t=np.concatenate([t, later]), inputs=np.concatenate([window.inputs, u])
    )


def _check_inputs(t: np.ndarray, begin: float, end: float, run: str) -> None:
    """Raises InputError where inputs at times t leave out part of begin … end. The last holds for a
    step, and a few between others may be missing."""
    inside = t[(t > begin) & (t < end)]
    usual = np.median(np.diff(inside if len(inside) > 1 else t))
    ahead = np.concatenate([[begin], inside, [end]])
    steps = np.diff(ahead) / usual
    lacks = steps > np.append(np.full(len(steps) - 1, _Options.few), 1) + 0.5
    if lacks.any():
        gap = int(np.argmax(lacks))
        raise InputError(
            f"run {run}: the forecast needs inputs from {begin:g} to {end:g} s, and there are none "
            f"from {ahead[gap]:g} to {ahead[gap + 1]:g} s: --inputs FILE"
        )


@dataclasses.dataclass(frozen=True, eq=False)
class _Windows:
    """Windows of equal length as arcs whose laws, ``laws[which]``, are known: what `Readings.fit`
    asks for. States (q, v), and the level of friction behind them where sensors have one."""

    laws: Sequence[Law]
    which: np.ndarray
    h: np.ndarray
    u: np.ndarray

    def defects(self, p: np.ndarray, x: np.ndarray) -> Defects:
        arcs, length, m = x.shape
        num, d = arcs * (length - 1), 2 * self.laws[0].form.dim
        u = self.u.reshape(num, *self.u.shape[2:])
        start = x[:, :-1].reshape(num, m)
        start, level = start[:, :d], start[:, d:]
        order, which = 1 + level.shape[1], np.repeat(self.which, length - 1)
        form, p, friction = _side_by_side(self.laws, which, level)
        step = form.step(p, start, self.h.reshape(num), u, order=order)
        ends = np.concatenate([step.states, level], axis=1)
        by = np.zeros((num, m, m))
        by[:, :d, :d] = step.by_state
        if order > 1:
            by[:, :d, d:] = step.by_coefficients @ friction[..., None]
            by[:, d, d] = 1.0
        shape = (arcs, length - 1, m)
        closing = ends.reshape(shape) - x[:, 1:]
        return Defects(closing, by.reshape(*shape, m), np.zeros((*shape, 0)))

    def observe(self, p: np.ndarray, x: np.ndarray) -> Observed:
        u = np.concatenate([self.u[:, :, 0, 0], self.u[:, -1:, -1, -1]], axis=1)
        d = 2 * self.laws[0].form.dim
        x, level = x[..., :d], x[..., d:]
        shown = _channels(self.laws, self.which, x, u)
        shown = shown._replace(by_coefficients=shown.by_coefficients[..., :0])
        if not level.shape[2]:
            return shown
        by = np.pad(shown.by_state, ((0, 0), (0, 0), (0, 1), (0, 1)))
        by[..., -1, -1] = 1.0  # the level is read as what is expected of it
        none = np.pad(shown.by_coefficients, ((0, 0), (0, 0), (0, 1), (0, 0)))
        return Observed(np.concatenate([shown.values, level], axis=2), by, none)

    def take(self, arcs: np.ndarray) -> _Windows:
        return dataclasses.replace(self, which=self.which[arcs], h=self.h[arcs], u=self.u[arcs])


def estimates_of(
    laws: Sequence[Law], which: np.ndarray, windows: Sequence[Window]
) -> tuple[np.ndarray, np.ndarray]:
    """(q, v, λ, b) (B, m) at the last sample of each window, and its covariance (B, m, m) in its
    law, ``laws[which]``, which (B,): λ (1,) the level of friction where the sensors have one, b
    (k,) the zeros of the channels where these wander, each of length 0 where not. The laws differ
    as those of `propagate`.

    Raises InputError where times of events alone are read, of which no state is estimated yet.
    """
    laws, which = of_windows(laws, which, windows)
    sensors = laws[0].sensors
    if sensors.observation_model.crossed:
        raise InputError(
            "times of events alone: no state is estimated from them. The law is fit.law; start "
            "from a state that you know, fit.predict(z0, num_steps)"
        )
    started = (_started(laws[k].sensors, w) for k, w in zip(which, windows, strict=True))
    windows, starts = zip(*started, strict=True)
    length = max(len(w.t) for w in windows)
    count = windows[0].y.shape[1]
    t, y, x, noise = [], [], [], []
    for w, own in zip(windows, starts, strict=True):
        pad = length - len(w.t)  # before the window: steps of no time, nothing seen
        t.append(np.concatenate([np.full(pad, w.t[0]), w.t]))
        y.append(np.concatenate([np.full((pad, count), np.nan), w.y]))
        own_noise = np.ones(w.y.shape) if w.noise is None else w.noise
        noise.append(np.concatenate([np.ones((pad, count)), own_noise]))
        x.append(np.concatenate([np.repeat(own[:1], pad, axis=0), own]))
    t, y, x, noise = map(np.array, (t, y, x, noise))
    longest = np.max(np.diff(t, axis=1), initial=0.0)
    u = _inputs(sensors, windows, t, int(substeps_of(sensors, longest)))
    arcs = _Windows(laws, which, np.diff(t, axis=1), u)
    sigma = sensors.observation_model.state_sigma(x[:, -1], sensors.sigma, sensors.omega)
    scale = np.concatenate([sigma, sigma * sensors.omega])
    sigma, loss, wander = sensors.sigma * noise, sensors.observation_model.loss, sensors.wander
    noise_of_readings = np.where(np.isfinite(y), noise, np.inf)
    white = None if wander is None else wander.whitening(t, noise_of_readings)
    if sensors.level:
        known = np.full((*t.shape, 1), np.nan)
        known[:, -1] = 0.0
        y, x = np.concatenate([y, known], axis=2), np.pad(x, ((0, 0), (0, 0), (0, 1)))
        sigma = np.concatenate([sigma, np.full(known.shape, sensors.level)], axis=2)
        scale = np.append(scale, sensors.level)
        if white is not None:
            unit = np.broadcast_to(np.eye(t.shape[1]), (len(t), 1, t.shape[1], t.shape[1]))
            white = np.concatenate([white, unit], axis=1)
    readings = Readings(arcs, y, sigma, loss, white)
    found = readings.fit(np.zeros(0), x, scale, tolerance=_Options.settled)
    if wander is None or white is None:
        return found.x[:, -1], found.last_covariance()
    near = np.zeros(y.shape)
    near[..., :count] = wander.latest(t, noise_of_readings)
    near = white @ near.swapaxes(1, 2)[..., None]
    weights = np.sqrt(np.nan_to_num(loss.weights(found.whitened)))
    near = weights * near[..., 0].swapaxes(1, 2)
    return _with_zeros(found, near, wander.size**2, sensors.sigma)


def _with_zeros(
    found: Fitted, near: np.ndarray, variance: float, sigma: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Last states (B, m) with the zeros that the same samples tell, and the covariance of both.

    near: (B, L, K) covariance of the rows' values with the zeros, those of the k channels first.
    variance: of the zeros, in units of σ². Of c = ``near``, rows J for the first state and r of the
    residuals, and P = (JᵀJ)⁻¹: the zeros are cᵀr, their covariance is that of no samples less
    cᵀc − cᵀJ P Jᵀc, and with the first state −P Jᵀc. Where derivatives overflow it is 1e100 of
    each, as `Fitted.last_covariance` has it.
    """
    (lanes, length, rows), k = near.shape, len(sigma)
    c = (near[..., None] * np.eye(rows)).reshape(lanes, length * rows, rows)[..., :k]
    known = np.isfinite(found.rows.sum(axis=(1, 2)) + found.transports.sum(axis=(1, 2)))
    finite = known[:, None, None]
    J, r = np.split(np.where(finite, found.rows, 0.0), [-1], axis=-1)
    Q, R = np.linalg.qr(J)
    root = np.where(finite, found.transports, 0.0) @ np.linalg.pinv(R)
    own = Q.swapaxes(1, 2) @ c
    across = -root @ own * sigma
    open_ = variance * np.eye(k) - c.swapaxes(1, 2) @ c + own.swapaxes(1, 2) @ own
    covariance = np.block(
        [
            [root @ root.swapaxes(1, 2), across],
            [across.swapaxes(1, 2), sigma[:, None] * open_ * sigma],
        ]
    )
    covariance[~known] = 1e100 * np.eye(covariance.shape[1])
    zeros = (c.swapaxes(1, 2) @ r)[..., 0] * sigma
    return np.concatenate([found.x[:, -1], zeros], axis=1), covariance


def _started(sensors: Sensors, window: Window) -> tuple[Window, np.ndarray]:
    """The window with places between samples that are farther apart than most, where nothing was
    seen, and the states (n, 2d) of local cubics: one long step would make all of them shorter."""
    t, own = window.t, sensors.coordinates_of(window.y, window.t)
    if np.isfinite(own).all():
        near = max(3, int(np.pi / 3 / sensors.omega / np.median(np.diff(t))))  # a sixth of a period
        start = smooth(t, own, min(len(t), near))[0]
    else:
        start = splines([(t, own)]).smooth(t, own, t)
    x = np.concatenate([start.q, start.v], axis=1)
    steps = np.diff(t)
    parts = np.ceil(steps / max(np.median(steps), _Options.fine / sensors.omega) - 1e-3).astype(int)
    measured = np.concatenate([[0], np.cumsum(parts)])
    if measured[-1] == len(parts):
        return window, x
    every = np.arange(measured[-1] + 1)
    times = np.interp(every, measured, t)
    y, noise = np.full((len(every), window.y.shape[1]), np.nan), None
    y[measured] = window.y
    if window.noise is not None:
        noise = np.ones(y.shape)
        noise[measured] = window.noise
    x = np.stack([np.interp(times, t, column) for column in x.T], axis=1)
    return window._replace(t=times, y=y, noise=noise), x


class Orbits(NamedTuple):
    """Channels (B, n, k) at the times asked, the states (B, n, 2d), these states' covariances in
    the law (B, n, 2d, 2d), and what the channels' errors are made of: ``modes`` (B, n, k, r), each
    with one random number for all times of a lane, and ``noise`` (k,) of each reading by itself."""

    values: np.ndarray
    states: np.ndarray
    covariances: np.ndarray
    modes: np.ndarray
    noise: np.ndarray

    @property
    def std(self) -> np.ndarray:
        """Standard deviations (B, n, k) of the channels."""
        return np.sqrt(np.sum(self.modes**2, axis=-1) + self.noise**2)

    def with_error(self, size: np.ndarray) -> Orbits:
        """Add an error of this standard deviation (B, n, k), one random number a channel."""
        own = size[..., None] * np.eye(size.shape[-1])
        return self._replace(modes=np.concatenate([self.modes, own], axis=-1))

    def with_misfit(self, sensors: Sensors, misfit: np.ndarray, size: np.ndarray) -> Orbits:
        """Add a misfit (B, n, k) of the law, in the sensors' units, of motions of size (B,)."""
        if sensors.of_law:
            return self._replace(modes=misfit[..., None] * self.modes)
        return self.with_error(misfit * size[:, None, None])

    def largest(self, coverage: float, at: np.ndarray) -> np.ndarray:
        """Multiples (B, n) of the standard deviations that no channel exceeds from the first time
        until each, with the probability ``coverage``, were all errors Gaussian. at: (B, n) the
        times; where two are the same they show one reading."""
        lanes, times, count, rank = self.modes.shape
        rng, found = np.random.default_rng(0), np.empty((lanes, times))
        for lane, (modes, std, t) in enumerate(zip(self.modes, self.std, at, strict=True)):
            drawn = modes @ rng.normal(size=(rank, _Options.draws))
            readings, which = np.unique(t, return_inverse=True)
            noise = rng.normal(size=(len(readings), count, _Options.draws))
            drawn += self.noise[:, None] * noise[which]
            largest = np.max(np.abs(drawn) / std[..., None], axis=1)
            running = np.maximum.accumulate(largest, axis=0)
            found[lane] = np.quantile(running, coverage, axis=1)
        return found


def propagate(
    laws: Sequence[Law],
    which: np.ndarray,
    windows: Sequence[Window],
    x: np.ndarray,
    covariance: np.ndarray,
    last: np.ndarray,
    times: np.ndarray,
) -> Orbits:
    """Orbits from what `estimates_of` found, x (B, m) with its covariance, at times ``last``
    (B,), to times (B, n); each lane follows its own law, ``laws[which]``, which (B,).

    The laws differ in coefficients, phases, covariance and the parameters of their channels only;
    all else of the sensors is that of the first.
    """
    d, sensors = laws[0].form.dim, laws[0].sensors
    x, level, zeros = np.split(x, [2 * d, 2 * d + bool(sensors.level)], axis=1)
    size = sensors.size_of(x)
    root = covariance_root(covariance).swapaxes(1, 2)
    ends, asked = _in_steps(sensors, np.concatenate([last[:, None], times], axis=1))
    u = _inputs(sensors, windows, ends, 1)
    x, own = np.concatenate([x, level], axis=1), 2 * d + level.shape[1]
    orbit, spread = _followed(laws, which, x, root[:, :own], np.diff(ends, axis=1), u, asked)
    orbit = orbit[:, asked]
    at = np.concatenate([u[:, :, 0, 0], u[:, -1:, -1, -1]], axis=1)[:, asked]
    channels, ahead = _channels(laws, which, orbit, at), times - last[:, None]
    values, modes = channels.values, channels.by_state @ spread
    if sensors.wander is not None:
        left = np.exp(-ahead / sensors.wander.time)[..., None]
        values = values + left * zeros[:, None]
        modes[..., : root.shape[-1]] += left[..., None] * root[:, None, own:]
    orbits = Orbits(values, orbit, spread @ spread.swapaxes(2, 3), modes, sensors.sigma)
    if sensors.wander is not None:
        orbits = orbits.with_error(sensors.wander.size * np.sqrt(1 - left**2) * sensors.sigma)
    return orbits.with_misfit(sensors, sensors.misfit_at(ahead), size)


def _followed(
    laws: Sequence[Law],
    which: np.ndarray,
    x: np.ndarray,
    root: np.ndarray,
    h: np.ndarray,
    u: np.ndarray,
    asked: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Orbits (B, M + 1, 2d) of the laws from states x (B, 2d), and levels of friction behind them,
    whose covariance is root rootᵀ, by steps h (B, M) with inputs u; and the roots (B, n, 2d, ·) of
    the covariances after the steps that are ``asked`` (n,), with that of the coefficients."""
    d = 2 * laws[0].form.dim
    x, level = x[:, :d], x[:, d:]
    form, p, friction = _side_by_side(laws, which, level)
    roots = np.zeros((len(laws), max(len(law.root) for law in laws), laws[0].root.shape[1]))
    for padded, law in zip(roots, laws, strict=True):
        padded[: len(law.root)] = law.root
    roots = roots[which]
    size, count, modes = root.shape[-1], roots.shape[-1], None
    root, of_level = root[:, :d], root[:, d:]
    spread = np.concatenate([root, np.zeros((*x.shape, roots.shape[1]))], axis=2)
    orbit, spreads, most = [x[:, None]], [], max(1, _Options.at_once // len(x))
    for first in range(0, h.shape[1], most):
        some = slice(first, first + most)
        step = form.follow(p, x, h[:, some], u[:, some], modes=modes)
        orbit.append(step.states)
        x, modes = step.states[:, -1], step.modes[:, -1]
        further = step.by_coefficients[..., :count] @ roots[:, None].swapaxes(2, 3)
        ends = np.zeros((1 + further.shape[1], *spread.shape))
        ends[0], ends[1:, ..., size:] = spread, further.swapaxes(0, 1)
        if level.size:
            push = step.by_coefficients[..., :count] @ friction[:, None, :, None]
            ends[1:, ..., :size] = (push @ of_level[:, None]).swapaxes(0, 1)
        for by, here, there in zip(step.by_state.swapaxes(0, 1), ends[:-1], ends[1:], strict=True):
            there += by @ here
        spread = ends[-1]
        spreads.append(ends[asked[(asked > first) & (asked < first + len(ends))] - first])
    return np.concatenate(orbit, axis=1), np.concatenate(spreads).swapaxes(0, 1)


def _side_by_side(
    laws: Sequence[Law], which: np.ndarray, level: np.ndarray
) -> tuple[Form, np.ndarray, np.ndarray]:
    """The form and coefficients of lanes that follow ``laws[which]``, (n,) of one law, of several,
    or with a level (B, 1), those of each lane (B, n), with its phases; and what levels multiply."""
    form, p = laws[0].form, laws[0].p
    if len(laws) > 1:
        form = form.with_phases(np.stack([law.form.terms.phases for law in laws])[which])
        p = np.stack([law.p for law in laws])[which]
    if not level.size:
        return form, p, p
    friction = np.stack([law.friction for law in laws])[which]
    return form, p + level * friction, friction


def _in_steps(sensors: Sensors, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Times (B, n) with those between them that Runge–Kutta steps need, and the places of all but
    the first."""
    steps = np.diff(times, axis=1)
    parts = substeps_of(sensors, np.max(steps, axis=0, initial=0.0))
    ends = np.cumsum(parts)
    begun = np.repeat(np.arange(len(parts)), parts)
    within = np.arange(len(begun)) - (ends - parts)[begun]
    between = times[:, begun] + steps[:, begun] * within / parts[begun]
    return np.concatenate([between, times[:, -1:]], axis=1), ends


def _channels(laws: Sequence[Law], which: np.ndarray, x: np.ndarray, u: np.ndarray) -> Observed:
    """Channels of states x (B, n, 2d) that move by ``laws[which]`` under inputs u (B, n, k), each
    law with parameters of its own."""
    seen = laws[0].sensors.observation_model
    if not seen.accelerated:
        return seen(
            x, np.stack([law.sensors.observation_model.values for law in laws])[which, None]
        )
    found: list[Any] = [None] * len(x)
    for k in np.unique(which).tolist():
        own, law = np.flatnonzero(which == k), laws[k]
        values, h = law.sensors.observation_model.values, _Options.small / law.sensors.omega
        shown, _ = seen.along(law.form, law.p, x[own], u[own], h, values)
        for n, *parts in zip(own.tolist(), *shown, strict=True):
            found[n] = parts
    return Observed(*map(np.stack, zip(*found, strict=True)))


def substeps_of(sensors: Sensors, h: Any) -> Any:
    """Runge–Kutta steps that a step h (...) is made of."""
    return np.maximum(1, np.ceil(h * sensors.omega / _Options.fine).astype(int))


def _inputs(
    sensors: Sensors, windows: Sequence[Window], t: np.ndarray, substeps: int
) -> np.ndarray:
    """Inputs (B, L − 1, substeps, 6, k) of the steps between times t (B, L)."""
    hold, delay = sensors.hold, sensors.delay
    return np.stack(
        [
            at_stages(w.inputs_t, w.inputs, ends[:-1], ends[1:], substeps, hold, delay)
            for w, ends in zip(windows, t, strict=True)
        ]
    )
