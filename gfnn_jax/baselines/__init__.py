"""Methods that the paper compares with, and a later one. Each gives a step function.

`METHODS` names them; each is ``learn(sequences, budget) -> Learned``.
"""

import dataclasses
from collections.abc import Callable

from gfnn_jax.baselines.learned import Budget, Learned, Sequences, hnn, vfnn
from gfnn_jax.baselines.srnn import o_net, srnn
from gfnn_jax.baselines.sympnets import g_sympnet, la_sympnet, p_sympnet


@dataclasses.dataclass(frozen=True)
class Method:
    """Method of a comparison.

    title: name in figures and tables. learn: the training. length: number of states in a sequence,
    2 for pairs. only_coupled: True for a method that serves non-separable systems only.
    """

    title: str
    learn: Callable[[Sequences, Budget], Learned]
    length: int = 2
    only_coupled: bool = False


METHODS: dict[str, Method] = {
    "vfnn": Method("VFNN", vfnn),
    "hnn": Method("HNN", hnn),
    "srnn-2": Method("SRNN (2)", srnn),
    "srnn-5": Method("SRNN (5)", srnn, length=5),
    "onet-2": Method("O-NET (2)", o_net, only_coupled=True),
    "onet-5": Method("O-NET (5)", o_net, length=5, only_coupled=True),
    "la-sympnet": Method("LA-SympNet", la_sympnet),
    "g-sympnet": Method("G-SympNet", g_sympnet),
    "p-sympnet": Method("P-SympNet", p_sympnet),
}

__all__ = ["METHODS", "Budget", "Learned", "Method", "Sequences"]
