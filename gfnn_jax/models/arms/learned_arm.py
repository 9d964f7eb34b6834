"""The law of an arm as it was learned: base parameters, inertias that are possible, friction, and
the map of it.
"""

import dataclasses
from typing import Any

import numpy as np

from gfnn_jax.coordinates import CARTESIAN
from gfnn_jax.families.rigid_bodies import PARAMETERS, PER_LINK
from gfnn_jax.flows.bodies import OfBodies
from gfnn_jax.flows.flow import Flow
from gfnn_jax.flows.forces import Forced
from gfnn_jax.maps.domain import covering
from gfnn_jax.maps.inputs import Signals
from gfnn_jax.maps.laws import stiffness
from gfnn_jax.maps.posterior import Posterior
from gfnn_jax.maps.symplectic_map import SymplecticMap
from gfnn_jax.models.arms.identify import BaseParameters, Identified, Options
from gfnn_jax.phase_space import sizes
from gfnn_jax.solve.linear import covariance_root

_STAGES = 3
_STIFFEST = 32  # substeps at most; beyond, Newton's method solves the stages


@dataclasses.dataclass(frozen=True, eq=False)
class LearnedArm:
    """A law of bodies on joints that was learned from a log.

    map: its flow, with `inverse_dynamics`, `mass_matrix` and `linearise`. base: what the forces
    depend on, with standard errors, and what the motion determined. found: all parameters and their
    covariance. residual: joint -> rms of its force that is left, explained: the share of its
    variance that is not. swing: the joint whose swings would determine most of the others.
    """

    map: SymplecticMap
    base: BaseParameters
    found: Identified
    residual: dict[str, float]
    explained: dict[str, float]
    messages: tuple[str, ...]
    swing: str | None
    num_samples: int

    friction = hamiltonian = None  # as terms of an R or an H: it has none

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the joints."""
        return self.found.columns.bodies.names

    @property
    def inertias(self) -> dict[str, dict[str, float]]:
        """Joint -> the parameters of its link: mass m, first moments and inertia about the joint's
        origin, in its frame, possible for a body; those that are not determined are near the
        prior."""
        rows = self.found.x[: PER_LINK * len(self.names)].reshape(-1, PER_LINK)
        links = [dict(zip(PARAMETERS, map(float, row), strict=True)) for row in rows]
        return dict(zip(self.names, links, strict=True))

    @property
    def rotors(self) -> dict[str, float]:
        """Joint -> inertia of its rotor, as the joint feels it."""
        first = PER_LINK * len(self.names)
        return dict(zip(self.names, map(float, self.found.x[first:]), strict=False))

    @property
    def frictions(self) -> dict[str, dict[str, tuple[float, float]]]:
        """Joint -> kind of friction -> coefficient and its standard error, NaN where the log does
        not determine it; "offset" is a constant force."""
        k, found = len(self.names), self.found
        rows = found.x[(PER_LINK + 1) * k :].reshape(-1, k)
        errors = np.sqrt(np.diag(found.covariance)[(PER_LINK + 1) * k :]).reshape(-1, k)
        expected = np.abs(rows)
        expected[1:] = np.maximum(expected[1:], found.prior.sizes[k:].reshape(-1, k))
        expected[0] = np.maximum(expected[0], self.base.expected[-k:])
        told = np.where(errors < Options.sharpened * expected, [rows, errors], np.nan)
        kinds = ("offset", *found.columns.kinds)
        return {
            name: dict(zip(kinds, map(tuple, told[:, :, i].T.tolist()), strict=True))
            for i, name in enumerate(self.names)
        }

    @property
    def verdict(self) -> str:
        """Verdict of the log: identified, or partly, with what it does not determine."""
        lacking = [n for n, d in zip(self.base.names, self.base.determined, strict=True) if not d]
        if not lacking:
            return "identified"
        shown = "; ".join(lacking[:3]) + ("; …" if len(lacking) > 3 else "")
        return (
            f"partly: {len(lacking)} of {len(self.base.names)} base parameters are not determined "
            f"by this motion ({shown}): log swings of {self.swing} too, which would determine most"
        )

    @property
    def line(self) -> str:
        """Number of bodies and parameters."""
        return (
            f"{len(self.names)} bodies on joints, {len(self.base.names)} base parameters, "
            f"{int(self.base.determined.sum())} determined"
        )

    @property
    def formula(self) -> str:
        """Base parameters with their values, as text, of those that the log determines."""
        rows = zip(self.base.names, self.base.values, self.base.determined, strict=True)
        return "; ".join(f"{name} = {value:.6g}" for name, value, told in rows if told)

    @property
    def table(self) -> str:
        """Base parameters, friction and residuals, a line each."""
        lines = [self.line, "base parameters (kg, m):"]
        for one in self.report()["base_parameters"]:
            told = (
                "not determined" if one["std"] is None else f"{one['value']:.4g} ± {one['std']:.2g}"
            )
            lines.append(f"  {one['name']}: {told}")
        lines.append("joints:")
        for name, kinds in self.frictions.items():
            parts = [
                f"{kind} {c:.3g} ± {s:.1g}" if c == c else f"{kind} not determined"
                for kind, (c, s) in kinds.items()
            ]
            parts += [f"residual {self.residual[name]:.3g}"]
            lines.append(f"  {name}: {', '.join(parts)} ({self.explained[name]:.1%} explained)")
        return "\n".join([*lines, *self.messages])

    def _repr_latex_(self) -> None:
        """It is shown as text."""

    def __str__(self) -> str:
        return self.table

    def __repr__(self) -> str:
        return f"LearnedArm({self.line})"

    def report(self) -> dict[str, Any]:
        """Return what ``report.json`` holds."""
        base = zip(
            self.base.names, self.base.values, self.base.errors, self.base.determined, strict=True
        )
        return {
            "model": {"learns": "arm", "label": self.line},
            "verdict": self.verdict,
            "data": {"num_samples": self.num_samples},
            "base_parameters": [
                {"name": n, "value": float(v), "std": float(e)}
                if d
                else {"name": n, "value": None, "std": None}
                for n, v, e, d in base
            ],
            "links": self.inertias,
            "rotors": self.rotors,
            "friction": {
                name: {
                    kind: {"value": c, "std": s} if c == c else None
                    for kind, (c, s) in kinds.items()
                }
                for name, kinds in self.frictions.items()
            },
            "residual": self.residual,
            "explained": self.explained,
            "messages": list(self.messages),
        }


def map_of_arm(
    found: Identified, states: np.ndarray, dt: float, inputs: tuple[str, ...], gains: np.ndarray
) -> SymplecticMap:
    """The map over dt of an arm. states: (n, 2k) = (q, v) of its log."""
    columns, k = found.columns, found.columns.bodies.dim
    family = Forced(OfBodies(columns.bodies), columns.friction, len(inputs))
    params = np.concatenate([found.x, np.diag(gains).ravel()])
    q, v = np.split(states, 2, axis=1)
    own, losses = np.split(found.x, [(PER_LINK + 2) * k])
    law = OfBodies(columns.bodies).law(own, columns.friction, losses, np.diag(gains))
    z = np.concatenate([q, law.momentum(q, v)], axis=1)
    scale = sizes(z)
    rate = dt * max(stiffness(law, q[:: max(1, len(q) // 50)]), float(np.max(np.std(v, axis=0))))
    substeps = min(_STIFFEST, max(1, int(np.ceil(rate))))
    piece = Flow(family, params, dt, scale, _STAGES, substeps, bool(rate > _STIFFEST))
    root = np.zeros((len(found.x), len(params)))
    root[:, : len(found.x)] = covariance_root(found.covariance[None])[0]
    more: dict[str, Any] = {"posterior": Posterior(0, root), "signals": Signals(tuple(inputs))}
    return SymplecticMap((piece,), CARTESIAN, covering(z), scale, np.zeros(0), dt, **more)
