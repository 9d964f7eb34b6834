"""Messages about a law: what its pairs do not tell, and why it misses the tolerance."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from gfnn_jax.dataset.measured_error import OneStepError
from gfnn_jax.models.hamiltonians.cost_of_flow import FAST
from gfnn_jax.models.hamiltonians.fitted_law import FittedLaw
from gfnn_jax.models.hamiltonians.friction_kinds import is_smooth

TURNS = "friction is not smooth in steps in which a body turns or stops"
_NAMED = 5  # terms in a message


def unmet(error: OneStepError, omega_h: float, tolerance, found: FittedLaw) -> str:
    """State why the tolerance is missed; "" where it is met."""
    if error.bound <= tolerance.bound:
        return ""
    why = "If you know terms of H, give them: --terms (terms=)"
    if omega_h > FAST:
        why = (
            f"The motion turns by ωh = {omega_h:.2g} radians in a step; beyond π pairs of one dt "
            "do not determine H (aliasing): sample with a smaller dt, or with several"
        )
    elif not is_smooth(found.family):
        why = TURNS.capitalize()
    elif found.ended:
        why = f"The search for modes ended: {found.ended}"
    return (
        "no H of the terms tried meets the tolerance: the best has a one-step error of "
        f"{error.relative:.2e} of the spread. {why}"
    )


def messages(
    error: OneStepError,
    omega_h: float,
    data,
    tolerance,
    found: FittedLaw,
    left_out: int,
    unresolved: int,
    turns: bool,
) -> Iterator[str]:
    """Lines about a law: aliasing, misfit, terms that are not determined, pairs too fast for it."""
    if error.bound <= tolerance.bound and omega_h > FAST:
        yield (
            f"the motion turns by ωh = {omega_h:.2g} radians in a step (median over the states"
            f"{', beyond π' if omega_h > np.pi else ''}). Pairs of one dt determine "
            "frequencies only modulo 2π/dt (aliasing): of the H that fit, this is the "
            + ("simplest. A smaller dt, or several, would decide" if omega_h > np.pi else "slowest")
        )
    if found.whole is not None:
        yield from found.whole.messages
        if found.whole.misfit:
            yield (
                "H misses whole sequences by more than their noise: it lacks terms that single "
                "steps do not show; bands count what it misses"
            )
    if found.undetermined:
        names = found.undetermined
        some = ", ".join(names[:_NAMED]) + (", …" if len(names) > _NAMED else "")
        yield (
            f"the pairs do not determine {len(names)} terms of H ({some}): they are left out, and "
            "H holds only where the pairs are"
        )
    if left_out:
        yield (
            f"{left_out} of {len(found.rows)} pairs move too fast for the steps by which H was "
            "fitted, as in close passages: they were left out"
        )
    if unresolved and turns:
        yield (
            f"{TURNS}: there the map errs, and not the law, in {unresolved} of "
            f"{len(data.validation)} held-out pairs"
        )
    elif unresolved:
        yield (
            f"{unresolved} of {len(data.validation)} held-out pairs move too fast for the map's "
            "steps, as in close passages: there the map errs, and not H"
        )
