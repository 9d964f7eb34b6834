"""H of a bracket: its flow by the same collocation as that of (q, p), on the lift of its states.

H∘π of a lift π is a family whose flow `flows.flow` steps. A rollout carries what rounding loses of
z along with z; there Casimirs are kept to twice the digits of z, and do not drift.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gfnn_jax.arrays import pytree
from gfnn_jax.brackets import Bracket
from gfnn_jax.families import as_family
from gfnn_jax.families.family import AroundAnother
from gfnn_jax.flows.lifts import lift_of
from gfnn_jax.generating.generated import two_sum
from gfnn_jax.solve.linear import small_solve

# Relative to the Casimirs' own gradients: where two of them are parallel (a sleeping top) the
# correction is not determined, and 1e-17 of it per step is what that leaves.
_PARALLEL = 1e-9


def collective(family, bracket: Bracket) -> Collective:
    """H(z), a family or a plain function of (params, z), as a family on the lift of a bracket.

        flow = Flow(collective(H, gfnn.Bracket.so3()), params, 0.1, scale=np.ones(3))

    Of a log-canonical bracket the states of the flow are y = log z. Raises FitError for a bracket
    without a lift.
    """
    return Collective(as_family(family), lift_of(bracket), casimirs_of(bracket))


@pytree()
class Collective(AroundAnother):
    """H∘π of ``family`` H at states w of the ``lift``. casimirs: those that rollouts keep."""

    family: Any
    lift: Any
    casimirs: Casimirs

    @property
    def form(self) -> Any:
        """Constant bracket of w, None for J."""
        return self.lift.form

    @property
    def operations(self) -> tuple[int, int]:
        """Floating-point operations of a gradient, and of a gradient with its Hessian."""
        gradient, hessian = self.family.operations
        return 2 * gradient, 4 * hessian

    def value(self, params, w, args=None):
        """H (...) at w (..., N)."""
        return self.family.value(params, self.lift.argument(w), args)

    def gradient(self, params, w, args=None):
        """∂(H∘π)/∂w (..., N)."""
        return self.lift.pulled(w, self.family.gradient(params, self.lift.argument(w), args))

    def gradient_and_hessian(self, params, w, args=None):
        """Gradient (..., N) and Hessian (..., N, N) of H∘π."""
        gradient, hessian = self.family.gradient_and_hessian(params, self.lift.argument(w), args)
        return self.lift.pulled(w, gradient), self.lift.pulled_twice(w, gradient, hessian)

    def term_gradients(self, w, args=None):
        """Gradients of all terms (..., N, terms). NumPy."""
        terms = np.moveaxis(self.family.term_gradients(self.lift.argument(w), args), -1, -2)
        return np.moveaxis(self.lift.pulled(w[..., None, :], terms), -1, -2)


@pytree("entries")
class Casimirs:
    """Casimirs Σ value · z_a z_b / 2 and Σ value · z_a by their entries (casimir, a, b), b = −1 for
    the linear ones. values: (entries,)."""

    entries: tuple[tuple[int, int, int], ...]
    values: Any

    def kept(self, z, lost, moved):
        """(Z, lost) of the states z + lost + moved (B, n), which get the Casimirs of z + lost: the
        rest of the rounding, of twice the digits, goes to what is lost."""
        begun, rest = two_sum(z, moved)
        if self.entries:
            fixed = jax.lax.stop_gradient((z, lost, moved))
            lost = lost + jax.lax.stop_gradient(self._correction(*fixed))
        return two_sum(begun, lost + rest)

    def _correction(self, z, lost, moved):
        """Smallest change (B, n) that undoes the change of the Casimirs."""
        count = 1 + max(entry[0] for entry in self.entries)
        change: list[Any] = [(jnp.zeros_like(z[:, 0]),) * 2] * count
        slopes = jnp.zeros((len(z), count, z.shape[1]), z.dtype)
        half, below = two_sum(z, 0.5 * moved)
        below, ended = below + lost, z + moved
        for (number, a, b), value in zip(self.entries, self.values, strict=True):
            by, rest = two_product(value, moved[:, a])
            slope = value
            if b >= 0:
                by, more = two_product(at := by, half[:, b])
                rest = more + (at * below[:, b] + rest * half[:, b])
                slope = value * ended[:, b]
            total, lower = change[number]
            total, error = two_sum(total, by)
            change[number] = total, lower + (error + rest)
            slopes = slopes.at[:, number, a].add(slope)
        found = jnp.stack([total + lower for total, lower in change], axis=-1)
        products = jnp.einsum("bia,bja->bij", slopes, slopes, precision="highest")
        ridge = 1.0 + _PARALLEL * jnp.eye(count, dtype=z.dtype)[None]
        factors = small_solve(products * ridge, found)
        correction = -jnp.einsum("bi,bia->ba", factors, slopes, precision="highest")
        return jnp.where(jnp.isfinite(correction), correction, 0.0)


def casimirs_of(bracket: Bracket) -> Casimirs:
    """The Casimirs of a bracket that its flow keeps, at the states of the flow."""
    entries, values = [], []
    for number, casimir in enumerate(bracket.casimirs):
        quadratic = np.zeros((0, 0)) if casimir.quadratic is None else casimir.quadratic
        found = [((a, b), quadratic[a, b]) for a, b in np.argwhere(quadratic).tolist()]
        found += [((a, -1), casimir.linear[a]) for a in np.flatnonzero(casimir.linear).tolist()]
        entries += [(number, *place) for place, _ in found]
        values += [value for _, value in found]
    return Casimirs(tuple(entries), np.array(values))


def two_product(a, b):
    """a · b as a sum of two numbers, to twice the digits, by JAX.

    All products are exact, so that it does not matter which of them a compiler fuses with a sum.
    """
    (a, below_a), (b, below_b) = _halves(a), _halves(b)
    total, rest = two_sum(a * b, a * below_b)
    total, more = two_sum(total, below_a * b)
    return total, rest + (more + below_a * below_b)


def _halves(a):
    """a as a sum of two numbers of half its digits."""
    digits = jnp.finfo(a.dtype)
    # One digit is implicit: products of a half with the other number are of 26 and 27 digits.
    high = jax.lax.reduce_precision(a, digits.nexp, digits.nmant // 2 - 1)
    return high, a - high
