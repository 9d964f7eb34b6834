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
from functools import cached_property
from numbers import Integral
from typing import Any

import jax
import numpy as np
from jax.core import Tracer

from gfnn_jax.arrays import pytree
from gfnn_jax.brackets import Bracket
from gfnn_jax.coordinates import Coordinates
from gfnn_jax.families.displacements import OfDisplacement
from gfnn_jax.generating.charts import TYPE1
from gfnn_jax.maps import energy, programs
from gfnn_jax.maps.domain import Domain, Ranges
from gfnn_jax.maps.inputs import Signals
from gfnn_jax.maps.lanes import (
    Lanes,
    RolloutInfo,
    Saving,
    advance_lanes,
    require_no_inputs_backwards,
    roll_out,
    start_lanes,
)
from gfnn_jax.maps.modified_hamiltonian import ModifiedHamiltonian
from gfnn_jax.maps.parameters import Parameters, as_args
from gfnn_jax.maps.piece import FLOWS, PieceWithAction, serves_any_dt
from gfnn_jax.maps.posterior import Bands, Posterior, bands
from gfnn_jax.maps.samples import sampled
from gfnn_jax.maps.sensors import Sensors
from gfnn_jax.maps.sharded import Sharded, local_devices
from gfnn_jax.phase_space import require_x64


@pytree("coordinates", "signals", dropped=("posterior", "sensors"), repr=False)
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
    bracket:      bracket of the user's coordinates (n,) where these are no (q, p), or None.
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
    bracket: Bracket | None = None

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

    @property
    def width(self) -> int:
        """Number of coordinates of a state: 2d, or n of a bracket."""
        return self.scale.shape[-1]

    def save(self, folder, **options) -> None:
        """Write a model folder, which ``gfnn.load`` reads; options: those of `maps.saved.save`."""
        from gfnn_jax.maps import saved  # stands after this module: a shorthand for its function

        saved.save(self, folder, **options)

    def sample(self, key, num: int):
        """Draw ``num`` maps from the posterior, each symplectic: `maps.samples.Samples`."""
        return sampled(self, key, num)

    def sharded(self, devices: int | str = "all"):
        """Share rollouts of this map out among devices of this process: `maps.sharded.Sharded`.

        devices: "all", or the number of devices, the first ones.
        """
        return Sharded(self, local_devices(devices))

    def step(self, z, args=None, *, dt=None, t0=None, inputs=None):
        """Make one step: (Z, Info); Info's leaves are () or (B,). dt: argument of `over`. inputs:
        that act during the step."""
        z = self._states(z)
        map_ = self if dt is None else self.over(dt, z.shape[:-1])
        args = self._args(args, z, t0, inputs)
        followed = map_._followed(z, args)
        return programs.step(map_, z, args) if followed is None else followed.step(z, args)

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
        return programs.step(self.reversed(), z, args)

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
                f"this is a map of dt = {float(np.asarray(self.dt)):g} only. Fit a law "
                "(learn='hamiltonian'), or S to pairs of several dt"
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
        if not self.of_positions:
            raise ValueError(
                "expected a map that was learned from positions alone, whose S is one of (q, Q)"
            )
        dtype = np.dtype(self.scale.dtype)
        q, other = np.asarray(q, dtype), np.asarray(other, dtype)
        if q.shape != other.shape or q.ndim not in (1, 2) or q.shape[-1] != self.dim:
            raise ValueError(
                f"expected two positions of shape ({self.dim},) or (B, {self.dim}), got {q.shape} "
                f"and {other.shape}"
            )
        own = jax.tree.map(np.asarray, self.pieces[0])
        w = np.concatenate([q, own.family.lifted(q, other)], axis=-1)
        p = -own.dt * own.family.gradient(own.params, w)[..., : self.dim]
        return jax.device_put(np.concatenate([q, p], axis=-1))

    @property
    def of_positions(self) -> bool:
        """True for a map that was learned from positions alone: its S is one of q and Q."""
        ours = isinstance(getattr(self.pieces[0], "family", None), OfDisplacement)
        return ours and len(self.pieces) == 1 and self.pieces[0].chart == TYPE1

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
        pieces, dt = (*self.pieces, *other.pieces), self.dt + other.dt
        return dataclasses.replace(self, pieces=pieces, dt=dt, parameters=ours, dt_range=dt_range)

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
            args = as_args(self.parameters, args, (*lanes, self.width), dtype)
            return jax.tree.map(np.asarray, self).multiplier(np.asarray(args))
        factors = [piece.multiplier(args) for piece in self.pieces]
        return None if any(factor is None for factor in factors) else math.prod(factors, start=1.0)

    def defect(self, z, args=None, *, t0=None, iterations=None):
        """Symplecticity defect ‖AᵀJA − μJ‖ () or (B,) of the step's derivative A at z; of a bracket
        ‖A B(z) Aᵀ − μ B(Z)‖ relative to that of B(Z).

        It is in units of ``scale``, μ the multiplier; NaN where there is none.

        The derivative is the unrolled one, by forward differentiation through the iterations that
        ran. That of the implicit rule would look symplectic however badly the solve had converged.
        For many degrees of freedom the defect is estimated by random pairs of tangent vectors.
        iterations: updates of the steps from z, where they were stepped before; else they are now.
        """
        z = self._states(z)
        args = self._args(args, z, t0)
        ran = programs.step(self, z, args)[1].iterations if iterations is None else iterations
        # A single update is the usual case; its derivative compiles in half the time.
        once = not isinstance(ran, Tracer) and np.max(np.asarray(ran), initial=0) <= 1
        return programs.defect(self, z, args, 1 if once else True)

    def determinant(self, z, args=None, *, t0=None):
        """Chart determinant () or (B,) at z, the smallest of all pieces; NaN without a chart."""
        z = self._states(z)
        return programs.determinant(self, z, self._args(args, z, t0))

    def hamiltonian(self, z, args=None, *, t0=None):
        """Hamiltonian H () or (B,) at z.

        It is the learned one where the map is the flow of a Hamiltonian. For any other map it is
        the modified Hamiltonian, whose error ``modified_hamiltonian`` gives.
        """
        if len(self.pieces) != 1 or not isinstance(self.pieces[0], FLOWS):
            return self.modified_hamiltonian(z, args).value
        z = self._states(z)
        return programs.hamiltonian(self, z, self._args(args, z, t0))

    def power(self, z, args=None, *, inputs=None):
        """Energy per unit of time at z: ``lost`` (..., F) by each friction and ``supplied``
        (..., k) by each input: `maps.energy`. Raises ValueError for a map that is no flow."""
        return energy.power_of(self, z, args, inputs)

    @cached_property
    def law_in_use(self):
        """Law of a map that was learned from a recording, with its sensors: `maps.estimates.Law`,
        made once."""
        from gfnn_jax.maps import estimates  # stands after this module: loaded when first used

        return estimates.law_of(self)

    def estimate(self, recording) -> tuple[np.ndarray, np.ndarray]:
        """States z = (q, p) (runs, 2d) at each run's last time and their covariance (runs, 2d, 2d),
        from the samples of the recording before it: `maps.forecasts`.
        Raises InputError for a map that was not learned from a recording, or where columns or
        samples are missing."""
        from gfnn_jax.maps import forecasts  # stands after this module: loaded when first used

        return forecasts.estimate(self, recording)

    def forecast(self, recording, times, inputs=None, *, coverage=None, simultaneous=False):
        """`maps.forecasts.Forecast` at ``times`` (n,), the recording's clock, in its units, from
        the state at each run's end; ``inputs`` are a recording of those ahead, matched by run where
        it has several. ``coverage`` asks for a band, ``lower`` to ``upper``, with half widths
        ``band``, that holds a reading with this probability, or with ``simultaneous`` all readings
        of a run at these times (0.95 where no coverage is given), by the largest errors of
        forecasts of held-out data.
        Raises InputError as `estimate` does, for times before a run's end, a coverage outside
        (0, 1), and of a map of positions alone for times between its steps and simultaneous
        bands."""
        from gfnn_jax.maps import forecasts  # stands after this module: loaded when first used

        asked = forecasts.Asked(coverage, simultaneous)
        return forecasts.forecast(self, recording, times, inputs, asked).in_units_of(recording)

    def with_friction_level(self, size: float) -> SymplecticMap:
        """The map whose estimates and forecasts find the strength of friction anew, a factor of all
        of it, from the samples before them.

        size: its standard deviation from record to record, relative, which one record does not
        tell: 0.03 of a drive on another day. Raises ValueError for a map that was not learned from
        a recording, and a size that is no number > 0.

            warm = fit.map.with_friction_level(0.03)
            warm.forecast(recording, times, inputs)  # two periods of samples or more
        """
        if self.sensors is None or not 0 < size < math.inf:
            raise ValueError(f"expected a map of a recording and a size > 0, got {size}")
        return dataclasses.replace(self, sensors=self.sensors.with_level(float(size)))

    def linearise(self, z, inputs=None, args=None, *, t0=None):
        """(A, B) of a step: ∂Z/∂z (..., 2d, 2d) and ∂Z/∂u (..., 2d, k), inputs u, (k,) or (B, k),
        that do not change during the step."""
        z = self._states(z)
        return programs.linearised(self, z, self._args(args, z, t0, inputs))

    def inverse_dynamics(self, q, v, a, args=None):
        """`maps.laws.InverseDynamics` of positions, velocities and accelerations (..., d): the
        forces that make this motion against the law's friction, and the inputs that do.

        Angles are in radians; args are the parameters of the system, where the law depends on some.
        Friction that holds a body at rest is counted as 0 there. Raises ValueError for other shapes
        and for a map that is no flow of a Lagrangian.
        ``fit.map.inverse_dynamics(q, v, a).inputs`` are the torques of a robot's motion."""
        from gfnn_jax.maps import laws  # stands after this module

        return laws.inverse_dynamics(self, q, v, a, args)

    def mass_matrix(self, q, args=None):
        """M(q) (..., d, d) of positions (..., d), in the unit of L: as `inverse_dynamics`."""
        from gfnn_jax.maps import laws  # stands after this module

        return laws.mass_matrix(self, q, args)

    def modified_hamiltonian(self, z, args=None) -> ModifiedHamiltonian:
        """Value and error, each () or (B,), of the Hamiltonian H̃ whose flow over dt is this map.

        Both are in units of H; the constant is that of S. They come from 32 steps to either side of
        z (`maps.modified_hamiltonian`). The error is small where the orbit turns slowly against a
        step (Hénon–Heiles: 1e-12 at dt 0.4, 1e-8 at 0.8), and as large as H̃ for a map that is near
        no flow. Both are NaN where one of these steps fails. Raises ValueError for a driven map,
        and for one with friction, which conserve no energy.
        """
        if self.bracket is not None:
            raise ValueError(
                "expected a map of canonical (q, p); the flow of a law with a bracket has "
                "map.hamiltonian"
            )
        if self.parameters is not None and self.parameters.period is not None:
            raise ValueError("expected a map without a drive: a driven one conserves no energy")
        multiplier = self.multiplier()
        if not (isinstance(multiplier, float) and multiplier == 1.0):
            raise ValueError("expected a map without friction: one with it conserves no energy")
        without = [type(p).__name__ for p in self.pieces if not isinstance(p, PieceWithAction)]
        if without:
            raise ValueError(
                "the modified Hamiltonian is made of the action of each piece: "
                f"{without[0]} has none"
            )
        z = self._states(z)
        return programs.modified(self, z, self._args(args, z))

    def start(self, z0, *, params=None, t0=None, stop_outside: bool = False) -> Lanes:
        """Start lanes at step 0 from z0 (B, 2d). States outside the domain have that status."""
        z0 = self._states(z0)
        return start_lanes(self, z0, self._args(params, z0, t0), stop_outside)

    def advance(
        self,
        lanes: Lanes,
        num_saved: int,
        *,
        params=None,
        t0=None,
        inputs=None,
        save_every: int = 1,
        stop_outside: bool = False,
    ) -> tuple[Lanes, Any]:
        """Advance by ``num_saved`` blocks of ``save_every`` steps.

        Returns the lanes after them, and the saved states (B, num_saved, 2d). params, t0: those
        that the lanes were started with. inputs: of all steps from their start on. Raises
        ValueError for anything but lanes, as for states.
        """
        if not isinstance(lanes, Lanes):
            raise ValueError(
                "expected lanes of map.start or map.advance, got states: map.rollout takes these, "
                "and jax.grad passes through it"
            )
        args = self._schedule(params, lanes.y, t0, inputs)
        saving = Saving(num_saved, save_every, stop_outside)
        followed = self._followed(lanes, args)
        if followed is not None:
            return followed.advance(lanes, args, saving)
        return advance_lanes(self, lanes, args, saving)

    def rollout(
        self,
        z0=None,
        num_steps: int = 0,
        *,
        positions=None,
        params=None,
        t0=None,
        inputs=None,
        dt=None,
        save_every: int = 1,
        stop_outside: bool = False,
        samples: int | None = None,
        key=None,
    ) -> tuple[Any, RolloutInfo]:
        """Predict ``num_steps`` steps from z0 (2d,) or (B, 2d), back by the inverse map where the
        number is negative.

        positions: (q, Q) in place of z0, of `from_positions`: the first two positions.
        params: the values of a map's parameters. t0: the time of a drive at z0; it advances with
        the steps. inputs: of each step's begin, (num_steps, k) or (B, num_steps, k), and, as one
        row more, at the last one's end. dt: argument of `over`. samples: number of maps drawn from
        the posterior with key, of ``jax.random``; the states of all of them are in memory at once.
        Returns the states (B, 1 + |num_steps| // save_every, 2d), the initial ones first, and a
        RolloutInfo. Dry friction of a law of a recording holds bodies that stop, as in forecasts,
        where all that is given are numbers and the time goes forward; under ``jit``, ``grad`` and
        ``vmap``, backwards and over several devices it is smoothed, and they creep by less than the
        noise of a position in a period. With samples its ``bands`` have their std about the states,
        and quantiles. A lane is NaN from where its step fails, or from where it leaves the domain
        with ``stop_outside``. Raises ValueError where a number of steps or a shape is wrong, inputs
        are given backwards, and where samples are asked for without a key or from a map without a
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
        map_ = self if dt is None else self.over(dt, np.shape(z0)[:-1])
        options = {"params": params, "t0": t0, "save_every": save_every}
        options["stop_outside"] = stop_outside
        if num_steps < 0:
            require_no_inputs_backwards(inputs)
            return map_.reversed().rollout(z0, -num_steps, samples=samples, key=key, **options)
        if save_every > num_steps > 0:
            raise ValueError(
                f"expected save_every <= num_steps, got {save_every} and {num_steps}: only the "
                "initial states would be saved"
            )
        args = map_._schedule(params, z0, t0, inputs, num_steps)
        saving = Saving(num_steps // save_every, save_every, stop_outside)
        followed = map_._followed(z0, args)
        if followed is None:
            from gfnn_jax.maps import compiled_rollouts  # stands after this module

            compiled = compiled_rollouts.roll_out(map_, z0, args, saving)
            states, info = roll_out(map_, z0, args, saving) if compiled is None else compiled
        else:
            states, info = followed.roll_out(z0, args, saving)
        if samples is None:
            return states, info
        if key is None:
            raise ValueError("expected a key as well as samples, e.g. key=jax.random.key(0)")
        maps, begun = map_.sample(key, samples), np.atleast_2d(z0)
        if positions is not None:  # each with the momentum of its own S
            begun = np.stack([np.atleast_2d(one.from_positions(*positions)) for one in maps])
        drawn, _ = maps.rollout(begun, num_steps, inputs=inputs, **options)
        found = bands(drawn, states if z0.ndim == 2 else states[None], self.angles_of_z)
        if z0.ndim == 1:
            found = Bands(found.std[0], found.quantiles[:, 0], found.tube[0])
        return states, info._replace(bands=found)

    @property
    def angles_of_z(self) -> tuple[int, ...]:
        """Indices of the user's coordinates that are angles."""
        return self.coordinates.user_angles

    def _followed(self, *given):
        """The law of a recording as it is followed with its dry friction on the numbers ``given``,
        `maps.events.Followed`, or None: then steps are JAX's."""
        if self.sensors is None:
            return None
        from gfnn_jax.maps import events  # stands after this module: loaded when first used

        return events.followed(self, *given)

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

    def _states(self, z):
        dtype = np.dtype(self.scale.dtype)
        if dtype == np.float64:
            require_x64("a float64 map")
        if not isinstance(z, jax.Array):
            z = np.asarray(z, dtype)
        elif z.dtype != dtype:
            z = z.astype(dtype)
        if z.ndim not in (1, 2) or z.shape[-1] != self.width:
            raise ValueError(
                f"expected states of shape ({self.width},) or (B, {self.width}), got {z.shape}"
            )
        return z
