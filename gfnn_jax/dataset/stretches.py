"""A recording as a fit of its law sees it: stretches of samples, thinned to nodes, cut into arcs.

A *stretch* is a part of one run without a gap, angles lifted. Its *nodes* are samples of it, some
forty to a period of the fastest motion, each with a state (q, v). An *arc* is a row of nodes. All
is NumPy, made once.

Where the sampling is even, a longer step is a gap, samples are complete, and local cubics give the
states. Where that would lose readings (times of a Poisson process, cells that are missing, runs of
a few samples) a sample is whatever was read at one time, *splines* that all runs share give the
states, nodes stand between samples that are far apart, and a gap is a quarter of a period without
a reading, in which the state is no longer predictable before there is a law.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from gfnn_jax.arrays import stretches_of
from gfnn_jax.data.recording import Recording, args_of, channels_of
from gfnn_jax.errors import FitError, InputError
from gfnn_jax.signals.local_polynomials import Smooth, choose_half, smooth
from gfnn_jax.signals.short_runs import noise_of_one_law
from gfnn_jax.signals.splines import FEWEST, Splines, splines, with_rates

GAP = 3.5  # median steps: a longer one ends a stretch, where sampling is even or inputs act
PER_PERIOD = 40  # nodes
MOST_STEPS = 6_000  # of a fit: more tell little more of its terms


class Options:
    """Options of stretches, nodes and arcs (benchmarks/random_recordings.py)."""

    step: float = 0.25  # radians of the fastest motion, of a Runge–Kutta step
    block: float = 8.0  # periods of a block, where only some blocks of a long recording are taken
    # samples of a stretch, nodes of an arc: shorter ones tell less than their state needs
    shortest: int = 9
    shortest_arc: int = 5
    slow: float = 0.1  # of the rms speed: less of it, in one of several systems, tells no frequency
    still: float = 1.5  # of the noise: the standard deviation up to which a coordinate stands still
    creeping: float = 0.05  # of a coordinate's standard deviation: what creeps varies by less
    kept: float = 0.25  # periods of a rest that stay, in which the body comes to a stop or starts
    even: float = 0.95  # of the readings, that even stretches have to hold
    alike: float = 1.5  # ratio of steps, from which on runs have an interval of their own
    enough: int = 100  # samples of an interval, that tell noise
    gap: float = 0.25  # periods without a reading, over which a state is not predictable yet
    apart: float = 0.7  # of the time between nodes, after which a channel is looked at again
    empty: float = 100.0  # median steps: no spline leads over a longer one
    exact: float = 1e-6  # of a channel's spread: noise that weighs a reading at the least


@dataclasses.dataclass(frozen=True, eq=False)
class Stretch:
    """Samples without a gap of ``run``: times t (n,), channels y (n, k), NaN where one was not
    seen, inputs u (n, inputs), the coordinates q (n, d) that the channels show, NaN where they do
    not, the ``noise`` (n, k) of each value in units of its channel's, and the parameters args (k,)
    of the system; whether all samples are complete and none is far from the next."""

    run: str
    t: np.ndarray
    y: np.ndarray
    u: np.ndarray
    q: np.ndarray
    noise: np.ndarray
    args: np.ndarray
    even: bool = True

    @property
    def step(self) -> float:
        """The usual time between samples."""
        return float(np.median(np.diff(self.t)))

    def part(self, a: int, b: int) -> Stretch:
        """Samples a to b."""
        return self.rows(np.s_[a:b])

    def cut(self, steps: float = GAP) -> list[Stretch]:
        """The parts between gaps of more than so many median steps."""
        apart = np.diff(self.t)
        cuts = np.flatnonzero(apart > steps * np.median(apart)) + 1 if len(apart) else []
        return [self.part(a, b) for a, b in pairwise([0, *map(int, cuts), len(self.t)])]

    def complete(self) -> Stretch:
        """The samples that tell all coordinates."""
        return self.rows(np.isfinite(self.q).all(1))

    def rows(self, keep: Any) -> Stretch:
        """Take these samples."""
        names = ("t", "y", "u", "q", "noise")
        return dataclasses.replace(self, **{name: getattr(self, name)[keep] for name in names})

    def thinned(self, spacing: float) -> np.ndarray:
        """Samples (m,) at which a channel is read that was not for about ``spacing``."""
        seen, last, kept = np.isfinite(self.y), np.full(self.y.shape[1], -np.inf), []
        for k, (t, own) in enumerate(zip(self.t.tolist(), seen, strict=True)):
            if np.any(own & (t - last >= Options.apart * spacing)):
                last[own] = t
                kept.append(k)
        return np.array(kept, int)

    def filled(self, spacing: float) -> Stretch:
        """The samples with places between those that are farther apart than ``spacing``, where
        nothing was read."""
        parts = np.maximum(np.ceil(np.diff(self.t) / spacing - 0.5), 1).astype(int)
        at = np.concatenate([[0], np.cumsum(parts)])
        every = np.arange(at[-1] + 1)

        def spread(rows: np.ndarray, empty: float) -> np.ndarray:
            found = np.full((len(every), rows.shape[1]), empty)
            found[at] = rows
            return found

        inputs = [np.interp(every, at, column) for column in self.u.T]
        t, u = np.interp(every, at, self.t), np.reshape(inputs, (-1, len(every))).T
        y, q, noise = spread(self.y, np.nan), spread(self.q, np.nan), spread(self.noise, 1.0)
        return dataclasses.replace(self, t=t, y=y, u=u, q=q, noise=noise)


@dataclasses.dataclass(frozen=True, eq=False)
class Nodes:
    """Samples ``at`` (m,) of a stretch, with their times t (m,), channels y (m, k) and states x
    (m, 2d); ``zero``: of the channels (k,) in this run, which arcs are without."""

    stretch: Stretch
    at: np.ndarray
    t: np.ndarray
    y: np.ndarray
    x: np.ndarray
    zero: np.ndarray

    def evenly(self, fewest: int) -> Nodes:
        """Nodes at even times, as many or ``fewest``, between which cubics lead from state to
        state: for integrals along them. They are no samples."""
        from scipy.interpolate import CubicHermiteSpline, CubicSpline  # loaded when first used

        t, d = self.t, self.x.shape[1] // 2
        times = np.linspace(t[0], t[-1], max(len(t), fewest))
        q = CubicHermiteSpline(t, self.x[:, :d], self.x[:, d:])(times)
        x = np.concatenate([q, CubicSpline(t, self.x[:, d:])(times)], axis=1)
        own, places = self.stretch, np.arange(len(times))
        u = [np.interp(times, own.t, column) for column in own.u.T]
        u = np.stack(u, axis=1) if u else np.zeros((len(times), 0))
        y = np.full((len(times), self.y.shape[1]), np.nan)
        return Nodes(dataclasses.replace(own, t=times, u=u), places, times, y, x, self.zero)


@dataclasses.dataclass(frozen=True, eq=False)
class Scales:
    """Scales of the samples, from the samples: noise σ (k,) of the channels, rms speeds (d,), the
    fastest frequency ω (1/s), the usual steps of stretches, the shortest one first, the windows of
    the local cubics (samples to either side) of each or, where sampling is uneven, the splines, the
    largest rms step of a channel ÷ its standard deviation, and the time that the longest stretch
    lasts."""

    sigma: np.ndarray
    speed: np.ndarray
    omega: float
    steps: tuple[float, ...]
    half: tuple[int, ...] | Splines
    stride: float
    longest: float

    @property
    def period(self) -> float:
        return 2 * np.pi / self.omega

    @property
    def dt(self) -> float:
        """The shortest of the usual steps."""
        return self.steps[0]

    def every(self, step: float) -> int:
        """Samples so far apart from one node to the next, where sampling is even: as many nodes as
        a period has also in a stretch that is shorter."""
        return max(1, round(min(self.period, self.longest) / step / PER_PERIOD))

    def of(self, s: Stretch) -> tuple[float, int]:
        """The usual step of an even stretch, and its window."""
        assert not isinstance(self.half, Splines)
        kind = int(np.argmin(np.abs(np.log(np.array(self.steps) / s.step))))
        return self.steps[kind], self.half[kind]

    @property
    def uneven(self) -> bool:
        """Return whether sampling is uneven."""
        return isinstance(self.half, Splines)

    def nodes_of(self, seconds: float) -> int:
        """Nodes of an even recording that lasts so long."""
        return 1 + int(np.ceil(PER_PERIOD * seconds / self.period))

    def cubics(self, s: Stretch, at: np.ndarray) -> np.ndarray:
        """States (m, 2d) at samples of an even stretch, by local cubics."""
        q, v, _ = smooth(s.t, s.q, self.of(s)[1], at)[0]
        return np.concatenate([q, v], axis=1)

    @property
    def spacing(self) -> float:
        """Time between nodes, the least where runs differ."""
        if self.uneven:
            return max(self.dt, self.period / PER_PERIOD)
        return min(self._spacings)

    @property
    def _spacings(self) -> list[float]:
        return [step * self.every(step) for step in self.steps]

    @property
    def per_period(self) -> float:
        """Nodes to a period: some forty, fewer of a recording with fewer samples."""
        return self.period / self.spacing

    @property
    def samples(self) -> float:
        """Samples in a period of a sine whose steps are as large."""
        return float(np.pi / np.arcsin(min(self.stride / 2, 1.0)))

    @property
    def substeps(self) -> int:
        """Runge–Kutta steps between two nodes that a search begins with."""
        longest = self.spacing if self.uneven else max(self._spacings)
        return max(1, int(np.ceil(2 * np.pi / (self.period / longest) / Options.step)))


@dataclasses.dataclass(frozen=True, eq=False)
class Arcs:
    """Arcs of one length L: times (A, L), y (A, L, k), states x (A, L, 2d), relative noise (A, L,
    k), and where they come from: (stretch, first node, node after the last). A shorter arc repeats
    its last node, unseen (NaN)."""

    t: np.ndarray
    y: np.ndarray
    x: np.ndarray
    noise: np.ndarray
    home: tuple[tuple[int, int, int], ...]

    def take(self, keep: np.ndarray) -> Arcs:
        chosen = np.arange(len(self.home))[keep]
        home = tuple(self.home[i] for i in chosen)
        return Arcs(self.t[keep], self.y[keep], self.x[keep], self.noise[keep], home)


def stretches(
    recording: Recording,
    channels: Sequence[str] | None = None,
    coordinates_of: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None,
    parameters: Sequence[str] = (),
    between: int = 0,
) -> list[Stretch]:
    """The stretches of all runs.

    channels: columns that are seen, the positions unless given. coordinates_of: (n, k) channels at
    times (n,) -> (n, d) coordinates, NaN where they are not told; None: the channels are the
    coordinates.
    parameters: in which the systems of the runs differ. between: places between two readings, of
    events, where nothing is read.
    Raises FitError where no stretch is long enough.
    """
    names = recording.positions if channels is None else channels
    whole = []
    for run in recording.runs:
        t, u = recording.times(run), recording.array("inputs", run)
        y, noise = channels_of(recording, names, run)
        if between:
            s = Stretch(run, t, y, u, y, noise, np.zeros(0))
            s = s.filled(float(np.median(np.diff(t))) / between)
            t, y, u, noise = s.t, s.y, s.u, s.noise
        q = y if coordinates_of is None else coordinates_of(y, t)
        lifted = {*recording.angles} - {*names}  # angles that no column shows: columns are lifted
        turns = [i for i, n in enumerate(recording.coordinates) if n in lifted]
        read = np.isfinite(q if between else y).any(1) & np.isfinite(u).all(1)
        t, y, u, q, noise = t[read], y[read], u[read], q[read], noise[read]
        if coordinates_of is not None and len(q):
            q = q.copy()
            for i in turns:
                told = np.isfinite(q[:, i])
                q[told, i] = np.unwrap(q[told, i])
        whole.append(Stretch(run, t, y, u, q, noise, args_of(recording, run, parameters)))
    even = [part for s in whole for part in s.complete().cut() if len(part.t) >= Options.shortest]
    if even and not between and _readings(even) >= Options.even * _readings(whole):
        return even
    gap = GAP if recording.inputs else Options.empty
    found = [dataclasses.replace(part, even=False) for s in whole for part in s.cut(gap)]
    found = [s for s in found if np.all(np.isfinite(s.q).sum(0) >= FEWEST)]
    if not found:
        raise FitError(
            f"{recording.source}: no run has {FEWEST} readings of each position in a row (a step "
            f"above {gap:g} times the median is a gap)"
        )
    return found


def _readings(found: Sequence[Stretch]) -> int:
    return sum(int(np.isfinite(s.y).sum()) for s in found)


def by_rates(
    found: Sequence[Stretch], pairs: Mapping[int, tuple[int, int]], given: np.ndarray
) -> list[Stretch]:
    """The stretches, each of these coordinates by the readings of both channels that show it: of
    the coordinate itself, and of its velocity. given: noise σ (k,) of the channels, or NaN."""
    sigma = np.where(given > 0, given, _noise_of_channels(found))
    joined = []
    for s in found:
        q = s.q.copy()
        for i, channels in pairs.items():
            both = np.isfinite(s.y[:, channels]).all(1)
            y, own = s.y[both][:, channels], (sigma * s.noise[both])[:, channels]
            if both.sum() >= FEWEST:
                q[both, i] = with_rates(s.t[both], y, own + Options.exact * np.std(y, axis=0))
        joined.append(dataclasses.replace(s, q=q))
    return joined


def measure(found: Sequence[Stretch]) -> Scales:
    """Noise, speeds and the fastest frequency, from local cubics at some two thousand samples, or
    from splines; the noise of short runs from the law that they share."""
    every = max(1, sum(len(s.t) for s in found) // 2_000)
    if all(s.even for s in found):
        steps, half, sigma = _windows([(s.t, s.q) for s in found])
        scales = Scales(sigma, sigma, 0.0, steps, half, 0.0, 0.0)
        smooths = [smooth(s.t, s.q, scales.of(s)[1], np.r_[: len(s.t) : every])[0] for s in found]
    else:
        half = splines([(s.t, s.q) for s in found])
        sigma = half.sigma
        # Without the ends of a run, where a curve's derivatives are those of its noise.
        edges = [max(1, len(s.t) // 20) for s in found]
        inside = [s.t[n:-n:every] for s, n in zip(found, edges, strict=True)]
        smooths = [half.smooth(s.t, s.q, t) for s, t in zip(found, inside, strict=True)]
        apart = np.concatenate([np.diff(s.t) for s in found])
        steps = (float(np.mean(apart[apart <= 10 * np.median(apart)])),)  # of those that are no gap
    speed = np.sqrt(np.mean(np.concatenate([s.v for s in smooths]) ** 2, axis=0))
    if not np.all(speed > 0):
        still = ", ".join(str(i + 1) for i in np.flatnonzero(~(speed > 0)))
        raise InputError(f"position {still} does not move: leave it out of --positions")
    if not all(np.array_equal(s.y, s.q, equal_nan=True) for s in found):
        sigma = _noise_of_channels(found)
    if isinstance(half, Splines) and np.median([len(s.t) for s in found]) < 2 * Options.shortest:
        others = [np.concatenate([s.u, np.tile(s.args, (len(s.t), 1))], axis=1) for s in found]
        told = noise_of_one_law([(s.t, s.y, o) for s, o in zip(found, others, strict=True)])
        sigma = sigma if told is None else told
    columns = range(found[0].y.shape[1])
    have = [[s.y[~np.isnan(s.y[:, k]), k] for s in found] for k in columns]
    moves = [np.concatenate([np.diff(values) for values in of]) for of in have]
    resolution = np.array([np.median(np.abs(one)) for one in moves])
    size = np.array([np.sqrt(np.mean(one**2)) for one in moves])
    sigma = np.maximum(sigma, 1e-9 * np.maximum(resolution, size))  # clean data have none
    systems: dict[tuple[float, ...], list[Smooth]] = {}
    for stretch, own in zip(found, smooths, strict=True):
        systems.setdefault(tuple(stretch.args.tolist()), []).append(own)
    omega = 0.0  # the largest ratio of rms acceleration to rms speed; of slow ones noise moves
    for own in systems.values():
        parts = (np.concatenate([getattr(s, name) for s in own]) for name in "va")
        v, a = (np.sqrt(np.mean(part**2, axis=0)) for part in parts)
        omega = max(omega, float(np.max(a / np.maximum(v, Options.slow * speed))))
    spread = np.nanstd(np.concatenate([s.y for s in found]), axis=0)
    stride = np.divide(size, spread, out=np.full(len(size), omega * steps[0]), where=spread > 0)
    longest = max(float(np.ptp(s.t)) for s in found)
    return Scales(sigma, speed, omega, steps, half, float(np.max(stride)), longest)


def _windows(
    known: Sequence[tuple[np.ndarray, np.ndarray]],
) -> tuple[tuple[float, ...], tuple[int, ...], np.ndarray]:
    """The usual steps of even stretches (t (n,), y (n, d)), the shortest one first, the windows of
    local cubics for each, and σ (d,), by those of which there are enough."""
    known = sorted(known, key=lambda one: np.median(np.diff(one[0])))
    each = np.array([np.median(np.diff(t)) for t, _ in known])
    edges = [0, *(np.flatnonzero(each[1:] > Options.alike * each[:-1]) + 1).tolist(), len(known)]
    kinds = [known[a:b] for a, b in pairwise(edges)]
    steps = tuple(float(np.median(np.concatenate([np.diff(t) for t, _ in one]))) for one in kinds)
    windows, noise = zip(*(choose_half(one) for one in kinds), strict=True)
    counts = np.array([sum(len(t) for t, _ in one) for one in kinds])
    enough = counts >= min(Options.enough, counts.max())
    return steps, windows, np.min(np.array(noise)[enough], axis=0)


def _noise_of_channels(found: Sequence[Stretch]) -> np.ndarray:
    """σ (k,) of channels, each where it was seen."""
    sigma = []
    for k in range(found[0].y.shape[1]):
        known = [
            (s.t[have], s.y[have, k : k + 1]) for s in found for have in [~np.isnan(s.y[:, k])]
        ]
        if not any(y.any() for _, y in known):  # of events
            sigma.append(0.0)
        elif all(s.even for s in found):
            known = [pair for pair in known if len(pair[0]) >= Options.shortest]
            if not known:
                raise FitError(f"a column has no {Options.shortest} samples in a row: leave it out")
            sigma.append(float(_windows(known)[2][0]))
        else:
            sigma.append(float(splines(known).sigma[0]))
    return np.array(sigma)


def nodes_of(found: Sequence[Stretch], scales: Scales, most: int = MOST_STEPS) -> list[Nodes]:
    """The nodes of all stretches; of a recording of more than ``most`` steps those of blocks,
    spread evenly over it."""
    if isinstance(scales.half, Splines):
        parts = [part for s in found for part in _between_gaps(s, scales, scales.half)]
    else:
        parts = [(s, np.arange(0, len(s.t), scales.every(scales.of(s)[0])), None) for s in found]
    total = sum(len(at) for _, at, _ in parts)
    length = round(Options.block * scales.per_period)
    keep = -(-total * scales.substeps // most)  # every so many blocks
    nodes, count = [], 0
    for s, at, states in parts:
        blocks = [at] if keep == 1 else [at[k : k + length] for k in range(0, len(at), length)]
        for block in blocks:
            count += 1
            if len(block) < Options.shortest_arc or (count - 1) % keep:
                continue
            x = scales.cubics(s, block) if states is None else states[block]
            nodes.append(Nodes(s, block, s.t[block], s.y[block], x, np.zeros(s.y.shape[1])))
    return nodes


def _between_gaps(
    s: Stretch, scales: Scales, curves: Splines
) -> Iterator[tuple[Stretch, np.ndarray, np.ndarray]]:
    """A stretch with places where nothing was read, its nodes (m,) between two gaps, and the states
    (n, 2d) of all places."""
    filled = s.rows(s.thinned(scales.spacing)).filled(1.5 * scales.spacing)
    q, v, _ = curves.smooth(s.t, s.q, filled.t)
    seen = np.flatnonzero(np.isfinite(filled.y).any(1))
    longest = max(Options.gap * scales.period, 2 * scales.spacing)
    usual, events = float(np.median(np.diff(filled.t[seen]))), not np.nan_to_num(filled.y).any()
    longest = np.inf if events or usual > longest else longest
    ends = np.flatnonzero(np.diff(filled.t[seen]) > longest) + 1
    for a, b in pairwise([0, *map(int, ends), len(seen)]):
        yield filled, np.arange(seen[a], seen[b - 1] + 1), np.concatenate([q, v], axis=1)


def arcs_of(nodes: Sequence[Nodes], length: int) -> Arcs:
    """All nodes in arcs of about ``length`` nodes, each node in one arc."""
    home = []
    for i, node in enumerate(nodes):
        count = max(1, round(len(node.t) / length))
        edges = np.linspace(0, len(node.t), count + 1).round().astype(int)
        home += [(i, int(a), int(b)) for a, b in pairwise(edges) if b - a >= Options.shortest_arc]
    longest = max(b - a for _, a, b in home)
    t, y, x, noise = [], [], [], []
    for i, a, b in home:
        index = np.minimum(np.arange(a, a + longest), b - 1)
        t.append(nodes[i].t[index])
        x.append(nodes[i].x[index])
        noise.append(nodes[i].stretch.noise[nodes[i].at[index]])
        inside = np.arange(a, a + longest) < b
        y.append(np.where(inside[:, None], nodes[i].y[index] - nodes[i].zero, np.nan))
    return Arcs(np.array(t), np.array(y), np.array(x), np.array(noise), tuple(home))


def with_states(nodes: Sequence[Nodes], arcs: Arcs, x: np.ndarray) -> list[Nodes]:
    """The nodes with the states x (A, L, 2d) that a fit of these arcs found."""
    states = [node.x.copy() for node in nodes]
    for k, (i, a, b) in enumerate(arcs.home):
        states[i][a:b] = x[k, : b - a]
    return [dataclasses.replace(n, x=s) for n, s in zip(nodes, states, strict=True)]


def with_noise(nodes: Sequence[Nodes], arcs: Arcs, sigma: np.ndarray) -> tuple[list[Nodes], Arcs]:
    """The nodes and arcs of them with normal noise σ (k,) in their channels, always the same."""
    rng, y = np.random.default_rng(0), arcs.y.copy()
    added = [sigma * rng.normal(size=node.y.shape) for node in nodes]
    for k, (i, a, b) in enumerate(arcs.home):
        y[k, : b - a] += added[i][a:b]
    nodes = [dataclasses.replace(n, y=n.y + e) for n, e in zip(nodes, added, strict=True)]
    return nodes, dataclasses.replace(arcs, y=y)


def shifted(nodes: Sequence[Nodes], zeros: Mapping[str, np.ndarray]) -> list[Nodes]:
    """The nodes with further zeros (d,) of each run, of channels that are the coordinates."""
    found = []
    for n in nodes:
        own = zeros[n.stretch.run]
        x = n.x - np.concatenate([own, np.zeros(n.x.shape[1] - len(own))])
        found.append(dataclasses.replace(n, x=x, zero=n.zero + own))
    return found


class Moving(NamedTuple):
    """The stretches without their rests, the seconds of these, and those of what moves for less
    than a period of the fastest motion, which is left out too."""

    stretches: list[Stretch]
    resting: float
    short: float


def without_rests(found: Sequence[Stretch], scales: Scales) -> Moving:
    """Take the rests out of stretches of plain positions, and the end where a body creeps; where no
    motion would be left, or where sampling is uneven, none."""
    if scales.uneven:
        return Moving(list(found), 0.0, 0.0)
    kept, resting, short = [], 0.0, 0.0
    for stretch in found:
        window = max(9, round(scales.period / scales.of(stretch)[0]))
        at_rest = _still(stretch, scales.sigma, window) | _creeps(stretch, scales.sigma, window)
        at_rest = _shrunk(at_rest, round(Options.kept * window))
        resting += sum(float(stretch.t[b - 1] - stretch.t[a]) for a, b in stretches_of(at_rest))
        for a, b in stretches_of(~at_rest):
            if b - a >= min(window, len(at_rest)):
                kept.append(stretch.part(a, b))
            else:
                short += float(stretch.t[b - 1] - stretch.t[a])
    return Moving(kept, resting, short) if kept else Moving(list(found), 0.0, 0.0)


def _still(stretch: Stretch, sigma: np.ndarray, window: int) -> np.ndarray:
    """Samples (n,) that lie in a window of which no coordinate varies by more than its noise."""
    q, count = stretch.q, len(stretch.t) - window + 1
    if count < 1:
        return np.zeros(len(q), bool)
    views = np.lib.stride_tricks.sliding_window_view(q, window, axis=0)
    quiet = (views.std(axis=-1) <= Options.still * sigma[: q.shape[1]]).all(axis=1)
    begun = np.concatenate([np.cumsum(quiet), np.full(window - 1, np.sum(quiet))])
    ended = np.concatenate([np.zeros(window, int), np.cumsum(quiet)[:-1]])[: len(q)]
    return begun > ended


def _creeps(stretch: Stretch, sigma: np.ndarray, window: int) -> np.ndarray:
    """Samples (n,) from which on, to the end, each coordinate varies little in each window, and
    oscillates in none: friction holds the body. What springs back turns within a window, by the
    means of its quarters."""
    q, part = stretch.q, window // 4
    if len(q) < 4 * part:
        return np.zeros(len(q), bool)
    views = np.lib.stride_tricks.sliding_window_view(q, 4 * part, axis=0)
    change = np.diff(views.reshape(*views.shape[:2], 4, part).mean(axis=-1), axis=-1)
    noise = 5 * sigma[: q.shape[1], None] * np.sqrt(2 / part)
    one_way = (change > -noise).all(axis=-1) | (change < noise).all(axis=-1)
    little = views.std(axis=-1) < Options.creeping * np.std(q, axis=0)
    moves = np.flatnonzero(~(one_way & little).all(axis=1))
    begins = moves[-1] + 1 if len(moves) else 0
    return (np.arange(len(q)) >= begins) & (begins < len(views))


def _shrunk(mask: np.ndarray, by: int) -> np.ndarray:
    """The mask without the first and the last ``by`` samples of each of its runs, but for those at
    its ends."""
    found = np.zeros_like(mask)
    for a, b in stretches_of(mask):
        found[a + by * (a > 0) : max(b - by * (b < len(mask)), a)] = True
    return found
