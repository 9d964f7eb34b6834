"""Arguments of H beside the state: parameters of a system, the time of a periodic drive.

They stand behind the coordinates of a state, as more of them: parameters stay, the time goes on. A
bracket is the same for all of them, so that only H has them in its terms. NumPy.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from itertools import combinations
from typing import Any

import numpy as np

from gfnn_jax.errors import FitError
from gfnn_jax.families.terms import Terms
from gfnn_jax.phase_space import TIME, Pairs

FEWEST = 3  # values of a parameter, that tell 1 and one function of it from others
MANY = 5  # of these, that tell μ, 1/μ and μ²


@dataclasses.dataclass(frozen=True)
class Beside:
    """``values`` (N, k) of the parameters of these names, and the time behind them where a drive
    has a period."""

    names: tuple[str, ...]
    values: np.ndarray
    period: float | None = None

    @classmethod
    def of(cls, pairs: Pairs) -> Beside:
        """Take the parameters of pairs, which differ among these. Raises FitError where one has
        two values."""
        args = {name: np.asarray(v, float) for name, v in (pairs.args or {}).items()}
        for name, values in args.items():
            if name != TIME and len(known := np.unique(values)) < FEWEST:
                raise FitError(
                    f"the parameter {name} has {len(known)} values, and any function of it goes "
                    f"through these: add runs of another. Of one alone: "
                    f"gfnn.fit(pairs.take(pairs.args[{name!r}] == {known[0]:.17g}))"
                )
        columns = np.reshape([*args.values()], (len(args), len(pairs))).T
        return cls(tuple(args), columns, pairs.period)

    def behind(self, z: np.ndarray, after: Any = 0.0) -> np.ndarray:
        """States z (N, n) with these behind them, a time ``after`` (N,) later: (N, n + k)."""
        if not self.names:
            return z
        values = self.values.copy()
        if self.period is not None:
            values[:, -1] += after
        return np.concatenate([z, values], axis=1)

    def factors(self, names: tuple[str, ...]) -> Iterator[Terms | None]:
        """Functions of these by rising number, by which terms in coordinates of these names are
        multiplied: μ; 1/μ; μ, 1/μ, μ² and products; each with the drive's first harmonic, and with
        two. None where there is nothing beside the state."""
        if not self.names:
            yield None
            return
        own = [name for name in self.names if name != TIME]
        columns = [self.values[:, self.names.index(name)] for name in own]
        kinds = [own]
        if own and all((np.abs(x) > 0).all() for x in columns):
            over = [f"1/{name}" for name in own]
            kinds.append(over)
            if min(len(np.unique(x)) for x in columns) >= MANY:
                kinds.append([*own, *over])
        for harmonics in (1, 2) if self.period is not None else (0,):
            for variables in kinds:
                yield self._products(names, variables, len(own), harmonics)

    def _products(self, names, variables, count: int, harmonics: int) -> Terms:
        """The functions 1 and ``variables``, of more than one for each parameter their squares and
        products too, times the harmonics."""
        waves = [
            f"{wave}({2 * k}*pi*t/{self.period!r})"
            for k in range(1, harmonics + 1)
            for wave in ("cos", "sin")
        ]
        eye = np.eye(len(variables) + len(waves), dtype=int)
        rows = [0 * eye[0], *eye[: len(variables)]]
        if len(variables) > count:
            rows += [2 * eye[i] for i in range(count)]
            rows += [eye[i] + eye[j] for i, j in combinations(range(len(variables)), 2)]
            rows = [row for row in rows if not any(row[i] and row[count + i] for i in range(count))]
        every = [row + wave for row in rows for wave in (0 * eye[0], *eye[len(variables) :])]
        powers = tuple(tuple(row.tolist()) for row in every)
        return Terms(0, (*variables, *waves), powers, (), (*names, *self.names))


NOTHING = Beside((), np.zeros((0, 0)))
