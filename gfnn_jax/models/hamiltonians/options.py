"""Options of a search for H: sizes of libraries, limits and thresholds."""

from __future__ import annotations

import dataclasses


@dataclasses.dataclass(frozen=True)
class LawOptions:
    """Tuned on Hénon–Heiles at dt 0.5 to 3, on three bodies and on the double pendulum.

    degrees: of the products of coordinates; feature_degrees: of a scene's features; given_degrees:
    of the products that stand beside a user's own terms (0: his alone), given_products: by which
    his terms are multiplied too.
    most_terms: of a library; most_modes: of one that grows. rows_per_term: that a library needs;
    rows_per_lagrangian_term: pairs times degrees of freedom that one of L needs.
    rows_compared: per term, on which libraries are compared; all pairs only count in the last fit.
    thresholds: standard errors below which terms go, tried in turn.
    rise: of the held-out error that dropping terms may cost; rounding: below which it is roundoff.
    flat: libraries one after the other whose errors differ by less have met the pairs' noise.
    explained: standard errors of the part of a residual that is noise, within which all of it is.
    gained: a library that lowers the error by less has not helped; gained_alone: where
    noise hides what it brings. poor: such libraries in a row
    that end the search; poor_given: of a user's terms; poor_structured: of a structure, whose
    libraries differ in kind. hopeless: times the tolerance, of an error that is known before a
    library is fitted, by an affine map of affine_rows training pairs. small: terms of the libraries
    that are tried before laws of physics, 0.3 s of two bodies; exact: of the spread, what a
    polynomial errs by that is no approximation. on_branch: of the spread, an error below which is
    that of the right branch of the turns, which turning pairs tell.
    truncation: a flow's own error, as a part of the tolerance. goal: residual that modes grow to,
    as a part of the tolerance. generators: degrees of those that look for misfit, beside the one
    that is so far ``beyond`` the law's own: an even H lacks no odd terms; sampled_rows: per term,
    where what is left over is looked at, fewest_sampled: pairs at least, of many sites numbers;
    white_pairs: whose residuals say whether a law leaves anything but noise. max_operations: of the
    flows that are evaluated on the
    way, counted: what a quiet core makes in half a minute, at 5e8 a second (two bodies, three
    bodies, pendulums), within which all laws of the benchmarks are found that are found at all;
    mode_operations: the same where modes grow, a minute at 7e8 a second; growth_part: the part of
    them in which they may; first_round: operations that the first round is expected to take.
    evaluations: of the flow and its derivatives, that a fit of a library is expected to take;
    close: of terms that are known to be close to their optimum. only_within: whether a law that
    misses the tolerance is of no use, so that the search ends where it is out of reach.
    roundoff: of the spread, above it the pairs carry noise, and every one of them counts;
    near_roundoff: of a flow's own error.
    """

    degrees: tuple[int, ...] = (2, 3, 4, 5, 6, 8)
    feature_degrees: tuple[int, ...] = (2, 3)
    given_degrees: tuple[int, ...] = (0, 2, 3, 4)
    given_products: tuple[int, ...] = (2,)
    most_terms: int = 350
    most_modes: int = 500
    rows_per_term: float = 1.6
    rows_per_lagrangian_term: float = 2.0
    rows_compared: float = 12.0
    thresholds: tuple[float, ...] = (1e4, 1e3, 100.0, 30.0, 10.0, 5.0, 3.0)
    rise: float = 1.1
    rounding: float = 5e-15
    flat: float = 1.2
    explained: float = 2.0
    gained: float = 0.5
    gained_alone: float = 0.8
    poor: int = 2
    poor_given: int = 3
    poor_structured: int = 5
    hopeless: float = 10.0
    affine_rows: int = 50_000
    small: int = 35
    exact: float = 1e-13
    on_branch: float = 0.05
    turning: int = 2_000
    truncation: float = 0.1
    goal: float = 0.3
    generators: tuple[int, ...] = (2, 3, 4, 5, 6)
    beyond: int = 2
    sampled_rows: int = 6
    fewest_sampled: int = 2_000
    white_pairs: int = 2_000
    max_operations: float = 1.5e10
    mode_operations: float = 4.2e10
    growth_part: float = 0.7
    first_round: float = 5e8
    evaluations: float = 20.0
    close: float = 6.0
    only_within: bool = True
    roundoff: float = 1e-12
    near_roundoff: float = 3e-15


OPTIONS = LawOptions()
