"""The parity of S: S(−w) = S(w) for the S of a law that is even in (q, p).

An even S has half the terms. Where terms are scarce that is guessed from held-out residuals.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from itertools import takewhile

import numpy as np

from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.dataset.rows import rows_of
from gfnn_jax.families.inputs import box_inputs, variable_signs
from gfnn_jax.families.products import Products, number_of_terms
from gfnn_jax.fitting import least_squares
from gfnn_jax.generating.charts import MIDPOINT


@dataclasses.dataclass(frozen=True)
class ParityOptions:
    """Options of the guess (benchmarks/constants.py --only parity).

    from_dim: degrees of freedom from which terms are scarce. rows_per_term: that the test needs.
    odd_degree: of the odd terms that it tries. no_gain: of the held-out residual, that these may
    leave: those of an even S leave 0.98 to 1.09 of it (FPUT chains, a Penning trap, a satellite).
    In three degrees of freedom an even S errs by 0.93 to 1 times what the full one does on clean
    pairs: it saves unknowns and unlocks no degree. A law with a tenth of odd terms was never taken
    for an even one, which would cost a factor of ten and more.
    """

    from_dim: int = 3
    rows_per_term: int = 6
    odd_degree: int = 3
    no_gain: float = 0.98
    alike: int = 2  # degree up to which the terms that are not even are the coordinates alone


OPTIONS = ParityOptions()


class _WithOdd:
    """The terms of an even family, and after them the odd ones up to a degree."""

    def __init__(self, even: Products):
        self._even, self._all = even, Products(even.inputs, OPTIONS.odd_degree)
        self._odd = np.flatnonzero(self._all.basis.term_orders % 2)
        self.num_parameters = even.num_parameters + len(self._odd)

    def term_gradients(self, w):
        odd = self._all.term_gradients(w)[..., self._odd]
        return np.concatenate([self._even.term_gradients(w), odd], axis=-1)


def is_even(data: Dataset, degrees: Sequence[int], most_terms: int, rows_per_term: float) -> bool:
    """Return whether S(−w) = S(w) as far as any size of a sweep could tell: odd terms beside the
    even ones of the highest degree that a sweep has do not make the held-out residual smaller.

    degrees, rising, most_terms, rows_per_term: of the sweep of even polynomials.
    False where terms are not scarce, where angles or args are, or where the test would take too
    much.
    """
    dim = data.dim
    if dim < OPTIONS.from_dim or data.coordinates.angles or data.args is not None:
        return False
    (w, target), weight = rows_of(data, MIDPOINT, data.training)
    held, _ = rows_of(data, MIDPOINT, data.validation)
    flip = (-1,) * 2 * dim
    inputs = box_inputs(w, cyclic=data.coordinates.cyclic, reversor=flip)
    signs = variable_signs(inputs, flip, w)
    most = min(most_terms, w.size // rows_per_term)
    # Counting takes long where variables are many, and a higher degree has more terms.
    few = list(takewhile(lambda n: number_of_terms(inputs.is_angle, n, signs) <= most, degrees))
    if not few or few[-1] <= OPTIONS.alike:
        return False
    even = Products(inputs, few[-1], signs)
    odd = number_of_terms(inputs.is_angle, OPTIONS.odd_degree) - even.terms_of(OPTIONS.odd_degree)
    if even.num_parameters + odd > most_terms:
        return False
    family = _WithOdd(even)
    pairs = -(-OPTIONS.rows_per_term * family.num_parameters // w.shape[1])
    if pairs > len(w):
        return False
    train, held = (
        least_squares.reduce(family, [tuple(a[:pairs] for a in rows)], weight)
        for rows in ((w, target), held)
    )
    sizes = [even.num_parameters, family.num_parameters]
    (_, without), (_, with_odd) = least_squares.residuals(train, held, sizes)
    return with_odd >= OPTIONS.no_gain * without
