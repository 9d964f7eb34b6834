"""What a generating function sees of w: the variables a scene leaves it, scaled from the data."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

_MARGIN = 1.0 + 1e-9  # the data's extremes lie just inside the box


@partial(
    jax.tree_util.register_dataclass,
    data_fields=("centre", "scale"),
    meta_fields=("keep", "angles", "features"),
)
@dataclasses.dataclass(frozen=True)
class Inputs:
    """The variables x of S: w without its cyclic entries, or the scene's features, scaled.

    keep:     indices of w that S sees (all but the cyclic ones).
    angles:   positions within the variables that are angles; they are neither shifted nor scaled.
    features: ``features(w)`` -> (k,), where S is a function of features of w instead of w itself.
    centre, scale: of the variables, so that the data fill [-1, 1]; any scaling inside S leaves the
              map symplectic. They are leaves of the pytree that a family is: what is compiled for
              one set of data serves the next.
    """

    keep: tuple[int, ...]
    angles: tuple[int, ...]
    centre: tuple[Any, ...]
    scale: tuple[Any, ...]
    features: Callable | None = None

    @property
    def num_variables(self) -> int:
        return len(self.centre)

    def raw(self, w):
        """The unscaled variables (k,) at w (2d,)."""
        return self.features(w) if self.features is not None else w[np.array(self.keep)]

    def __call__(self, w):
        """The scaled variables (k,) at w (2d,)."""
        centre, scale = (jnp.stack([jnp.asarray(c, w.dtype) for c in side])
                         for side in (self.centre, self.scale))  # fmt: skip
        return (self.raw(w) - centre) / scale


def box_inputs(
    w,
    *,
    angles: tuple[int, ...] = (),
    cyclic: tuple[int, ...] = (),
    features: Callable | None = None,
    reversor: tuple[int, ...] | None = None,
) -> Inputs:
    """Inputs whose box is that of the data w (N, 2d).

    ``reversor`` (signs of the entries of w): the box is made symmetric about 0 in the coordinates
    that it flips, because an even or odd polynomial is so about 0 and nowhere else.
    """
    keep = tuple(i for i in range(w.shape[-1]) if i not in cyclic)
    plain = Inputs(keep, (), (0.0,) * len(keep), (1.0,) * len(keep), features)
    x = np.asarray(jax.vmap(plain.raw)(jnp.asarray(w)))
    low, high = x.min(axis=0), x.max(axis=0)
    if reversor is not None:
        signs = np.asarray(variable_signs(plain, reversor, w))
        reach = np.maximum(np.abs(low), np.abs(high))
        low, high = np.where(signs < 0, -reach, low), np.where(signs < 0, reach, high)
    centre, scale = 0.5 * (low + high), 0.5 * (high - low) * _MARGIN
    scale = np.where(scale > 0, scale, np.where(centre != 0, np.abs(centre), 1.0))
    positions = tuple(keep.index(i) for i in angles if i in keep) if features is None else ()
    for i in positions:
        centre[i], scale[i] = 0.0, 1.0
    return Inputs(keep, positions, tuple(map(float, centre)), tuple(map(float, scale)), features)


def variable_signs(inputs: Inputs, reversor: tuple[int, ...], w) -> tuple[int, ...]:
    """The sign of each variable under the reversor: f(ρw) = ±f(w), judged on the data w (N, 2d).

    Raises ValueError for a feature that is neither even nor odd.
    """
    w = jnp.asarray(w)[:64]
    x = np.asarray(jax.vmap(inputs.raw)(w))
    flipped = np.asarray(jax.vmap(inputs.raw)(w * jnp.asarray(reversor, w.dtype)[None, :]))
    size = np.abs(x).max(axis=0) + 1e-300
    even = np.abs(flipped - x).max(axis=0) / size
    odd = np.abs(flipped + x).max(axis=0) / size
    if (np.minimum(even, odd) > 1e-9).any():
        bad = int(np.argmax(np.minimum(even, odd)))
        raise ValueError(
            f"expected features that are even or odd under the reversor {reversor}; "
            f"feature {bad} is neither"
        )
    return tuple(np.where(even <= odd, 1, -1).tolist())
