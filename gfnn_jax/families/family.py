"""Protocol of a family: a pure scalar function f(params, w, args) and its derivatives in w.

S of a chart and H of a flow are families. Batch first: w has shape (..., 2d). A family is a frozen
dataclass registered as a pytree. Its leaves are numbers that come from the data; all else is
static. The same lines compute in NumPy for NumPy arrays (a fit) and are traced once for JAX arrays
(a step).
"""

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero

from gfnn_jax.arrays import as_row, matmul, namespace, pytree
from gfnn_jax.errors import FitError
from gfnn_jax.phase_space import TIME, apply_j, symplectic_form


@runtime_checkable
class Family(Protocol):
    """Scalar function with the members that maps, fits and solvers need.

    args: further arguments of the function beside the state (parameters of a system, the time of a
    drive), or None. ``family(params, w, args)`` is ``value``, so that
    ``jax.grad(family, argnums=1)`` is the gradient at one w (2d,).
    """

    @property
    def name(self) -> str:
        """Kind of family, one word: what a saved map knows it by."""
        ...

    @property
    def label(self) -> str:
        """Kind and size, as tables and reports show them."""
        ...

    @property
    def operations(self) -> tuple[int, int]:
        """Floating-point operations of a gradient, and of a gradient with its Hessian."""
        ...

    def value(self, params: Any, w: Any, args: Any = None) -> Any:
        """Value of f, shape (...)."""
        ...

    def gradient(self, params: Any, w: Any, args: Any = None) -> Any:
        """Gradient ∂f/∂w, shape (..., 2d)."""
        ...

    def gradient_and_hessian(self, params: Any, w: Any, args: Any = None) -> tuple[Any, Any]:
        """Gradient ∂f/∂w and Hessian ∂²f/∂w², shapes (..., 2d) and (..., 2d, 2d)."""
        ...


def at_time(family: Any, args: Any, after: Any) -> Any:
    """Advance args (..., k) by a time ``after`` (...). NumPy or JAX.

    Where the family depends on time, it is the last of the args and grows; the others stay. A
    family may have an ``at_time`` of its own instead.
    """
    own = getattr(family, "at_time", None)
    if own is not None:
        return own(args, after)
    if getattr(family, "parameters", ())[-1:] != (TIME,):
        return args
    xp = namespace(args, after)
    time = args[..., -1]
    if 0 < time.ndim < xp.ndim(after):  # of stages and lanes
        time = as_row(time, after)
    time = time + after
    still = xp.broadcast_to(args[..., :-1], (*time.shape, args.shape[-1] - 1))
    return xp.concatenate([still, time[..., None]], axis=-1)


def turned(family: Any, covector: Any) -> Any:
    """Velocity of a gradient (..., n): J g, or Ω g of a family that has another constant ``form`` Ω
    (n, n). NumPy or JAX."""
    form = getattr(family, "form", None)
    return apply_j(covector) if form is None else matmul(covector, form.T)


def velocity(family: Any, params: Any, w: Any, args: Any = None) -> Any:
    """Velocity (..., n) of H, a family, at states w: its gradient `turned`."""
    return turned(family, family.gradient(params, w, args))


def form_of(family: Any, width: int) -> Any:
    """Matrix (width, width) of `turned`."""
    form = getattr(family, "form", None)
    return symplectic_form(width // 2) if form is None else form


@runtime_checkable
class LinearFamily(Family, Protocol):
    """Family f = Σ c_j φ_j(w) that is linear in its parameters."""

    @property
    def num_parameters(self) -> int:
        """Number of terms."""
        ...

    def term_gradients(self, w: Any, args: Any = None) -> Any:
        """Gradients ∂φ_j/∂w of all terms, shape (..., 2d, num_parameters)."""
        ...

    def unflatten(self, coefficients: Any) -> Any:
        """Make the params of the family from coefficients (num_parameters,)."""
        ...


def parameter_gradients(family: Any, params: Any, w: Any, args: Any = None, along: Any = None):
    """∂/∂params of the gradient (..., 2d, m): the gradients of the terms of a linear family, or
    what a family says that has a ``parameter_gradients`` of its own. along: a linear family of
    other terms, in whose coefficients it is instead, these 0. NumPy."""
    own = getattr(family, "parameter_gradients", None)
    if own is not None:
        return own(params, w, args, along)
    return (along or family).term_gradients(w, args)


class CalledAsValue:
    """Base of all families of this package: called, a family is its value."""

    def __call__(self, params, w, args=None):
        return self.value(params, w, args)

    def value(self, params, w, args=None):
        """Value of f, shape (...): w (..., 2d)."""
        raise NotImplementedError


class OfCoefficients(CalledAsValue):
    """Base of a family whose params are the coefficients (N,) of its terms."""

    @property
    def label(self: Any) -> str:
        """Name and number of terms, as tables show them."""
        return f"{self.name} {self.num_parameters}"

    def unflatten(self, coefficients):
        """Return the coefficients: they are the parameters."""
        return coefficients


class AroundAnother(OfCoefficients):
    """Base of a family that is made of another one, ``family``, and is that one, with params and
    args of its own (`inside`), where it has no member of its own."""

    family: Any

    @property
    def dim(self) -> int:
        """Degrees of freedom d."""
        return self.family.dim

    @property
    def name(self) -> str:
        return self.family.name

    @property
    def num_parameters(self) -> int:
        return self.family.num_parameters

    @property
    def term_names(self) -> tuple[str, ...]:
        return self.family.term_names

    @property
    def operations(self) -> tuple[int, int]:
        """Floating-point operations of a gradient, and of a gradient with its Hessian."""
        return self.family.operations

    def at_time(self, args, after):
        """args a time ``after`` later."""
        return at_time(self.family, args, after)

    def inside(self, params, args) -> tuple[Any, Any]:
        """Params and args of the other family."""
        return params, args

    def value(self, params, w, args=None):
        """Value of f, shape (...): w (..., 2d)."""
        own, args = self.inside(params, args)
        return self.family.value(own, w, args)

    def gradient(self, params, w, args=None):
        """Gradient ∂f/∂w (..., 2d)."""
        own, args = self.inside(params, args)
        return self.family.gradient(own, w, args)

    def gradient_and_hessian(self, params, w, args=None):
        """Gradient ∂f/∂w (..., 2d) and Hessian ∂²f/∂w² (..., 2d, 2d)."""
        own, args = self.inside(params, args)
        return self.family.gradient_and_hessian(own, w, args)


class DifferentiatedByJax(CalledAsValue):
    """Derivatives by JAX for a family that has no closed form of them.

    ``value`` must treat the rows of w independently. One compiled function serves NumPy arrays.
    """

    def gradient(self, params, w, args=None):
        """Gradient ∂f/∂w (..., 2d), by one reverse sweep of the batch."""
        if namespace(w) is np:
            return np.asarray(_compiled("gradient", self, params, w, args))
        return jax.grad(lambda v: jnp.sum(self.value(params, v, args)))(w)

    def gradient_and_hessian(self, params, w, args=None) -> tuple[Any, Any]:
        """Gradient ∂f/∂w and Hessian ∂²f/∂w², by a tangent of the reverse sweep per entry of w."""
        if namespace(w) is np:
            gradient, hessian = _compiled("gradient_and_hessian", self, params, w, args)
            return np.asarray(gradient), np.asarray(hessian)
        gradient, tangent = jax.linearize(lambda v: self.gradient(params, v, args), w)
        units = jnp.eye(w.shape[-1], dtype=w.dtype)
        along = jax.vmap(lambda e: tangent(jnp.broadcast_to(e, w.shape)), out_axes=-1)
        return gradient, along(units)


@partial(jax.jit, static_argnums=0)
def _compiled(method, family, params, w, args):
    return getattr(family, method)(params, w, args)


@pytree()
class FromFunction(DifferentiatedByJax):
    """Family of a user's own S(params, w) of one state w (2d,)."""

    function: Any

    name, label = "function", "a function"
    # The number of operations of a user's function is unknown.
    operations = (0, 0)

    def value(self, params, w, args=None):
        """Values of S (...) at w (..., 2d)."""
        one = self.function if args is None else lambda p, v: self.function(p, v, args)
        flat = w.reshape(-1, w.shape[-1])
        return jax.vmap(one, in_axes=(None, 0))(params, flat).reshape(w.shape[:-1])


def from_function(function: Callable) -> Family:
    """Make a family of a plain ``S(params, w)`` -> scalar, w (2d,), with all derivatives by JAX.

    The leaves of a callable pytree are leaves of the family; a plain function is static.
    """
    if jax.tree_util.all_leaves((function,)):
        function = jax.tree_util.Partial(function)
    return FromFunction(function)


def as_family(function: Any) -> Any:
    """Return a family as it is, and make one of any other callable by ``from_function``.

    Anything else is returned as it is, because JAX puts placeholders into pytrees.
    """
    if not callable(function) or hasattr(type(function), "gradient_and_hessian"):
        return function
    return from_function(function)


def own_families(given: Any, inputs: Any) -> Iterator[Any]:
    """Iterate over the families of a user's own, by rising number of terms.

    given: a `LinearFamily`, or a function of the fit's `Inputs`, the variables of w scaled to
    [−1, 1], that gives such families. Raises FitError where a family lacks a member that a fit
    needs, and where they do not grow.
    """
    families, last = [given] if hasattr(given, "term_gradients") else given(inputs), 0
    for family in families:
        if not isinstance(family, LinearFamily):
            lacks = [n for n in dir(LinearFamily) if n[0] != "_" and not hasattr(family, n)]
            raise FitError(
                f"expected a linear family; {type(family).__name__} has no {', '.join(lacks)}"
            )
        if type(family).__hash__ is None:
            raise FitError(
                f"{type(family).__name__} is compared by its fields, a fit needs families compared "
                "by identity: declare it with dataclass(frozen=True, eq=False)"
            )
        if family.num_parameters <= last:
            raise FitError(
                f"expected families by rising number of terms, got {family.num_parameters} after "
                f"{last}"
            )
        last = family.num_parameters
        yield family


def symmetric_gradient(family: Family, params: Any, w: Any, args: Any = None) -> Any:
    """Gradient ∂f/∂w (..., 2d), whose derivative in w is defined as the family's Hessian.

    A step is only as symplectic as S'' is symmetric. The derivative of ``gradient`` by JAX is
    symmetric up to the rounding of its terms; the Hessian is symmetric to the last bit. A
    matrix-free family keeps the derivative by JAX.
    """
    if namespace(w) is np or getattr(family, "matrix_free", False):
        return family.gradient(params, w, args)
    return _gradient(family, params, w, args)


def symmetric_gradient_and_hessian(
    family: Family, params: Any, w: Any, args: Any = None
) -> tuple[Any, Any]:
    """Gradient ∂f/∂w of ``symmetric_gradient``, and Hessian ∂²f/∂w² (..., 2d, 2d)."""
    if namespace(w) is np:
        return family.gradient_and_hessian(params, w, args)
    return _gradient_and_hessian(family, params, w, args)


@jax.custom_jvp
def _gradient(family, params, w, args):
    return family.gradient(params, w, args)


@partial(_gradient.defjvp, symbolic_zeros=True)
def _gradient_jvp(primals, tangents):
    family, params, w, args = primals
    gradient, hessian = family.gradient_and_hessian(params, w, args)
    return gradient, _gradient_dot(gradient, hessian, primals, tangents)


@jax.custom_jvp
def _gradient_and_hessian(family, params, w, args):
    return family.gradient_and_hessian(params, w, args)


@partial(_gradient_and_hessian.defjvp, symbolic_zeros=True)
def _gradient_and_hessian_jvp(primals, tangents):
    (gradient, hessian), (_, hessian_dot) = _jvp(
        lambda f, p, w, a: f.gradient_and_hessian(p, w, a), primals, tangents
    )
    gradient_dot = _gradient_dot(gradient, hessian, primals, tangents)
    return (gradient, hessian), (gradient_dot, hessian_dot)


def _gradient_dot(gradient, hessian, primals, tangents):
    """Tangent of the gradient: S'' ẇ plus the contributions of the other tangents."""
    family, params, w, args = primals
    family_dot, params_dot, w_dot, args_dot = tangents
    dot = jnp.zeros_like(gradient)
    if not isinstance(w_dot, SymbolicZero):
        dot = matmul(hessian, w_dot[..., None])[..., 0]
    others = (family_dot, params_dot, args_dot)
    if _vanish(others):
        return dot
    _, more = _jvp(
        lambda family, params, args: family.gradient(params, w, args),
        (family, params, args),
        others,
    )
    return dot + more


def _jvp(function, primals, tangents):
    """Apply ``jax.jvp`` in the arguments whose tangents do not vanish: less to compile."""
    moving = [i for i, tangent in enumerate(tangents) if not _vanish(tangent)]

    def of_moving(*given):
        arguments = list(primals)
        for i, argument in zip(moving, given, strict=True):
            arguments[i] = argument
        return function(*arguments)

    dots = [jax.tree.map(_instantiated, tangents[i]) for i in moving]
    return jax.jvp(of_moving, [primals[i] for i in moving], dots)


def _vanish(tangents) -> bool:
    return all(isinstance(leaf, SymbolicZero) for leaf in jax.tree.leaves(tangents))


def _instantiated(tangent: Any) -> Any:
    if isinstance(tangent, SymbolicZero):
        return jnp.zeros(tangent.shape, tangent.dtype)  # pyright: ignore[reportArgumentType]
    return tangent
