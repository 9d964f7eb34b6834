"""Pairs made ready for a fit: inner coordinates, angles lifted, a chart that covers them.

Where no chart does, or all are far from the identity, an affine base map is factored out.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from gfnn_jax.fitting.base_map import fit_half_map
from gfnn_jax.generating.charts import CHARTS, TYPE1
from gfnn_jax.coordinates import Coordinates, lift
from gfnn_jax.maps.symplectic_map.domain import Domain, covering
from gfnn_jax.learn.local_maps import SAFE, ChartJudgement, judge_chart
from gfnn_jax.maps.symplectic_map import Affine
from gfnn_jax.phase_space import Pairs, sizes

# Where the best chart's determinant falls below this, the map is far from the identity.
_FAR = 0.7


class FitError(ValueError):
    """The data or the request cannot give a map: one line, what was expected and what came."""


class FitWarning(UserWarning):
    """The fit went on, but its user should know."""


@dataclasses.dataclass(frozen=True)
class Prepared:
    """Pairs in the coordinates where S is learned: inner, lifted, base map factored out."""

    y0: np.ndarray
    y1: np.ndarray
    half: Affine | None
    scale: np.ndarray
    coordinates: Coordinates
    domain: Domain
    cut: np.ndarray
    dt: float


def prepare(pairs: Pairs, coordinates: Coordinates) -> Prepared:
    forward = jax.jit(jax.vmap(coordinates.forward))
    before = forward(jnp.asarray(pairs.z0, jnp.float64))
    after = forward(jnp.asarray(pairs.z1, jnp.float64))
    known = np.isfinite(np.asarray(before + after)).all(axis=1)
    if not known.all():
        raise FitError(
            f"expected states that have {coordinates.name} coordinates, got "
            f"{int((~known).sum())} pairs without, the first is row {int(np.argmin(known))}"
        )
    y0, y1, centres, covered = lift(before, after, coordinates)
    whole = tuple(i for i, c in zip(coordinates.angles, covered, strict=True) if c)
    scale = sizes(y0)
    return Prepared(
        y0=y0, y1=y1, half=None, scale=scale, coordinates=coordinates,
        domain=covering(y0, ignore=(*coordinates.cyclic, *whole)),
        cut=centres, dt=float(pairs.dt),
    )  # fmt: skip


def factor_out(prepared: Prepared, half: Affine) -> Prepared:
    y0 = np.asarray(jax.vmap(lambda y: half(y)[0])(jnp.asarray(prepared.y0)))
    back = half.inverse()
    y1 = np.asarray(jax.vmap(lambda y: back(y)[0])(jnp.asarray(prepared.y1)))
    return dataclasses.replace(prepared, y0=y0, y1=y1, half=half)


def choose_charts(request, prepared: Prepared, reversor, jacobians, judgements, warn):
    """Charts to try, half of the base map or None, and the judgements that stand for them.

    A base map is factored out where no chart is valid without it; with ``auto`` also where the map
    is far from the identity and the base map brings it nearer: S is smoother then.
    """
    angular = bool(prepared.coordinates.angles)
    near_identity = {n: c for n, c in CHARTS.items() if n != "type1"}
    valid = [n for n in near_identity if judgements[n].valid and judgements[n].sign > 0]
    if request == "type1" and angular:
        raise FitError(
            "chart type1 has no meaning for angles: w = (q, Q) is not periodic; use type2"
        )
    if request != "auto":
        judgement = judgements[request]
        if judgement.valid:
            if judgement.low < SAFE or judgement.sign < 0:
                warn(_about(request, judgement, "is close to singular over the data", valid))
            return [CHARTS[request]], None, judgements
        if valid:
            raise FitError(_about(request, judgement, "is singular over the data", valid))
    half = fit_half_map(
        prepared.y0, prepared.y1, prepared.scale,
        angles=prepared.coordinates.angles, reversor=reversor,
    )  # fmt: skip
    closest = max((judgements[n].low for n in valid), default=0.0)
    if half is not None and closest < _FAR:
        back = np.asarray(half.inverse().matrix)
        inner = back @ jacobians @ back
        based = {n: judge_chart(c, inner, prepared.scale) for n, c in CHARTS.items()}
        tried = ("midpoint", "type2", "type3") if request == "auto" else (request,)
        good = [n for n in tried if based[n].valid and based[n].sign > 0]
        if good and based[good[0]].low > closest:
            return [CHARTS[n] for n in good[:2]], half, based
    if valid:
        # Midpoint and one of types 2 and 3, which mirror each other.
        one_sided = [n for n in ("type2", "type3") if n in valid][:1]
        return [CHARTS[n] for n in ("midpoint", *one_sided) if n in valid], None, judgements
    if request in ("auto", "type1") and judgements["type1"].valid and not angular:
        return [TYPE1], None, judgements
    beyond = [n for n in near_identity if judgements[n].valid]
    if request == "auto" and beyond:
        warn(_about(beyond[0], judgements[beyond[0]], "lies beyond a fold throughout", ()))
        return [CHARTS[beyond[0]]], None, judgements
    lows = ", ".join(f"{n} {j.sign * j.low:.2g}" for n, j in judgements.items())
    raise FitError(
        f"no chart covers these data, with or without a base map (smallest determinants: {lows}): "
        "sample with a smaller dt, or learn a smaller region"
    )


def _about(name, judgement: ChartJudgement, what, valid) -> str:
    instead = [n for n in ("midpoint", "type2", "type3") if n in valid and n != name]
    advice = f"; use --chart {instead[0]}" if instead else ""
    return (
        f"chart {name} {what}: its determinant falls to {judgement.low:.2g} and is negative for "
        f"{100 * judgement.negative:.0f} % of the states{advice}"
    )
