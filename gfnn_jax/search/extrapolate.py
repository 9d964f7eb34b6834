"""Extrapolation of the errors of a size sweep: what larger sizes promise, and which one would
do."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

# Sizes of a smaller range foretell nothing: an even S gains nothing from every other degree.
_RANGE = 2.0
# A size whose error ÷ the least before it is more than this has gained nothing; a sweep whose least
# error, times this, is no larger than the best one's has come as far.
GAINED = 0.8
# Extrapolated over more than so many times the orders that were seen, a decay means nothing.
_FARTHEST = 3.0


class Decay(NamedTuple):
    """The logarithm of a sweep's error falls by ``rate`` per unit of order, from ``error`` at
    ``order``, at orders that are ``spacing`` apart. first: the order of the first size."""

    first: float
    order: float
    error: float
    rate: float
    spacing: float

    def error_at(self, order: float) -> float:
        """The error of the size of this order."""
        steps = math.floor(max(order - self.order, 0.0) / self.spacing + 1e-9)
        return self.error * math.exp(-self.rate * self.spacing * steps)

    def order_for(self, bound: float) -> float | None:
        """The smallest order whose error is within the bound; None where it is too far to tell."""
        if self.rate <= 0:
            return None
        fall = max(math.log(self.error / bound), 0.0)
        found = self.order + self.spacing * math.ceil(fall / (self.rate * self.spacing) - 1e-9)
        far = found - self.first > _FARTHEST * max(self.order - self.first, self.spacing)
        return None if far else found


def decay_of(sizes: Sequence[tuple[float, float]]) -> Decay | None:
    """The decay of sizes (order, error), by rising order; None where they are too few.

    Only sizes count that gain: an even S gains from every other degree. The rate is the better one
    of the last two, each over two gains, so that a sweep is rather thought to be good.
    """
    finite = [(x, e) for x, e in sizes if 0 < e < math.inf]
    if not finite or finite[-1][0] - finite[0][0] < _RANGE:
        return None
    gains = finite[:1]
    for order, error in finite[1:]:
        if error < GAINED * gains[-1][1]:
            gains.append((order, error))
    (first, _), (order, error) = gains[0], gains[-1]
    if len(gains) == 1:
        return Decay(first, order, error, 0.0, 1.0)
    ends = [j for j in range(1, len(gains)) if j >= len(gains) - 2 and (j > 1 or len(gains) == 2)]
    rates = (_rate(gains[max(j - 2, 0)], gains[j]) for j in ends)
    return Decay(first, order, error, max(rates), order - gains[-2][0])


def _rate(one: tuple[float, float], other: tuple[float, float]) -> float:
    return math.log(one[1] / other[1]) / (other[0] - one[0])
