"""S as a multilayer perceptron: the paper's networks and similar ones. The one home of Flax.

    S(θ, w) = s N_θ(x),        x the scaled variables of ``Inputs``, each angle as (cos, sin)

N_θ has unit size in any units of the data: ``Inputs`` scales its input and s its output. Any such
scaling inside S leaves the map symplectic.
"""

from collections.abc import Callable
from functools import partial
from itertools import pairwise
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gfnn_jax.arrays import pytree
from gfnn_jax.families.family import DifferentiatedByJax, OfCoefficients
from gfnn_jax.families.inputs import Inputs

# More accurate than the paper's shapes after a training of the same time, and three times smaller.
DEFAULT_HIDDEN = (64, 64, 64)
# Paper, Experimental Details.
PAPER_HIDDEN = (200, 100, 50, 20)
PAPER_HIDDEN_STANDARD_MAP = (500, 500, 200, 20)

# ∇S is what is fitted and its own derivative is what is solved with: S must be smooth.
ACTIVATIONS: dict[str, Callable] = {"tanh": jnp.tanh, "sin": jnp.sin}
ACTIVATIONS |= {"softplus": jax.nn.softplus, "silu": jax.nn.silu, "gelu": jax.nn.gelu}


@pytree("hidden", "activation")
class Mlp(DifferentiatedByJax):
    """Fully connected network with one output, linear in its last layer.

    hidden:     widths of the hidden layers.
    activation: one of ``ACTIVATIONS``. On two bodies silu trains to half the error of tanh.
    amplitude:  s, the size of S over the data (``amplitude_of``), so that N_θ has unit size.

    Raises ValueError for an unknown activation, and for widths that are not positive.
    """

    inputs: Inputs
    hidden: tuple[int, ...] = DEFAULT_HIDDEN
    activation: str = "silu"
    amplitude: Any = 1.0

    def __post_init__(self):
        if self.activation not in ACTIVATIONS:
            raise ValueError(
                f"expected an activation among {', '.join(ACTIVATIONS)}, got {self.activation!r}"
            )
        if not self.hidden or min(self.hidden) < 1:
            raise ValueError(f"expected hidden layers of positive width, got {self.hidden}")

    @property
    def name(self) -> str:
        return "mlp"

    @property
    def label(self) -> str:
        """Name and size, as the table of candidates shows them."""
        return f"mlp {'-'.join(map(str, self.hidden))}"

    @property
    def num_inputs(self) -> int:
        """Number of inputs of the network; an angle makes two."""
        return self.inputs.num_variables + len(self.inputs.angles)

    @property
    def num_parameters(self) -> int:
        # The last layer has no bias: a constant generates nothing.
        layers = pairwise((self.num_inputs, *self.hidden))
        return sum((m + 1) * n for m, n in layers) + self.hidden[-1]

    @property
    def operations(self) -> tuple[int, int]:
        """Floating-point operations of ∇S, and of ∇S with its Hessian (a tangent per variable)."""
        gradient = 4 * (self.num_parameters - sum(self.hidden))
        return gradient, gradient * (1 + self.inputs.num_variables)

    def init(self, key, dtype: Any) -> Any:
        """Draw initial parameters of this dtype: orthogonal weights, zero biases."""
        return initial(self.num_inputs, self.hidden, 1, self.activation, dtype, key)

    def value(self, params, w, args=None):
        """S(params, w), shape (...): w (..., 2d) of any float dtype, computed in that of params."""
        dtype = jax.tree.leaves(params)[0].dtype
        x = self.network_inputs(w).astype(dtype)
        amplitude = jnp.asarray(self.amplitude, dtype)
        out: Any = self._network(dtype).apply({"params": params}, x)
        return amplitude * out[..., 0]

    def network_inputs(self, w):
        """Inputs of the network (..., num_inputs) at w (..., 2d), each angle as (cos, sin)."""
        x = self.inputs(w)
        angles = np.array(self.inputs.angles, dtype=int)
        others = np.setdiff1d(np.arange(self.inputs.num_variables), angles)
        if not angles.size:
            return x
        parts = [x[..., others], jnp.cos(x[..., angles]), jnp.sin(x[..., angles])]
        return jnp.concatenate(parts, axis=-1)

    def _network(self, dtype):
        return network(self.num_inputs, self.hidden, 1, self.activation, dtype)


def network(num_inputs: int, hidden: tuple[int, ...], num_outputs: int, activation: str, dtype):
    """Make a fully connected network (num_inputs,) -> (num_outputs,), a Flax module.

    Its weights start orthogonal. Its last layer has no bias.
    """
    from flax import linen  # loaded when first used

    def dense(fan_in, width, use_bias=True):
        # A widening layer's columns are short; this brings every unit's input to the size of x.
        gain = max(1.0, width / fan_in) ** 0.5
        return linen.Dense(
            width,
            use_bias=use_bias,
            dtype=dtype,
            param_dtype=dtype,
            precision=jax.lax.Precision.HIGHEST,  # TF32 costs 7e-4 of ∇S
            kernel_init=linen.initializers.orthogonal(gain),
        )

    layers = []
    for fan_in, width in pairwise((num_inputs, *hidden)):
        layers += [dense(fan_in, width), ACTIVATIONS[activation]]
    return linen.Sequential([*layers, dense(hidden[-1], num_outputs, use_bias=False)])


@partial(jax.jit, static_argnums=(0, 1, 2, 3, 4))
def initial(
    num_inputs: int, hidden: tuple[int, ...], num_outputs: int, activation: str, dtype, key
):
    """Draw the initial parameters of such a network."""
    net = network(num_inputs, hidden, num_outputs, activation, dtype)
    return net.init(key, jnp.zeros(num_inputs, dtype))["params"]


def amplitude_of(w, target_gradient) -> float:
    """Size of a scalar whose gradient at w (N, 2d) is ``target_gradient`` (N, 2d), NumPy."""
    w, target = np.asarray(w, np.float64), np.asarray(target_gradient, np.float64)
    size = np.max(w.std(axis=0) * np.sqrt(np.mean(target**2, axis=0)))
    return float(size) if size > 0 else 1.0


@pytree()
class Ensemble(OfCoefficients, DifferentiatedByJax):
    """Ensemble of E networks of one shape; the params of the family are their weights (E,).

    network: the common shape. members: their params, every leaf with a leading axis E.
    """

    network: Mlp
    members: Any

    name = "mlp"

    @property
    def size(self) -> int:
        """Number E of members."""
        return jax.tree.leaves(self.members)[0].shape[0]

    @property
    def label(self) -> str:
        return f"{self.size} × {self.network.label}"

    @property
    def num_parameters(self) -> int:
        """Number of parameters of all members; the weights are not learned."""
        return self.size * self.network.num_parameters

    @property
    def operations(self) -> tuple[int, int]:
        """Floating-point operations of ∇S, and of ∇S with its Hessian, for all members."""
        gradient, with_hessian = self.network.operations
        return self.size * gradient, self.size * with_hessian

    def value(self, params, w, args=None):
        """S(params, w), shape (...): params (E,), w (..., 2d)."""
        each = jax.vmap(lambda member: self.network.value(member, w))(self.members)
        return jnp.tensordot(params, each, 1)
