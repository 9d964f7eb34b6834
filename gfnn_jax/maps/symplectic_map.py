"""Symplectic map: pieces in a row, each symplectic, each with its inverse.

    coordinates⁻¹ ∘ R^½ ∘ generated(S, chart) ∘ R^½ ∘ coordinates

Of a system with friction a piece multiplies the symplectic form by a factor μ, its multiplier, or
keeps no multiple of it; so does the map.

Maps are pytrees: their numbers can be passed through ``jit`` and differentiated. The kind of
family, the chart and the coordinates are static, hashable constants. A program compiled for one map
serves all maps of the same kind.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from functools import partial, wraps
from numbers import Integral
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from gfnn_jax.arrays import as_row
from gfnn_jax.compiling import compiled_sooner
from gfnn_jax.coordinates import CARTESIAN, TWO_PI, Coordinates
from gfnn_jax.flows.flow import Flow
from gfnn_jax.generating.generated import Generated, two_sum
from gfnn_jax.maps.bands import Bands, bands
from gfnn_jax.maps.domain import Domain, Ranges
from gfnn_jax.maps.inputs import Scheduled, Signals
from gfnn_jax.maps.modified_hamiltonian import NUM_STEPS, Cells, ModifiedHamiltonian, of_cells
from gfnn_jax.maps.parameters import Parameters, as_args
from gfnn_jax.maps.posterior import Posterior
from gfnn_jax.maps.rollout import scan_steps
from gfnn_jax.maps.sensors import Sensors
from gfnn_jax.phase_space import defect_of_pairs, require_x64, symplecticity_defect
from gfnn_jax.solve.status import LEFT_DOMAIN, NON_FINITE, OK, STOPPED_AT_EDGE, Info

# Up to this 2d a defect uses all tangent vectors; beyond it this many random pairs of them.
_WIDEST, _TANGENT_PAIRS = 64, 4
_DT_EDGE = 1e-6  # relative tolerance at the ends of a range of dt, for printed numbers
_TWO_PI_REST = 2.4492935982947064e-16  # 2π minus its float64 value


@runtime_checkable
class Piece(Protocol):
    """Map in a row of such, batch first: z (B, 2d), by JAX.

    A piece is a pytree. ``unrolled`` makes derivatives those of the iterations that ran; a number
    also bounds the number of updates.
    """

    def step(self, z: Any, args: Any = None, *, unrolled: bool | int = False) -> tuple[Any, Info]:
        """Step z: (Z, Info)."""
        ...

    def compensated_step(self, z: Any, compensation: Any, args: Any = None) -> tuple:
        """Step z + compensation: (Z, compensation, Info). Rounding has lost the compensation."""
        ...

    def action(self, z: Any, image: Any, origin: Any, args: Any = None) -> Any:
        """Action (B,) of the step from z to its image, about the origin (B, 2d).

        See `maps.modified_hamiltonian`.
        """
        ...

    def inverse(self) -> Any:
        """Make the inverse piece."""
        ...

    def multiplier(self, args: Any = None) -> Any:
        """μ of AᵀJA = μJ, which holds for the derivative A of every step: 1.0 of a symplectic
        piece; another number, or one of each lane (B,), of a conformally symplectic one; None where
        there is no such number."""
        ...


class Lanes(NamedTuple):
    """Complete state of a batch of rollouts, from which it can be continued.

    y: inner coordinates with angles reduced (B, 2d). compensation: their rounding error, less than
    their last digit (B, 2d). winding: whole turns of the angles (B, a). status, left_at (step at
    which the lane left the domain, −1 if never), iterations (most Newton updates of a step), steps
    (number of steps done): each (B,).
    """

    y: Any
    compensation: Any
    winding: Any
    status: Any
    left_at: Any
    iterations: Any
    steps: Any


class RolloutInfo(NamedTuple):
    """Result of each lane of a rollout, (B,): status, left_at, iterations; and bands.

    left_at: step at which the lane left the domain, −1 if it never did. iterations: most Newton
    updates in a step. bands: those of the samples, where samples were asked for.
    """

    status: Any
    left_at: Any
    iterations: Any
    bands: Bands | None = None


@partial(
    jax.tree_util.register_dataclass,
    data_fields=("pieces", "domain", "scale", "angle_centre", "dt", "parameters", "dt_range"),
    meta_fields=("coordinates", "signals"),
    drop_fields=("posterior", "sensors"),
)
@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class SymplecticMap:
    """Learned map, with the domain and the ranges of its data.

    pieces:       applied in order, in the inner coordinates.
    coordinates:  the inner coordinates; methods take and return the user's.
    domain:       region that the data covered, in the inner coordinates.
    scale:        (2d,) sizes of the user's coordinates.
    angle_centre: (a,) centre of the interval of length 2π in which each angle is kept.
    dt:           time of one step; negative for a reversed map.
    parameters:   names and ranges of the parameters that the map was learned with, or None.
    dt_range:     (2,) the lowest and highest dt of the data, for a map that was learned with dt as
                  a variable of S.
    signals:      names of the inputs that act on the system, or None.
    sensors:      columns of the recording that the map was learned from, with their noise, or None.
                  They are no leaf.
    posterior:    posterior of the coefficients, or None. It is no leaf: a map that is made of the
                  leaves (``jit``, ``jax.tree.map``) has none.

    Methods take states z (2d,) or (B, 2d), NumPy or JAX, and return JAX arrays. A map that was
    learned with parameters takes their values too: name -> a number or (B,), or an array (k,) or
    (B, k). A map of a driven system takes t0, the time of the drive at z, a number or (B,), which
    advances with the steps. A map with inputs takes these: (k,) or (B, k) during a step, (N, k) or
    (B, N, k) of the N steps of a rollout; where they are not given, none acts. Methods can be
    differentiated, in forward and reverse mode, in z, in the parameters' values, in the inputs and
    in the map's own leaves, by the implicit-function theorem. ``jax.vmap`` and ``jax.jit`` work
    over them.
    """

    pieces: tuple
    coordinates: Coordinates
    domain: Domain | Ranges
    scale: Any
    angle_centre: Any
    dt: Any
    parameters: Parameters | None = None
    posterior: Posterior | None = None
    dt_range: Any = None
    signals: Signals | None = None
    sensors: Sensors | None = None

    def __post_init__(self):
        if isinstance(self.dt, (int, float)):
            object.__setattr__(self, "dt", np.asarray(self.dt, self.scale.dtype))

    def __repr__(self) -> str:
        """Text of one line, without the arrays."""
        pieces = ", ".join(type(piece).__name__ for piece in self.pieces)
        return f"SymplecticMap({pieces}; {self.coordinates.name}, d = {self.dim}, dt = {self.dt})"

    @property
    def dim(self) -> int:
        """Number d of degrees of freedom."""
        return self.scale.shape[-1] // 2

    def save(self, folder, **options) -> None:
        """Write a model folder, which ``gfnn.load`` reads; options: those of `maps.saved.save`."""
        from gfnn_jax.maps import saved  # stands after this module: a shorthand for its function

        saved.save(self, folder, **options)

    def sample(self, key, num: int):
        """Draw ``num`` maps from the posterior, each symplectic: `maps.samples.Samples`."""
        from gfnn_jax.maps import samples  # stands after this module: a shorthand for its function

        return samples.sampled(self, key, num)

    def sharded(self, devices: int | str = "all"):
        """Share rollouts of this map out among devices of this process: `maps.sharded.Sharded`.

        devices: "all", or the number of devices, the first ones.
        """
        from gfnn_jax.maps import sharded  # stands after this module: a shorthand for its class

        return sharded.Sharded(self, sharded.local_devices(devices))

    def step(self, z, args=None, *, dt=None, t0=None, inputs=None):
        """Make one step: (Z, Info); Info's leaves are () or (B,). dt: argument of `over`. inputs:
        that act during the step."""
        z = self._states(z)
        map_ = self if dt is None else self.over(dt, z.shape[:-1])
        return _step(map_, z, self._args(args, z, t0, inputs))

    def inverse(self, z=None, args=None, *, t0=None):
        """Make one step back, from Z to (z, Info). t0: the time at z, not at Z. Raises ValueError
        without states: the inverse map itself is ``reversed()``."""
        if z is None:
            raise ValueError(
                "expected states to step back from, map.inverse(z); the inverse map itself is "
                "map.reversed()"
            )
        args = self._args(args, z := self._states(z), t0)
        if self.parameters is not None:
            args = self.parameters.after(args, 1, self.dt)
        return _step(self.reversed(), z, args)

    def over(self, dt, lanes: tuple[int, ...] = ()) -> SymplecticMap:
        """Make the map over another dt: of the flow of one law, or of an S of dt.

        Outside the range of dt that an S of dt was learned with, the lanes' status is 1. dt: above
        0, a number, or one per lane, of the shape ``lanes``. Raises ValueError for any other map,
        which is known at one dt only, unless dt is its own.
        """
        known = not any(isinstance(value, Tracer) for value in (dt, self.dt))
        if known and np.ndim(dt) == 0 and np.array_equal(dt, self.dt):  # inside jit too
            return self
        if not isinstance(dt, jax.Array):
            dt = np.asarray(dt)
            if dt.dtype.kind not in "fiu" or not (np.isfinite(dt) & (dt > 0)).all():
                raise ValueError(
                    f"expected a time step that is finite and above 0, got {dt}; for steps back "
                    "give rollout a negative num_steps, or use inverse"
                )
        if len(self.pieces) != 1 or not serves_any_dt(self.pieces[0]):
            raise ValueError(
                f"this is a map of dt = {float(np.asarray(self.dt)):g} only. Fit a law (--learn "
                "hamiltonian, learn='hamiltonian'), or S to pairs of several dt"
            )
        if dt.shape not in ((), lanes):
            raise ValueError(
                f"expected one time step, or one per state {lanes}; got shape {dt.shape}"
            )
        dt = dt.astype(self.scale.dtype)
        return dataclasses.replace(self, pieces=(self.pieces[0].over(dt),), dt=dt)

    def from_positions(self, q, other):
        """The state z = (q, p) at q, (2d,) or (B, 2d), of a map that was learned from positions
        alone, from q and the position ``other`` a step later, (d,) or (B, d) each: p = −h ∂S/∂q.

        Where angles were learned from readings modulo their period, the move is taken modulo it;
        else a lift is trusted. Raises ValueError for another map, or another shape.
        """
        from gfnn_jax.maps import positions  # stands after this module: a shorthand

        return positions.state_at(self, q, other)

    def then(self, other: SymplecticMap) -> SymplecticMap:
        """Compose this map and the other one after it: sectors of a ring, phases of a period.

        The domain and the sizes are those of this map. dt, and its range for an S of dt, is the sum
        of both. Ranges of parameters are the intersections of both. Raises ValueError where the
        maps have different coordinates or parameters, or are driven.
        """
        ours, theirs = self.parameters, other.parameters
        names = [() if p is None else p.names for p in (ours, theirs)]
        driven = any(p is not None and p.period is not None for p in (ours, theirs))
        if self.coordinates != other.coordinates or names[0] != names[1] or driven:
            raise ValueError(
                "only maps of the same coordinates and parameters, without a drive, can be composed"
            )
        if ours is not None and theirs is not None:
            low, high = np.maximum(ours.low, theirs.low), np.minimum(ours.high, theirs.high)
            ours = dataclasses.replace(ours, low=low, high=high)
        dt_range = None
        if self.dt_range is not None or other.dt_range is not None:
            dt_range = sum(m.dt if m.dt_range is None else m.dt_range for m in (self, other))
        return dataclasses.replace(
            self, pieces=(*self.pieces, *other.pieces), dt=self.dt + other.dt, parameters=ours,
            dt_range=dt_range,
        )  # fmt: skip

    def reversed(self) -> SymplecticMap:
        """Make the inverse map."""
        pieces = tuple(piece.inverse() for piece in reversed(self.pieces))
        posterior = self.posterior
        if posterior is not None:
            posterior = posterior.of_piece(len(pieces) - 1 - posterior.piece)
        return dataclasses.replace(self, pieces=pieces, dt=-self.dt, posterior=posterior)

    def multiplier(self, args=None):
        """μ of AᵀJA = μJ, which holds for the derivative A of every step: the product of those of
        the pieces. 1.0 where the map is symplectic, e^(−γ dt) with uniform friction γ, None where
        the map keeps no multiple of the form: with other friction, or with inputs; and where μ
        depends on the args (name -> a number or (B,)) and none are given."""
        if isinstance(args, Mapping):
            lanes = np.broadcast_shapes(*(np.shape(value) for value in args.values()))
            dtype = np.dtype(self.scale.dtype)
            args = as_args(self.parameters, args, (*lanes, 2 * self.dim), dtype)
            return jax.tree.map(np.asarray, self).multiplier(np.asarray(args))
        factors = [piece.multiplier(args) for piece in self.pieces]
        return None if any(factor is None for factor in factors) else math.prod(factors, start=1.0)

    def defect(self, z, args=None, *, t0=None, iterations=None):
        """Symplecticity defect ‖AᵀJA − μJ‖ () or (B,) of the step's derivative A at z.

        It is in units of ``scale``, μ the multiplier; NaN where there is none.

        The derivative is the unrolled one, by forward differentiation through the iterations that
        ran. That of the implicit rule would look symplectic however badly the solve had converged.
        For many degrees of freedom the defect is estimated by random pairs of tangent vectors.
        iterations: updates of the steps from z, where they were stepped before; else they are now.
        """
        z = self._states(z)
        args = self._args(args, z, t0)
        ran = _step(self, z, args)[1].iterations if iterations is None else iterations
        # A single update is the usual case; its derivative compiles in half the time.
        once = not isinstance(ran, Tracer) and np.max(np.asarray(ran), initial=0) <= 1
        return _defect(self, z, args, 1 if once else True)

    def determinant(self, z, args=None, *, t0=None):
        """Chart determinant () or (B,) at z, the smallest of all pieces; NaN without a chart."""
        z = self._states(z)
        return _determinant(self, z, self._args(args, z, t0))

    def hamiltonian(self, z, args=None, *, t0=None):
        """Hamiltonian H () or (B,) at z.

        It is the learned one where the map is the flow of a Hamiltonian. For any other map it is
        the modified Hamiltonian, whose error ``modified_hamiltonian`` gives.
        """
        if len(self.pieces) != 1 or not isinstance(self.pieces[0], Flow):
            return self.modified_hamiltonian(z, args).value
        z = self._states(z)
        return _hamiltonian(self, z, self._args(args, z, t0))

    def power(self, z, args=None, *, inputs=None):
        """Energy per unit of time at z: ``lost`` (..., F) by each friction and ``supplied``
        (..., k) by each input: `maps.energy`. Raises ValueError for a map that is no flow."""
        from gfnn_jax.maps import energy  # stands after this module: a shorthand for its function

        return energy.power_of(self, z, args, inputs)

    def estimate(self, recording) -> tuple[np.ndarray, np.ndarray]:
        """States z = (q, p) (runs, 2d) at each run's last time and their covariance (runs, 2d, 2d),
        from the samples of the recording before it: `maps.estimates`, `maps.position_estimates`.
        Raises InputError for a map that was not learned from a recording, or where columns or
        samples are missing."""
        from gfnn_jax.maps import (
            estimates,
            position_estimates,
            positions,
        )  # stand after this module

        alone = positions.starts_from_positions(self)
        return (position_estimates if alone else estimates).estimate(self, recording)

    def forecast(self, recording, times, inputs=None):
        """`maps.estimates.Forecast` of the positions at ``times`` (n,), the recording's clock, from
        the state at each run's end; ``inputs`` are a recording of those ahead, matched by run where
        it has several. Raises InputError as `estimate` does, for times before a run's end, and of a
        map of positions alone for times between its steps."""
        from gfnn_jax.maps import (
            estimates,
            position_estimates,
            positions,
        )  # stand after this module

        if positions.starts_from_positions(self):
            return position_estimates.forecast(self, recording, times)
        return estimates.forecast(self, recording, times, inputs)

    def linearise(self, z, inputs=None, args=None, *, t0=None):
        """(A, B) of a step: ∂Z/∂z (..., 2d, 2d) and ∂Z/∂u (..., 2d, k), inputs u, (k,) or (B, k),
        that do not change during the step."""
        z = self._states(z)
        return _linearised(self, z, self._args(args, z, t0, inputs))

    def modified_hamiltonian(self, z, args=None) -> ModifiedHamiltonian:
        """Value and error, each () or (B,), of the Hamiltonian H̃ whose flow over dt is this map.

        Both are in units of H; the constant is that of S. They come from 32 steps to either side of
        z (`maps.modified_hamiltonian`). The error is small where the orbit turns slowly against a
        step (Hénon–Heiles: 1e-12 at dt 0.4, 1e-8 at 0.8), and as large as H̃ for a map that is near
        no flow. Both are NaN where one of these steps fails. Raises ValueError for a driven map,
        and for one with friction, which conserve no energy.
        """
        if self.parameters is not None and self.parameters.period is not None:
            raise ValueError("expected a map without a drive: a driven one conserves no energy")
        multiplier = self.multiplier()
        if not (isinstance(multiplier, float) and multiplier == 1.0):
            raise ValueError("expected a map without friction: one with it conserves no energy")
        z = self._states(z)
        return _modified(self, z, self._args(args, z))

    def start(self, z0, *, params=None, t0=None, stop_outside: bool = False) -> Lanes:
        """Start lanes at step 0 from z0 (B, 2d). States outside the domain have that status."""
        z0 = self._states(z0)
        return _start(self, z0, self._args(params, z0, t0), stop_outside)

    def advance(
        self, lanes: Lanes, num_saved: int, *, params=None, t0=None, inputs=None,
        save_every: int = 1, stop_outside: bool = False,
    ) -> tuple[Lanes, Any]:  # fmt: skip
        """Advance by ``num_saved`` blocks of ``save_every`` steps.

        Returns the lanes after them, and the saved states (B, num_saved, 2d). params, t0: those
        that the lanes were started with. inputs: of all steps from their start on.
        """
        args = self._schedule(params, lanes.y, t0, inputs)
        return _advance(self, lanes, args, num_saved, save_every, stop_outside)

    def rollout(
        self, z0=None, num_steps: int = 0, *, positions=None, params=None, t0=None, inputs=None,
        dt=None,
        save_every: int = 1, stop_outside: bool = False, samples: int | None = None, key=None,
    ) -> tuple[Any, RolloutInfo]:  # fmt: skip
        """Predict ``num_steps`` steps from z0 (2d,) or (B, 2d), back by the inverse map where the
        number is negative.

        positions: (q, Q) in place of z0, of `from_positions`: the first two positions.
        params: the values of a map's parameters. t0: the time of a drive at z0; it advances with
        the steps. inputs: of each step's begin, (num_steps, k) or (B, num_steps, k), and, as one
        row more, at the last one's end. dt: argument of `over`. samples: number of maps drawn from
        the posterior with key, of ``jax.random``; the states of all of them are in memory at once.
        Returns the states (B, 1 + |num_steps| // save_every, 2d), the initial ones first, and a
        RolloutInfo. With samples its ``bands`` have their std about the states, and quantiles. A
        lane is NaN from where its step fails, or from where it leaves the domain with
        ``stop_outside``. Raises ValueError where a number of steps or a shape is wrong, inputs are
        given backwards, and where samples are asked for without a key or from a map without a
        posterior.
        """
        for name, number in (("num_steps", num_steps), ("save_every", save_every)):
            if not isinstance(number, Integral):
                raise ValueError(f"expected a whole number as {name}, got {number!r}")
        if save_every < 1:
            raise ValueError(f"expected save_every >= 1, got {save_every}")
        if (z0 is None) == (positions is None):
            raise ValueError("expected either states z0 or two positions (q, Q) to start from")
        if positions is not None:
            z0 = self.from_positions(*positions)
        z0 = self._states(z0)
        if num_steps < 0:
            require_no_inputs_backwards(inputs)
            map_ = self if dt is None else self.over(dt, np.shape(z0)[:-1])
            return map_.reversed().rollout(
                z0, -num_steps, params=params, t0=t0, save_every=save_every,
                stop_outside=stop_outside, samples=samples, key=key,
            )  # fmt: skip
        if save_every > num_steps > 0:
            raise ValueError(
                f"expected save_every <= num_steps, got {save_every} and {num_steps}: only the "
                "initial states would be saved"
            )
        map_ = self if dt is None else self.over(dt, z0.shape[:-1])
        args = map_._schedule(params, z0, t0, inputs, num_steps)
        states, info = _rollout(map_, z0, args, num_steps // save_every, save_every, stop_outside)
        if samples is None:
            return states, info
        if key is None:
            raise ValueError("expected a key as well as samples, e.g. key=jax.random.key(0)")
        options = {"params": params, "t0": t0, "inputs": inputs, "save_every": save_every}
        maps, begun = map_.sample(key, samples), np.atleast_2d(z0)
        if positions is not None:  # each with the momentum of its own S
            begun = np.stack([np.atleast_2d(one.from_positions(*positions)) for one in maps])
        drawn, _ = maps.rollout(begun, num_steps, stop_outside=stop_outside, **options)
        found = bands(drawn, states if z0.ndim == 2 else states[None], self.angles_of_z)
        if z0.ndim == 1:
            found = Bands(found.std[0], found.quantiles[:, 0])
        return states, info._replace(bands=found)

    @property
    def angles_of_z(self) -> tuple[int, ...]:
        """Indices of the user's coordinates that are angles."""
        return self.coordinates.angles if self.coordinates.forward is CARTESIAN.forward else ()

    def _args(self, given, z, t0=None, inputs=None):
        """Args of a step of the states z."""
        dtype = np.dtype(self.scale.dtype)
        args = as_args(self.parameters, given, z.shape, dtype, t0)
        if self.signals is not None:
            return self.signals.constant(args, inputs, z.shape, dtype)
        if inputs is not None:
            raise ValueError("expected no inputs: the map was learned without")
        return args

    def _schedule(self, given, z, t0=None, inputs=None, num_steps: int | None = None):
        """Args of rollouts from the states z: of one step for all, or of each of ``num_steps``."""
        if self.signals is None:
            return self._args(given, z, t0, inputs)
        dtype = np.dtype(self.scale.dtype)
        args = as_args(self.parameters, given, z.shape, dtype, t0)
        return self.signals.scheduled(args, inputs, z.shape, dtype, self.dt, num_steps)

    def _after(self, args, steps):
        """Advance args by a number of steps (B,)."""
        if isinstance(args, Scheduled):
            return args.at(self._after(args.params, steps), steps)
        return args if self.parameters is None else self.parameters.after(args, steps, self.dt)

    def _states(self, z):
        dtype = np.dtype(self.scale.dtype)
        if dtype == np.float64:
            require_x64("a float64 map")
        if not isinstance(z, jax.Array):
            z = np.asarray(z, dtype)
        elif z.dtype != dtype:
            z = z.astype(dtype)
        if z.ndim not in (1, 2) or z.shape[-1] != 2 * self.dim:
            raise ValueError(
                f"expected states of shape ({2 * self.dim},) or (B, {2 * self.dim}), got {z.shape}"
            )
        return z

    # Batches of states, by JAX.

    def _angles(self):
        return np.array(self.coordinates.angles, dtype=int)

    def _reduce(self, y, compensation):
        """Reduce the angles of y to their interval: (y, compensation, turns taken out).

        The rounding error of 2π goes to the compensation, so that millions of turns add no drift.
        An angle so large that its last digit exceeds a radian becomes NaN.
        """
        angles = self._angles()
        if not angles.size:
            return y, compensation, jnp.zeros((y.shape[0], 0), y.dtype)
        two_pi, beyond = parts_of_two_pi(y.dtype)
        turns = jnp.round((y[:, angles] - as_row(self.angle_centre, y)) / TWO_PI)
        reduced, lost = two_sum(
            y[:, angles] - turns * two_pi, compensation[:, angles] - turns * beyond
        )
        known = jnp.abs(turns) * float(jnp.finfo(y.dtype).eps) < 1.0
        y = y.at[:, angles].set(jnp.where(known, reduced, jnp.nan))
        return y, compensation.at[:, angles].set(lost), turns

    def _inner(self, z):
        """Convert the user's states to the reduced y, the compensation and the turns taken out."""
        y = jax.vmap(self.coordinates.forward)(z)
        return self._reduce(y, jnp.zeros_like(y))

    def _outer(self, y, turns):
        """Convert the reduced y and its turns to the user's states."""
        angles = self._angles()
        if angles.size:
            two_pi, beyond = parts_of_two_pi(y.dtype)
            y = y.at[:, angles].set((y[:, angles] + turns * beyond) + turns * two_pi)
        return jax.vmap(self.coordinates.inverse)(y)

    def _contains(self, y, args):
        """Return whether states, parameters and dt lie in the ranges of the data (B,)."""
        inside = self.domain.contains(y)
        if self.dt_range is not None:
            low, high = self.dt_range[0] * (1 - _DT_EDGE), self.dt_range[1] * (1 + _DT_EDGE)
            inside = inside & (low <= abs(self.dt)) & (abs(self.dt) <= high)
        if self.parameters is None:
            return inside
        given = args.params if isinstance(args, Scheduled) else args
        return inside & self.parameters.contains(given[..., : len(self.parameters.names)])

    def _apply(self, z, args, *, unrolled: bool | int = False):
        """Step the states z (B, 2d) in the user's coordinates: (Z, Info)."""
        y, _, turns = self._inner(z)
        inside = self._contains(y, args)
        infos = []
        for piece in self.pieces:
            y, info = piece.step(y, args, unrolled=unrolled)
            infos.append(info)
        info = _worst(infos)
        status = jnp.where(info.status == OK, jnp.where(inside, OK, LEFT_DOMAIN), info.status)
        status = jnp.where(jnp.all(jnp.isfinite(y), axis=-1), status, NON_FINITE)
        return self._outer(y, turns), info._replace(status=status.astype(jnp.int32))


def serves_any_dt(piece: Any) -> bool:
    """Return whether a piece can be stepped over any dt."""
    return isinstance(piece, Flow) or (isinstance(piece, Generated) and piece.serves_any_dt)


def parts_of_two_pi(dtype):
    """Split 2π into a number of this dtype and a small rest."""
    near = np.asarray(TWO_PI, dtype)
    return near, TWO_PI - float(near) + _TWO_PI_REST


def _worst(infos: list[Info]) -> Info:
    """Combine the Info of all pieces: the largest status, iterations and residual per lane."""
    return jax.tree.map(lambda *column: jnp.max(jnp.stack(column), axis=0), *infos)


def _or_one_state(function):
    """Extend a function (map, z (B, 2d), args, ...) of a batch to one state z (2d,)."""

    @wraps(function)
    def either(map_, z, args, *static):
        if z.ndim == 2:
            return function(map_, z, args, *static)
        return jax.tree.map(lambda a: a[0], function(map_, z[None], args, *static))

    return either


@compiled_sooner
@_or_one_state
def _step(map_, z, args):
    return map_._apply(z, args)


@partial(compiled_sooner, static_argnums=(3,), seldom_run=True)
@_or_one_state
def _defect(map_, z, args, unrolled):
    multiplier = map_.multiplier(args)
    if multiplier is None:
        return jnp.full(z.shape[0], jnp.nan, z.dtype)

    def tangent(unit):
        step = partial(map_._apply, args=args, unrolled=unrolled)
        return jax.jvp(lambda y: step(y)[0], (z,), (jnp.broadcast_to(unit, z.shape),))[1]

    width = z.shape[1]
    if width > _WIDEST:
        signs = np.random.default_rng(0).choice([-1.0, 1.0], (2 * _TANGENT_PAIRS, width))
        before = jnp.asarray(signs / np.sqrt(width), z.dtype) * map_.scale[None]
        after = jax.vmap(tangent)(before)
        return defect_of_pairs(before[:, None], after, map_.scale, multiplier)
    jacobian = jax.vmap(tangent, out_axes=-1)(jnp.eye(z.shape[1], dtype=z.dtype))
    return symplecticity_defect(jacobian, map_.scale, multiplier)


@compiled_sooner
@_or_one_state
def _linearised(map_, z, args):
    width, signals = z.shape[1], map_.signals
    count = 0 if signals is None else len(signals.names)

    def step(moved):
        acting = args
        if signals is not None:  # the constant coefficients of the inputs come first of theirs
            first = args.shape[-1] - (signals.degree + 1) * count
            acting = jnp.broadcast_to(args, (len(z), args.shape[-1]))
            acting = acting.at[:, first : first + count].add(moved[:, width:])
        return map_._apply(z + moved[:, :width], acting)[0]

    def along(unit):
        at = jnp.zeros((len(z), width + count), z.dtype)
        return jax.jvp(step, (at,), (jnp.broadcast_to(unit, at.shape),))[1]

    both = jax.vmap(along, out_axes=-1)(jnp.eye(width + count, dtype=z.dtype))
    return both[..., :width], both[..., width:]


@compiled_sooner
@_or_one_state
def _hamiltonian(map_, z, args):
    return map_.pieces[0].value(map_._inner(z)[0], args)


@partial(compiled_sooner, seldom_run=True)
@_or_one_state
def _modified(map_, z, args):
    y = map_._inner(z)[0]
    return of_cells(_cells(map_, y, args), _cells(map_.reversed(), y, args), map_.dt)


def _cells(map_, y, args) -> Cells:
    """Compute the cells of the modified Hamiltonian along the steps from y (B, 2d)."""

    def advance(carry, _):
        y, origin = carry
        image, total = y, jnp.zeros(y.shape[:1], y.dtype)
        for piece in map_.pieces:
            before = image
            image, info = piece.step(before, args)
            failed = (info.status > LEFT_DOMAIN)[:, None]
            image = jnp.where(failed, jnp.nan, image)
            total = total + piece.action(before, image, origin, args)
        reduced, _, _ = map_._reduce(image, jnp.zeros_like(image))
        return (reduced, origin + (reduced - image)), Cells(total, image - y, image - origin)

    return jax.lax.scan(advance, (y, y), length=NUM_STEPS)[1]


@compiled_sooner
@_or_one_state
def _determinant(map_, z, args):
    y, _, _ = map_._inner(z)
    found = []
    for piece in map_.pieces:
        image, _ = piece.step(y, args)
        if isinstance(piece, Generated):
            found.append(piece.determinant(y, image, args))
        y = image
    if not found:
        return jnp.full(z.shape[0], jnp.nan, z.dtype)
    found = jnp.stack(found, axis=-1)
    smallest = jnp.argmin(jnp.abs(found), axis=-1)
    return jnp.take_along_axis(found, smallest[:, None], axis=-1)[:, 0]


def _judge(status, inside, stop_outside: bool):
    """Update the status by the domain; only lanes that have not ended can change."""
    outside = STOPPED_AT_EDGE if stop_outside else LEFT_DOMAIN
    return jnp.where((status <= LEFT_DOMAIN) & ~inside, outside, status)


def require_no_inputs_backwards(inputs) -> None:
    """Raise ValueError for inputs of a rollout backwards, where nothing says which come first."""
    if inputs is not None:
        raise ValueError("expected no inputs of a rollout backwards (num_steps below 0)")


def begun(map_, z, args, stop_outside) -> Lanes:
    """Implement `SymplecticMap.start` for states z (B, 2d), inside ``jit``."""
    y, compensation, turns = map_._inner(z)
    inside, finite = map_._contains(y, args), jnp.all(jnp.isfinite(y), axis=-1)
    status = _judge(jnp.where(finite, OK, NON_FINITE), inside, stop_outside)
    count = jnp.zeros(z.shape[0], jnp.result_type(int))
    left_at = jnp.where(inside | ~finite, count - 1, count)
    return Lanes(
        y, compensation, turns.astype(count.dtype), status.astype(jnp.int32), left_at,
        jnp.zeros(z.shape[0], jnp.int32), count,
    )  # fmt: skip


_start = compiled_sooner(begun, (3,))


def advanced(map_, lanes, args, num_saved, save_every, stop_outside) -> tuple[Lanes, Any]:
    """Implement `SymplecticMap.advance` inside ``jit``."""

    def step(lanes: Lanes) -> Lanes:
        going = lanes.status <= LEFT_DOMAIN
        y, compensation = jnp.where(going[:, None], lanes.y, jnp.nan), lanes.compensation
        now, then = map_._after(args, lanes.steps), map_._after(args, lanes.steps + 1)
        infos = []
        for piece in map_.pieces:
            y, compensation, info = piece.compensated_step(y, compensation, now)
            infos.append(info)
        info = _worst(infos)
        y, compensation, turns = map_._reduce(y, compensation)
        inside, finite = map_._contains(y, then), jnp.all(jnp.isfinite(y), axis=-1)
        failed = jnp.where(finite, info.status, NON_FINITE)
        status = jnp.where(failed == OK, _judge(lanes.status, inside, stop_outside), failed)
        status = jnp.where(going, status, lanes.status).astype(jnp.int32)
        leaves = going & (failed == OK) & ~inside & (lanes.left_at < 0)
        winding = jnp.where(jnp.isfinite(turns), turns, 0.0).astype(lanes.winding.dtype)
        return Lanes(
            jnp.where((status <= LEFT_DOMAIN)[:, None], y, jnp.nan),
            compensation,
            lanes.winding + winding,
            status,
            jnp.where(leaves, lanes.steps + 1, lanes.left_at),
            jnp.maximum(lanes.iterations, jnp.where(going, info.iterations, 0)),
            lanes.steps + 1,
        )

    def observe(lanes: Lanes):
        return map_._outer(lanes.y, lanes.winding.astype(lanes.y.dtype))

    lanes, saved = scan_steps(step, lanes, num_saved, save_every=save_every, observe=observe)
    return lanes, jnp.moveaxis(saved, 0, 1)


_advance = compiled_sooner(advanced, (3, 4, 5))


def predicted(map_, z, args, num_saved, save_every, stop_outside) -> tuple[Any, RolloutInfo]:
    """Implement `SymplecticMap.rollout` for states z (B, 2d), inside ``jit``."""
    lanes = begun(map_, z, args, stop_outside)
    lanes, saved = advanced(map_, lanes, args, num_saved, save_every, stop_outside)
    info = RolloutInfo(lanes.status, lanes.left_at, lanes.iterations)
    return jnp.concatenate([z[:, None], saved], axis=1), info


_rollout = compiled_sooner(_or_one_state(predicted), (3, 4, 5))
