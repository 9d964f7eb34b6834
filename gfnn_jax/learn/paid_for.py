"""Pairs that a budget pays for: all, or a sample of them.

What every fit does with each pair, the looks at copies, outliers and local Jacobians and the first
models, has to fit into the budget before anything is begun. Otherwise whole runs are left aside.
That is decided by operations: the clock of a busy machine changes no sample.
"""

from __future__ import annotations

from gfnn_jax.budget import RATES, ROWS, Budget
from gfnn_jax.dataset.runs import Identified, sampled

# Operations that a pair takes of the looks and of the search for H, in units of (2d)²: a million
# pairs of two degrees of freedom take 22 s (benchmarks/budgets.py).
_OF_PAIR = 12_500
# A sample takes so many, a second, and has so many pairs at least.
_OF_SAMPLE, _FEWEST = 1e10, 2_000


def paid_for(found: Identified, budget: Budget, seed: int) -> Identified:
    """The pairs, or a sample of them, drawn by the seed, where the budget does not pay for all:
    of two degrees of freedom 50,000. That is told with what else was left out."""
    pairs, row = found
    count, of_pair = len(pairs), _OF_PAIR * (2 * pairs.dim) ** 2
    most = max(_FEWEST, int(_OF_SAMPLE / of_pair))
    work = count * of_pair
    if count <= most or budget.pays_for(work):
        return found
    rows = sampled(pairs, most, seed)
    enough = f"--max-seconds {work / RATES[ROWS]:.0f}"
    if budget.max_operations is not None:
        enough = f"--max-operations {work:,}"
    budget.leave_out(
        f"{count - len(rows):,} of {count:,} pairs",
        f"the budget pays for a sample; {enough} pays for all",
    )
    return Identified(pairs.take(rows), row[rows])
