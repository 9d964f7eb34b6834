"""Maps between the monitors of a ring, of which two or more lie to either side of a known stretch.

One monitor tells positions, and p only but for a factor and a gauge. Across a stretch whose map is
known and linear, a drift or lenses,

    Q = A q + B p,   P = C q + D p,

two monitors tell p = B⁻¹ (Q − A q) and P, in their own unit: slopes in metres per metre across a
drift. Every other stretch, from one place to the next, is then learned from canonical pairs, and
the maps of all places in a row are that of a turn. Where the readings of two monitors have noise,
it is learned with latent readings.
"""

import dataclasses
from collections.abc import Sequence
from functools import reduce
from typing import Any

import jax
import numpy as np

from gfnn_jax.arrays import stretches_of
from gfnn_jax.data.recording import Recording
from gfnn_jax.errors import FitError, InputError
from gfnn_jax.generating.generated import Generated
from gfnn_jax.learn.fit import fit
from gfnn_jax.learn.fitted import Fit
from gfnn_jax.maps.domain import covering
from gfnn_jax.maps.piece import Affine
from gfnn_jax.maps.posterior import Posterior
from gfnn_jax.maps.symplectic_map import SymplecticMap
from gfnn_jax.models.generating_functions.map_arcs import Linear, latent_readings
from gfnn_jax.phase_space import Pairs, sizes, symplectic_form


class _Options:
    """Stretches between monitors, and the grid of their times."""

    symplectic: float = 1e-9  # ‖MᵀJM − J‖ of a stretch that is known
    singular: float = 1e-8  # smallest singular value of B, ÷ its largest, that tells momenta
    even: float = 0.01  # of a turn, by which times may miss an even grid


@dataclasses.dataclass(frozen=True)
class Monitors:
    """Maps from each place to the next, the last one to the first place of the next turn.

    places: the columns of each monitor, d each. maps: one for each stretch, in the order of the
    places. fits: how each was learned from momenta as they are read; None where it was known.
    noise: σ of each place's columns, as ``places`` has them, where two places have noise: the map
    between them is then learned with latent readings, and its posterior is that of this fit.
    """

    places: tuple[tuple[str, ...], ...]
    maps: tuple[SymplecticMap, ...]
    fits: tuple[Fit | None, ...]
    noise: tuple[tuple[float, ...], ...] | None
    _known: tuple[np.ndarray | None, ...] = dataclasses.field(repr=False)

    def turn(self, place: int = 0) -> SymplecticMap:
        """The map of a turn that begins at a place, by its number: all maps in a row."""
        return reduce(SymplecticMap.then, [*self.maps[place:], *self.maps[:place]])

    def states(self, recording: Recording, place: int = 0) -> dict[str, np.ndarray]:
        """z = (q, p) (turns, 2d) at a place, by the names of the runs, from both monitors of a
        known stretch; NaN where a reading is missing. Turns whose momenta would need readings of
        the turn before the first, or after the last, are NaN too."""
        found = {}
        for run in recording.runs:
            q = [_readings(recording, names, run) for names in self.places]
            found[run] = _states(q, self._known)[place]
        return found


def fit_monitors(
    recording: Recording,
    places: Sequence[Sequence[str]],
    between: Sequence[float | np.ndarray | None],
    **options: Any,
) -> Monitors:
    """Learn the maps between monitors, some of which have a known stretch between them.

    recording: readings turn by turn, a row a turn, a column for each monitor and coordinate.
    places: the columns of each monitor along a turn, such as [("x1", "y1"), ("x2", "y2")].
    between: of each place to the next, and of the last to the first: the length of a drift, a
    symplectic matrix (2d, 2d) in (q, p), or None where the stretch is to be learned. options: of
    `gfnn.fit`, for each stretch that is learned.

    Raises InputError where places and stretches do not fit together, no stretch or all are known, a
    known one tells no momenta, or a place lies at none: its momenta are not known then.
    """
    places = tuple(tuple(names) for names in places)
    if len({len(names) for names in places}) != 1 or len(places) < 2:
        raise InputError(f"places: expected two or more, with equally many columns, got {places}")
    missing = [n for names in places for n in names if n not in recording.columns]
    if missing:
        raise InputError(f"{recording.source}: expected columns {', '.join(missing)}")
    if set(recording.angles) & {n for names in places for n in names}:
        raise InputError("expected displacements at monitors, got angles")
    if len(between) != len(places):
        raise InputError(f"expected {len(places)} stretches, as many as places, got {len(between)}")
    known = tuple(_matrix(stretch, len(places[0])) for stretch in between)
    if all(m is None for m in known) or all(m is not None for m in known):
        raise InputError("between: expected some stretches that are known, and some None")
    lost = [k for k in range(len(places)) if known[k] is None and known[k - 1] is None]
    if lost:
        raise InputError(
            f"place {', '.join(str(k + 1) for k in lost)} has no known stretch on either side, so "
            "that its momenta are unknown. Give one (between=), or leave the place out"
        )
    runs = [[_readings(recording, names, run) for names in places] for run in recording.runs]
    states = [_states(q, known) for q in runs]
    steps = np.concatenate([np.diff(recording.times(run)) for run in recording.runs])
    turn = float(np.median(steps)) if len(steps) else 1.0
    if len(steps) and np.abs(steps - turn).max() > _Options.even * turn:
        raise InputError(f"{recording.source}: expected a row for every turn, {turn:g} s apart")
    dt = turn / len(places)
    pairs = [_pairs(states, k, dt) for k in range(len(places))]
    stretches = list(zip(pairs, known, strict=True))
    unknown = {k: own for k, (own, matrix) in enumerate(stretches) if matrix is None}
    learned = {k: fit(own, learn="map", **options) for k, own in unknown.items()}
    first, one = next(iter(learned.items()))
    whole = []
    for k, (own, matrix) in enumerate(stretches):
        whole.append(learned[k].map if matrix is None else _linear(matrix, own, one.map))
    noise, fits = None, map(learned.get, range(len(places)))
    if len(places) == 2 and not one.met:
        better = _of_latent_readings(one.map, runs, known, first)
        if better is not None:
            whole[first], noise = better
    return Monitors(places, tuple(whole), tuple(fits), noise, known)


def _of_latent_readings(
    map_: SymplecticMap, runs: list[list[np.ndarray]], known: tuple[np.ndarray | None, ...], k: int
) -> tuple[SymplecticMap, tuple[tuple[float, ...], ...]] | None:
    """Stretch k of two, as it was learned by least squares, learned from the same readings as
    latent ones, and the noise of both places; None where that fails."""
    matrix = known[1 - k]
    assert matrix is not None
    pieces = jax.tree.map(np.asarray, map_.pieces)
    own = next((i for i, piece in enumerate(pieces) if isinstance(piece, Generated)), None)
    if own is None:
        return None
    dim = len(matrix) // 2
    read = np.eye(2 * dim)
    read[dim:] = matrix[:dim]
    inner, outer = Linear(matrix @ np.linalg.inv(read)), Linear(read)
    ends = [inner, *pieces[:own]], [*pieces[own + 1 :], outer]
    turns = []  # without a missing value
    for y in (np.concatenate(_ends(q, 1 - k), axis=1) for q in runs):
        turns += [y[a:b] for a, b in stretches_of(np.isfinite(y).all(axis=1))]
    found = latent_readings(pieces[own], ends, turns)
    if found is None:
        return None
    first, last = (tuple(map(float, half)) for half in np.split(found.sigma, 2))
    noise = (first, last) if k == 1 else (last, first)
    leaves = jax.tree.map(jax.device_put, (*pieces[:own], found.piece, *pieces[own + 1 :]))
    posterior = Posterior(own, found.root)
    return dataclasses.replace(map_, pieces=leaves, posterior=posterior), noise


def _matrix(stretch: float | np.ndarray | None, dim: int) -> np.ndarray | None:
    """(2d, 2d) of a known stretch. Raises InputError where it is not symplectic or tells no p."""
    if stretch is None:
        return None
    if np.ndim(stretch) == 0:
        matrix = np.eye(2 * dim)
        matrix[:dim, dim:] = float(stretch) * np.eye(dim)
    else:
        matrix = np.asarray(stretch, float)
    if matrix.shape != (2 * dim, 2 * dim) or not np.isfinite(matrix).all():
        wanted, got = (2 * dim, 2 * dim), np.shape(stretch)
        raise InputError(f"expected the length of a drift or a matrix of shape {wanted}, got {got}")
    form = symplectic_form(dim)
    defect = np.abs(matrix.T @ form @ matrix - form).max()
    if not defect < _Options.symplectic * max(1.0, np.abs(matrix).max() ** 2):
        got = f"one with |MᵀJM − J| of {defect:.2g}"
        raise InputError(f"between: expected symplectic matrices in q1…qd, p1…pd, got {got}")
    values = np.linalg.svd(matrix[:dim, dim:], compute_uv=False)
    if not values[-1] > _Options.singular * max(values[0], 1e-300):
        raise InputError(
            "between: the block ∂Q/∂p of a matrix is singular (a phase advance near a multiple of "
            "π), so that two readings determine no momenta. Give another stretch as the known one"
        )
    return matrix


def _readings(recording: Recording, names: tuple[str, ...], run: str) -> np.ndarray:
    """(turns, d) of a monitor."""
    return np.stack([recording.values(name, run) for name in names], axis=1)


def _states(q: list[np.ndarray], known: tuple[np.ndarray | None, ...]) -> list[np.ndarray]:
    """z (turns, 2d) at each place of a run, of the readings (turns, d) at all of them."""
    found = [np.full((len(one), 2 * one.shape[1]), np.nan) for one in q]
    for k, matrix in enumerate(known):
        if matrix is None:
            continue
        first, second = _ends(q, k)
        dim = first.shape[1]
        across = np.linalg.solve(matrix[:dim, dim:], (second - first @ matrix[:dim, :dim].T).T).T
        z = np.concatenate([first, across], axis=1)
        places = _ends(found, k)
        places[0][:], places[1][:] = z, z @ matrix.T
    return found


def _ends(rows: list[np.ndarray], k: int) -> tuple[np.ndarray, np.ndarray]:
    """Values at the ends of stretch k, of values (turns, n) at each place, turn by turn: the last
    stretch ends at the first place one turn later."""
    last = k + 1 == len(rows)
    return (rows[k][:-1], rows[0][1:]) if last else (rows[k], rows[k + 1])


def _pairs(states: list[list[np.ndarray]], k: int, dt: float) -> Pairs:
    """The states of all runs at the ends of stretch k."""
    ends = [_ends(of_run, k) for of_run in states]
    known = [np.isfinite(a).all(axis=1) & np.isfinite(b).all(axis=1) for a, b in ends]
    each = [(a[rows], b[rows]) for (a, b), rows in zip(ends, known, strict=True)]
    z0, z1 = map(np.concatenate, zip(*each, strict=True))
    if not len(z0):
        raise FitError("expected turns with readings of all monitors, found none")
    run = np.repeat(np.arange(len(ends)), [rows.sum() for rows in known])
    place = np.concatenate([np.flatnonzero(rows) for rows in known])
    return Pairs(z0, z1, dt, run=run, place=place)


def _linear(matrix: np.ndarray, pairs: Pairs, like: SymplecticMap) -> SymplecticMap:
    """The map of a known stretch, in the coordinates of a learned one."""
    z, none = pairs.z0, np.zeros(len(matrix))
    pieces, angles = (Affine(matrix, none, none),), np.zeros(0)
    return SymplecticMap(pieces, like.coordinates, covering(z), sizes(z), angles, pairs.dt)
