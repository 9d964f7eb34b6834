"""Variables of a family: the entries of w or the features that a scene declares, scaled."""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gfnn_jax.arrays import as_row, matmul, namespace, pytree


class _Options:
    """Boxes of inputs, and tests of parity."""

    margin: float = 1.0 + 1e-9  # the data's extremes lie just inside the box
    parity_states: int = 64  # number of states on which the parity of a feature is judged
    chunk: int = 4_096  # states for which features are compiled, whatever the number of data


@pytree("keep", "angles", "width", "features")
class Inputs:
    """Variables x of a family: w without its cyclic entries, or the scene's features, scaled.

    keep:     indices of w that the family depends on (all but the cyclic ones).
    angles:   positions of the angles within the variables; they are neither shifted nor scaled.
    width:    2d, the length of w.
    features: ``features(w)`` -> (k,) for one w (2d,), by JAX, where the family is a function of
              features of w instead of w itself.
    centre, scale: (k,) of the variables, so that the data fill [-1, 1]; any scaling inside S leaves
              the map symplectic. They are leaves of the family's pytree, so that a program compiled
              for one set of data serves the next.
    args_centre, args_scale: (a,) of the args, where the family depends on them. The args are
              variables too, after those of w; no derivative is taken in them.

    Every method takes w of shape (..., 2d), NumPy or JAX, and args (..., a) or (a,).
    """

    keep: tuple[int, ...]
    angles: tuple[int, ...]
    width: int
    centre: Any
    scale: Any
    features: Callable | None = None
    args_centre: Any = None
    args_scale: Any = None

    @property
    def num_args(self) -> int:
        return 0 if self.args_centre is None else self.args_centre.shape[0]

    @property
    def num_variables(self) -> int:
        return self.centre.shape[0] + self.num_args

    @property
    def is_angle(self) -> tuple[bool, ...]:
        """Flag of each variable, True for an angle."""
        return tuple(j in self.angles for j in range(self.num_variables))

    def raw(self, w):
        """Unscaled variables (..., k)."""
        if self.features is not None:
            return self.feature_tables(w, 0)[0]
        return w if len(self.keep) == w.shape[-1] else w[..., np.array(self.keep, dtype=int)]

    def __call__(self, w, args=None):
        """Scaled variables (..., k + a)."""
        return self._scaled(self.raw(w), w, args)

    def tables(self, w, order: int, args=None):
        """Scaled variables (..., k + a), with slopes and curvatures of features in w.

        The slopes (..., k, 2d) need ``order`` ≥ 1, the curvatures (..., k, 2d, 2d) ``order`` 2.
        Both are None for variables that are entries of w.
        """
        if self.features is None:
            return self(w, args), None, None
        raw, *derivatives = self.feature_tables(w, order)
        unit = as_row(namespace(w).asarray(self.scale, dtype=w.dtype), raw)
        slope = derivatives[0] / unit[..., None] if order > 0 else None
        curvature = derivatives[1] / unit[..., None, None] if order > 1 else None
        return self._scaled(raw, w, args), slope, curvature

    def feature_tables(self, w, order: int) -> tuple:
        """Features (..., k), with slopes (..., k, 2d) and curvatures (..., k, 2d, 2d) up to
        ``order``."""
        assert self.features is not None
        return feature_tables(self.features, w, order=order)

    def pull_back_gradient(self, gradient, slope):
        """Gradient in w (..., 2d) from the gradient in x (..., k), by the chain rule."""
        if slope is not None:
            return matmul(gradient[..., None, :], slope)[..., 0, :]
        xp = namespace(gradient)
        return self._spread(
            gradient / as_row(xp.asarray(self.scale, dtype=gradient.dtype), gradient)
        )

    def pull_back_hessian(self, hessian, gradient, slope, curvature):
        """Hessian in w (..., 2d, 2d) from the Hessian in x (..., k, k), by the chain rule."""
        xp = namespace(hessian)
        if slope is not None:
            bent = xp.sum(gradient[..., None, None] * curvature, axis=-3)
            return matmul(matmul(xp.swapaxes(slope, -1, -2), hessian), slope) + bent
        unit = xp.asarray(self.scale, dtype=hessian.dtype)
        hessian = hessian / as_row(unit[:, None] * unit[None, :], hessian)
        return self._spread(xp.swapaxes(self._spread(hessian), -1, -2))

    def pull_back_terms(self, gradients, slope):
        """Gradients of m functions in w (..., 2d, m) from those in x (..., k, m)."""
        xp = namespace(gradients)
        if slope is not None:
            return matmul(xp.swapaxes(slope, -1, -2), gradients)
        unit = xp.asarray(self.scale, dtype=gradients.dtype)[:, None]
        moved = xp.swapaxes(gradients / as_row(unit, gradients), -1, -2)
        return xp.swapaxes(self._spread(moved), -1, -2)

    def _scaled(self, raw, w, args):
        x = _in_box(raw, self.centre, self.scale, w.dtype)
        if self.args_centre is None:
            return x
        xp = namespace(x, args)
        given = _in_box(args, self.args_centre, self.args_scale, w.dtype)
        given = xp.broadcast_to(given, (*x.shape[:-1], self.num_args))
        return xp.concatenate([x, given], axis=-1)

    def _spread(self, values):
        """Place values (..., k) at ``keep`` in (..., 2d), with zeros elsewhere."""
        if len(self.keep) == self.width:
            return values
        xp = namespace(values)
        place = np.full(self.width, len(self.keep))
        place[list(self.keep)] = np.arange(len(self.keep))
        return xp.concatenate([values, xp.zeros_like(values[..., :1])], axis=-1)[..., place]


def _in_box(values, centre, scale, dtype):
    xp = namespace(values)
    centre, scale = (as_row(xp.asarray(side, dtype=dtype), values) for side in (centre, scale))
    return (values - centre) / scale


def feature_tables(features: Callable, w, *, order: int) -> tuple:
    """Features (..., k) at w (..., 2d), with their slopes and curvatures up to ``order``.

    One compiled function of fixed size serves NumPy arrays; JAX arrays are traced.
    """
    if namespace(w) is jnp:
        return _feature_tables(features, order, w)
    flat = w.reshape(-1, w.shape[-1])
    size = min(_Options.chunk, 2 ** max(6, (len(flat) - 1).bit_length()))
    count = max(1, -(-len(flat) // size))
    padded = np.resize(flat, (count * size, w.shape[-1]))  # repeated, or zeros for none
    blocks = [
        _compiled_tables(features, order, block) for block in padded.reshape(-1, size, w.shape[-1])
    ]
    joined = (
        np.concatenate([np.asarray(b) for b in column]) for column in zip(*blocks, strict=True)
    )
    return tuple(a[: len(flat)].reshape(*w.shape[:-1], *a.shape[1:]) for a in joined)


def _feature_tables(features, order, w):
    slope = jax.jacfwd(features)
    functions = (features, slope, jax.jacfwd(slope))[: order + 1]
    flat = w.reshape(-1, w.shape[-1])
    tables = jax.vmap(lambda y: tuple(f(y) for f in functions))(flat)
    return tuple(a.reshape(*w.shape[:-1], *a.shape[1:]) for a in tables)


_compiled_tables = partial(jax.jit, static_argnums=(0, 1))(_feature_tables)


def box_inputs(
    w,
    *,
    angles: tuple[int, ...] = (),
    cyclic: tuple[int, ...] = (),
    features: Callable | None = None,
    reversor: tuple[int, ...] | None = None,
    args=None,
) -> Inputs:
    """Make inputs scaled to the box of the data w (N, 2d), NumPy, and of their ``args`` (N, a).

    reversor: signs of the entries of w. The box is made symmetric about 0 in the coordinates that
    it flips, because an even or odd polynomial has its parity about 0 only.
    """
    w = np.asarray(w)
    keep = tuple(i for i in range(w.shape[-1]) if i not in cyclic)
    plain = Inputs(keep, (), w.shape[-1], np.zeros(0), np.ones(0), features)
    x = plain.raw(w)
    low, high = x.min(axis=0), x.max(axis=0)
    if reversor is not None:
        signs = np.asarray(variable_signs(plain, reversor, w))
        reach = np.maximum(np.abs(low), np.abs(high))
        low, high = np.where(signs < 0, -reach, low), np.where(signs < 0, reach, high)
    centre, scale = 0.5 * (low + high), 0.5 * (high - low) * _Options.margin
    scale = np.where(scale > 0, scale, np.where(centre != 0, np.abs(centre), 1.0))
    positions = tuple(keep.index(i) for i in angles if i in keep) if features is None else ()
    centre[list(positions)], scale[list(positions)] = 0.0, 1.0
    if args is None:
        return Inputs(keep, positions, w.shape[-1], centre, scale, features)
    low, high = np.min(args, axis=0), np.max(args, axis=0)
    of_args = 0.5 * (low + high), 0.5 * (high - low) * _Options.margin
    return Inputs(keep, positions, w.shape[-1], centre, scale, features, *of_args)


def variable_signs(inputs: Inputs, reversor: tuple[int, ...], w) -> tuple[int, ...]:
    """Sign of each variable x under the reversor: x(ρw) = ±x(w), judged on the data w (N, 2d).

    Raises ValueError for a feature that is neither even nor odd.
    """
    w = np.asarray(w)[: _Options.parity_states]
    x, flipped = inputs.raw(w), inputs.raw(w * np.asarray(reversor, w.dtype))
    size = np.abs(x).max(axis=0) + 1e-300
    even = np.abs(flipped - x).max(axis=0) / size
    odd = np.abs(flipped + x).max(axis=0) / size
    if (np.minimum(even, odd) > 1e-9).any():
        bad = int(np.argmax(np.minimum(even, odd)))
        raise ValueError(
            f"expected features that are even or odd under the reversor {reversor}; "
            f"feature {bad} (counted from 0) is neither: change it, or declare no reversor"
        )
    return tuple(np.where(even <= odd, 1, -1).tolist())
