"""H of systems that differ in parameters: coefficients times products of whole powers of these.

The first of the args are the parameters μ, and each coefficient c_j of H and of its forces is
c_j ∏ μ_i^n_ji: the law of a pendulum of any length, of a cart with any mass on it.
"""

from typing import Any

from gfnn_jax.arrays import as_row, beside, pytree
from gfnn_jax.families.family import AroundAnother, at_time, parameter_gradients
from gfnn_jax.families.lagrangian import Powers, functions_of


@pytree("powers")
class OfSystems(AroundAnother):
    """``family`` whose params (m,) are multiplied by these powers (m, k) of the first k args; the
    other args are the family's own."""

    family: Any
    powers: Powers

    @property
    def name(self) -> str:
        return "terms with parameters"

    @property
    def label(self) -> str:
        return f"{self.family.label}, {len(self.powers[0])} parameters"

    @property
    def num_parameters(self) -> int:
        return len(self.powers)

    @property
    def operations(self) -> tuple[int, int]:
        """Operations of the family, and of the powers."""
        gradient, with_hessian = self.family.operations
        more = sum(1 + sum(map(abs, row)) for row in self.powers)
        return gradient + more, with_hessian + more

    def take(self, rows) -> Any:
        """The family of these terms alone."""
        rows = list(rows)
        return OfSystems(self.family.take(rows), tuple(self.powers[j] for j in rows))

    def inside(self, params, args) -> tuple[Any, Any]:
        """Params (..., m) and args of the family for the system, or those of each lane, that args
        tell. Raises ValueError without them."""
        if args is None:
            raise ValueError("expected the parameters of the system: the law depends on them")
        count = len(self.powers[0])
        rest = args[..., count:]
        weights = functions_of(self.powers, args[..., :count])
        own = as_row(params, weights) * weights
        return own, rest if rest.shape[-1] else None

    def multiplier(self, params, dt):
        """1.0, or None where the family's forces keep no multiple of the symplectic form."""
        own = getattr(self.family, "multiplier", None)
        return 1.0 if own is None else own(params, dt)

    def at_time(self, args, after):
        """args a time ``after`` later: the system stays the same."""
        count = len(self.powers[0])
        if args.shape[-1] == count:
            return args
        return beside(args[..., :count], at_time(self.family, args[..., count:], after))

    def parameter_gradients(self, params, w, args=None, along=None):
        """∂/∂params of the gradient (..., 2d, m). NumPy."""
        own, rest = self.inside(params, args)
        columns = parameter_gradients(self.family, own, w, rest, along)
        if along is not None or args is None:
            return columns
        return columns * functions_of(self.powers, args[..., : len(self.powers[0])])[..., None, :]
