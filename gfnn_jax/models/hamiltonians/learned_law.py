"""A learned H: its flow, its formula, and what the pairs tell of it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import cached_property
from typing import Any

import numpy as np

from gfnn_jax.candidates.candidate import Candidate
from gfnn_jax.exports.symbolic import as_latex, as_sympy
from gfnn_jax.families.sums import Sums
from gfnn_jax.families.terms import Terms
from gfnn_jax.flows.flow import Flow
from gfnn_jax.flows.legendre import Legendre
from gfnn_jax.flows.uniform import without_forces
from gfnn_jax.models.hamiltonians.cost_of_flow import FAST
from gfnn_jax.models.hamiltonians.fitted_law import Dropped
from gfnn_jax.models.hamiltonians.formula import Proposal, Rival, Term, as_code
from gfnn_jax.models.lagrangians.friction_choice import WhichFriction, odds_text
from gfnn_jax.phase_space import apply_j


@dataclasses.dataclass(frozen=True)
class LearnedHamiltonian:
    """H as learned, in the inner coordinates.

    candidate: as the others of a fit, its error measured by steps in NumPy. flow: the piece.
    terms, shown: what H is, as people read it; () and None of a network. omega_h: the fastest
    oscillation of the linearised flow, times dt, in the median over the data; beyond π pairs of one
    dt may not tell H.
    null_terms: that the data do not tell from the others. left_out: pairs that the flow does not
    resolve. stalled: whether larger libraries were no more accurate. covariance: makes ``root``;
    None of a network. noise: (2d,) of the coordinates, arcs: into which sequences were cut, where
    whole ones were fitted. unmet: that the tolerance is missed, and what that may be from; "" where
    it is met. ended: what cut the search for it short, "" where nothing did. dropped: terms that
    went in the end. friction: γ where that is uniform, else the terms of Rayleigh's R; of a system
    without, (). constants: numbers inside terms that noisy sequences told, each with its term and
    its standard error. symmetries: that H has to roundoff. proposals: simple fractions near its
    numbers, which noisy sequences allow. rivals: the next two laws that they allow. misfit: whether
    these sequences are certain that H lacks something.
    """

    candidate: Candidate
    flow: Flow
    terms: tuple[Term, ...]
    shown: str | None
    omega_h: float
    messages: tuple[str, ...] = ()
    null_terms: tuple[str, ...] = ()
    left_out: int = 0
    stalled: bool = False
    covariance: Callable[[], np.ndarray] | None = None
    noise: np.ndarray | None = None
    arcs: int = 0
    unmet: str = ""
    ended: str = ""
    dropped: Dropped | None = None
    friction: tuple[Term, ...] = ()
    constants: tuple[Term, ...] = ()
    symmetries: tuple[str, ...] = ()
    proposals: tuple[Proposal, ...] = ()
    rivals: tuple[Rival, ...] = ()
    misfit: bool = False
    widths: tuple[float, ...] = ()
    turns: bool = False
    kinds: Callable[[], WhichFriction | None] | WhichFriction | None = None

    @cached_property
    def which_friction(self) -> WhichFriction | None:
        """The kinds of friction, their odds against others where all of them competed, and the
        largest coefficients that the pairs allow of those not seen. None of a network, of a law
        with parameters or of many sites, and where the pairs' flow fails. Computed when it is first
        asked for."""
        return self.kinds() if callable(self.kinds) else self.kinds

    @cached_property
    def root(self) -> np.ndarray | None:
        """(m, m): rootᵀ root is the coefficients' covariance; None of a network. Computed when it
        is first asked for."""
        return None if self.covariance is None else self.covariance()

    @property
    def formula(self) -> str | None:
        """H as ``terms`` and sympy read it: "0.5*p1**2 - cos(q1)" (`learn.formula.as_code`). None
        of a network; of a Lagrangian, which is no expression in q and p, as it is shown."""
        family = without_forces(self.flow.family)
        return as_code(family, self.terms) if isinstance(family, Terms | Sums) else self.shown

    def __str__(self) -> str:
        """H as people read it: "0.5 p1² - cos(q1)"."""
        return self.shown or "a network"

    def sympy(self) -> Any:
        """H as a sympy expression. Raises ValueError of a network and a Lagrangian."""
        return as_sympy(self._expression)

    def latex(self) -> str:
        """H in LaTeX's notation. Raises ValueError as ``sympy`` does."""
        return as_latex(self._expression)

    def _repr_latex_(self) -> str | None:
        """H as a notebook shows it; None where it is no short expression."""
        short = isinstance(without_forces(self.flow.family), Terms)
        return f"$H = {self.latex()}$" if short else None

    def vector_field(self, t: Any, z: Any, args: Any = None) -> Any:
        """ż = J∇H(z), as `diffrax.ODETerm` takes it. args: of H, (k,) or None.

        Raises ValueError of a law with friction.
        """
        if self.friction:
            raise ValueError("expected a law without friction, got one whose field is not J∇H")
        return apply_j(self.flow.family.gradient(self.flow.params, z, args))

    @property
    def notes(self) -> tuple[str, ...]:
        """Lines about H beside its formula: constants inside, symmetries, fractions, rivals."""
        found = []
        if self.constants:
            text = ", ".join(f"{c.coefficient:g} ± {c.std:.0e} in {c.term}" for c in self.constants)
            found.append(f"constants inside: {text}")
        if self.symmetries:
            found.append(f"symmetries: {'; '.join(self.symmetries)}")
        if self.proposals:
            text = ", ".join(map(str, self.proposals))
            found.append(f"near simple fractions, which are not taken: {text}")
        if self.rivals:
            text = "; ".join(f"{odds_text(r.odds)} against {r.formula}" for r in self.rivals)
            found.append(f"odds by description length: {text}")
        if self.friction and self.which_friction is not None:
            found.append(f"friction: {self.which_friction}")
        if self.widths:
            text = ", ".join(f"{width:.1g}" for width in self.widths)
            found.append(f"dry friction of the map is smoothed over speeds ε = {text}")
        return tuple(found)

    @property
    def _expression(self) -> str:
        if self.formula is None or self.formula.startswith(Legendre.prefix):
            raise ValueError(
                "expected an H that is an expression in q and p, got a network or a Lagrangian"
            )
        return self.formula

    @property
    def fast(self) -> bool:
        """Return whether H oscillates so fast that other laws are not far from the same pairs."""
        return self.omega_h > FAST
