"""States z = (q, p), the symplectic form J, pairs of states, and how symplectic a Jacobian is.

Positions come first, always: ``z[:d]`` is q and ``z[d:]`` is p. ``dim`` is the number d of
degrees of freedom, never 2d.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float

from gfnn_jax.arrays import matmul, namespace
from gfnn_jax.errors import FitError

# The axis of length 2d is called phase: jaxtyping would read "2d" as an expression.
Scalar = Float[Array, ""]
State = Float[Array, "phase"]
States = Float[Array, "batch phase"]
POISSON = "poisson"  # structure of pairs whose states are no (q, p)
TIME = "t"  # the name, among args, of the time of a drive; it is the last of them


def require_x64(what: str) -> None:
    """Raise RuntimeError where JAX would silently compute ``what`` in float32."""
    if not jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue]
        raise RuntimeError(
            f"{what} needs float64: call jax.config.update('jax_enable_x64', True) first"
        )


def split(z):
    """Split z of shape (..., 2d) into q and p of shape (..., d). NumPy or JAX arrays."""
    dim = z.shape[-1] // 2
    return z[..., :dim], z[..., dim:]


def sizes(z):
    """Size of each column of z (N, k), in NumPy: its standard deviation.

    The size of a constant column is its magnitude, or 1 where it is zero.
    """
    z = np.asarray(z)
    deviation, largest = z.std(axis=0), np.abs(z).max(axis=0)
    # The deviation of a constant column is roundoff, not zero.
    constant = deviation <= 1e-14 * largest
    return np.where(constant, np.where(largest > 0, largest, 1.0), deviation)


def apply_j(g):
    """J g for gradients g of shape (..., 2d), NumPy or JAX: (g_q, g_p) -> (g_p, -g_q)."""
    dim = g.shape[-1] // 2
    return namespace(g).concatenate([g[..., dim:], -g[..., :dim]], axis=-1)


def area(z, moved):
    """Area ½ (p·δq − q·δp) (...) of states z and changes δ (..., 2d), NumPy or JAX.

    It is the integral of ½ (p dq − q dp) along the straight line from z to z + δ.
    """
    return -0.5 * namespace(z, moved).sum(z * apply_j(moved), axis=-1)


def symplectic_form(dim: int) -> Float[np.ndarray, "phase phase"]:
    """Matrix J of shape (2d, 2d), float64 NumPy."""
    zero, one = np.zeros((dim, dim)), np.eye(dim)
    return np.block([[zero, one], [-one, zero]])


def symplecticity_defect(jacobian, scale=None, multiplier: Any = 1.0):
    """Largest entry of Mᵀ J M − μJ in magnitude, (...), for Jacobians M of shape (..., 2d, 2d).

    ``scale`` (2d,) makes the coordinates unit-sized first: z = scale * y. The form that M must
    preserve is then J with the entry (q_i, p_i) multiplied by scale_q,i * scale_p,i; the defect is
    divided by the largest such product, so that it is a pure number. multiplier: μ, a number or one
    of each Jacobian (...); 1 of a symplectic map. NumPy or JAX.
    """
    xp = namespace(jacobian)
    form = xp.asarray(symplectic_form(jacobian.shape[-1] // 2), dtype=jacobian.dtype)
    weighted = form
    if scale is not None:
        scale = xp.asarray(scale, dtype=jacobian.dtype)
        jacobian = jacobian * scale.reshape((1,) * (jacobian.ndim - 1) + scale.shape)  # dZ/dy
        weighted = form * (scale[:, None] * scale[None, :])
    pulled_back = matmul(xp.swapaxes(jacobian, -1, -2), matmul(form, jacobian))
    kept = weighted.reshape((1,) * (jacobian.ndim - 2) + weighted.shape)
    each = multiplier[..., None, None] if np.ndim(multiplier) else multiplier
    defect = pulled_back - each * kept
    return xp.max(xp.abs(defect), axis=(-2, -1)) / xp.max(xp.abs(weighted))


def defect_of_pairs(before, after, scale, multiplier: Any = 1.0):
    """Largest |after_uᵀ J after_v − μ before_uᵀ J before_v| (...) over pairs (u, v) of tangents.

    before, after: tangent vectors (2k, ..., 2d); u runs over the first half, v over the second.
    The result is divided by the largest product of scale_q and scale_p, scale (2d,). For tangents
    of random signs, of length 1 in units of ``scale``, it is about ‖MᵀJM − J‖ ÷ √(2d) in
    Frobenius' norm, the size of a row. NumPy or JAX.
    """
    xp, half, dim = namespace(after), len(before) // 2, len(scale) // 2
    form = [xp.sum(t[:half] * apply_j(t[half:]), axis=-1) for t in (after, before)]
    size = xp.max(scale[:dim] * scale[dim:])
    return xp.max(xp.abs(form[0] - multiplier * form[1]), axis=0) / size


def hamiltonian_vector_field(hamiltonian: Callable) -> Callable:
    """Vector field ``field(z, t=0.0)`` = J ∇H(z, t) (2d,), the right-hand side of paper eq. (1)."""

    def field(z, t=0.0):
        return apply_j(jax.grad(hamiltonian)(z, t))

    return field


@jax.tree_util.register_pytree_node_class
@dataclasses.dataclass(frozen=True)
class Pairs:
    """States and their images one time step later, the data from which a map is learned.

    z0, z1: shape (N, 2d), q first; NumPy or JAX arrays. dt: the time between them (the paper's h),
    in the user's unit of time; 1 for a map that has no time. One number, or one per pair (N,).
    args: parameters of the system in which each pair was measured, name -> (N,); an array (N, k) or
    (N,) holds parameters that are named a1, a2, …
    t0, period: of a driven system, the time of z0 (N,), or one for all pairs, and the period of the
    drive. t0 is also one of the args, by the name t.
    run: the run (trajectory, sequence) of each pair, (N,) numbers or text. place: the number of z0
    along its run, (N,) integers. A fit sorts pairs that have a run by run and place. Where places
    are missing, it finds them by the images that are states of other pairs.
    std: standard deviation of the noise on each measured coordinate, (2d,), or on each value of
    both states of a pair, (N, 2d), in the user's units: the fits of S and H weight pairs by those
    of each value. With None it is estimated.
    structure: "poisson" of states z (N, n), n ≥ 2, that are no (q, p), as angular velocities or
    populations: the bracket is then learned too. names: of their coordinates; () for z1 … zn.

    Raises FitError where the arrays do not have these shapes.
    """

    z0: Any
    z1: Any
    dt: Any
    args: Any = None
    t0: Any = None
    period: float | None = None
    run: Any = None
    place: Any = None
    std: Any = None
    structure: str | None = None
    names: tuple[str, ...] = ()

    def __post_init__(self):
        if self.structure not in (None, POISSON):
            raise FitError(f"expected structure 'poisson' or None, got {self.structure!r}")
        # JAX makes pairs of whatever it maps arrays to; a user's are lists or arrays.
        kinds = {type(z).__name__ for z in (self.z0, self.z1) if isinstance(z, (list, tuple))}
        if kinds:
            raise FitError(f"expected arrays z0 and z1 of shape (N, 2d), got a {kinds.pop()}")
        if not all(isinstance(z, (np.ndarray, jax.Array)) for z in (self.z0, self.z1)):
            return
        self._check_shapes()
        if isinstance(self.dt, (list, tuple, np.ndarray, jax.Array)):
            self._set("dt", np.asarray(self.dt) if np.ndim(self.dt) else self.dt)
            if np.ndim(self.dt) and np.shape(self.dt) != (len(self),):
                raise FitError(
                    f"expected dt as one number or one per pair ({len(self)},), got shape "
                    f"{np.shape(self.dt)}"
                )
        if self.args is not None:
            self._set("args", _named(self.args, len(self)))
        if self.t0 is not None or TIME in (self.args or {}):
            self._set_time()
        self._set_identities()
        if self.std is not None and not isinstance(self.std, jax.Array):
            self._set("std", np.asarray(self.std, np.float64))
            width = self.z0.shape[1]
            if self.std.shape not in ((width,), (len(self), width)):
                raise FitError(
                    f"expected std of shape ({width},), one of each coordinate, or "
                    f"({len(self)}, {width}), one of each value, got {self.std.shape}"
                )
            if not (np.isfinite(self.std) & (self.std > 0)).all():
                raise FitError("expected every std finite and above 0; leave std out if unknown")

    def _check_shapes(self) -> None:
        """Raise FitError where states and images are no (N, 2d), or (N, n) of a bracket."""
        width, any_width = self.z0.shape[-1], self.structure == POISSON
        if self.z0.shape != self.z1.shape or self.z0.ndim != 2 or width < 2:
            shape = "(N, n), n ≥ 2" if any_width else "(N, 2d)"
            raise FitError(
                f"expected z0 and z1 of one shape {shape}, got {self.z0.shape} and {self.z1.shape}"
            )
        if width % 2 and not any_width:
            raise FitError(
                f"{width} columns are no positions and momenta (q, p). Of states with another "
                'bracket, as angular velocities: gfnn.Pairs(z0, z1, dt, structure="poisson")'
            )
        if self.names and len(self.names) != width:
            raise FitError(f"expected {width} names of coordinates, got {len(self.names)}")

    def _set_identities(self) -> None:
        """Make ``run`` and ``place`` arrays (N,). Raises FitError on other shapes or types."""
        if self.place is not None and self.run is None:
            raise FitError("expected run as well as place: a place is counted along a run")
        kinds_of = {"run": ("iufUSO", "numbers or text"), "place": ("iu", "integers")}
        for name, (kinds, what) in kinds_of.items():
            given = getattr(self, name)
            if given is None or (isinstance(given, jax.Array) and given.shape == (len(self),)):
                continue
            values = np.asarray(given)
            if values.shape != (len(self),) or values.dtype.kind not in kinds:
                got = f"{values.dtype} of shape {values.shape}"
                raise FitError(f"expected {name} as {what} of shape ({len(self)},), got {got}")
            self._set(name, values.astype(str) if values.dtype.kind in "SO" else values)

    def _set_time(self) -> None:
        """Store the time of the drive both as ``t0`` and as the last of the args."""
        others = {name: values for name, values in (self.args or {}).items() if name != TIME}
        t0: Any = (self.args or {})[TIME] if self.t0 is None else self.t0
        if np.ndim(t0) == 0:
            t0 = np.full(len(self), t0)
        args = _named({**others, TIME: t0}, len(self))
        self._set("args", args)
        self._set("t0", args[TIME])

    def _set(self, name: str, value: Any) -> None:
        object.__setattr__(self, name, value)

    def tree_flatten(self):
        """Return the arrays as leaves; one dt for all pairs and names of runs are static."""
        own = bool(np.ndim(self.dt))
        text = isinstance(self.run, np.ndarray) and self.run.dtype.kind == "U"
        run = (None, tuple(self.run.tolist())) if text else (self.run, None)
        leaves = (self.z0, self.z1, self.args, run[0], self.place, self.std)
        leaves = (*leaves, self.dt) if own else leaves
        return leaves, (None if own else self.dt, self.period, run[1], (self.structure, self.names))

    @classmethod
    def tree_unflatten(cls, fixed, leaves) -> Pairs:
        """Invert ``tree_flatten``."""
        (dt, period, runs, own_kind), (z0, z1, args, run, place, std, *own) = fixed, leaves
        run = run if runs is None else np.array(runs)
        structure, names = own_kind
        about = {"period": period, "structure": structure, "names": names}
        return cls(z0, z1, own[0] if own else dt, args, **about, run=run, place=place, std=std)

    def __len__(self) -> int:
        return self.z0.shape[0]

    @property
    def dim(self) -> int:
        """Number d of degrees of freedom."""
        return self.z0.shape[-1] // 2

    def take(self, rows) -> Pairs:
        """Select the pairs of these rows (an index array or a slice)."""
        dt = self.dt[rows] if np.ndim(self.dt) else self.dt
        args = self.args and {name: values[rows] for name, values in self.args.items()}
        run, place = (None if of is None else of[rows] for of in (self.run, self.place))
        std = self.std[rows] if np.ndim(self.std) == 2 else self.std
        states = {"z0": self.z0[rows], "z1": self.z1[rows], "dt": dt, "t0": None, "args": args}
        return dataclasses.replace(self, **states, run=run, place=place, std=std)


def _named(args: Any, count: int) -> dict[str, Any]:
    """Return the parameters by name, each (N,). Raises FitError on other shapes."""
    if not isinstance(args, Mapping):
        if np.ndim(args) not in (1, 2) or len(args) != count:
            got = f"got {type(args).__name__} of shape {np.shape(args)}"
            raise FitError(
                f"expected args as name -> ({count},) or as an array ({count}, k), {got}"
            )
        columns = np.asarray(args).reshape(count, -1).T
        return {f"a{i + 1}": column for i, column in enumerate(columns)}
    found = {name: np.asarray(values) for name, values in args.items()}
    for name, values in found.items():
        if values.dtype != object and values.shape != (count,):
            raise FitError(f"expected args['{name}'] of shape ({count},), got {values.shape}")
    return found
