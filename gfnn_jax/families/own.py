"""Families of a user's own in a fit: the members that they need, and the errors where one lacks.

``gfnn.fit(pairs, family=OWN)`` takes a family that is linear in its parameters
(`families.family.LinearFamily`), or a function of the fit's `Inputs`, the variables of w scaled to
[−1, 1], that gives such families by rising number of terms.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from gfnn_jax.errors import FitError
from gfnn_jax.families.inputs import Inputs

# The members of `families.family.LinearFamily`.
_NEEDED = (
    "name",
    "label",
    "operations",
    "num_parameters",
    "value",
    "gradient",
    "gradient_and_hessian",
    "term_gradients",
    "unflatten",
)


def own_families(given: Any, inputs: Inputs) -> Iterator[Any]:
    """Iterate over the families, by rising number of terms.

    Raises FitError where a family lacks a member that a fit needs.
    """
    families = [given] if hasattr(given, "term_gradients") else given(inputs)
    last = 0
    for family in families:
        missing = [name for name in _NEEDED if not hasattr(family, name)]
        if missing:
            raise FitError(
                f"expected a family with {', '.join(_NEEDED)}; {type(family).__name__} has no "
                f"{', '.join(missing)}"
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
