"""Charts that cover the data, and whether a base map must be factored out first."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.diagnosis.local_jacobians import SAFE, ChartDeterminant, chart_determinant
from gfnn_jax.errors import FitError
from gfnn_jax.fitting.linear_starts import fit_half_map
from gfnn_jax.generating.charts import CHARTS, TYPE1, AnyChart
from gfnn_jax.maps.affine import Affine

# Where the best chart's determinant falls below this, the map is far from the identity.
_FAR = 0.7


class Charts(NamedTuple):
    """charts: to try. half: R^½ of the base map that is to be factored out, or None. determinants:
    chart -> its determinant over the data, without the base map. messages: warnings."""

    charts: list[AnyChart]
    half: Affine | None
    determinants: dict[str, ChartDeterminant]
    messages: list[str]


def choose_charts(request: str, data: Dataset, reversor, jacobians) -> Charts:
    """The charts for these data: the one asked for, or with "auto" those that are valid.

    A base map is factored out where no chart is valid without it; with "auto" also where the map
    is far from the identity and the base map brings it nearer: S is smoother then. Raises FitError
    where no chart covers the data, or the one asked for is singular over them.
    """
    determinants = {name: chart_determinant(c, jacobians, data.scale) for name, c in CHARTS.items()}
    angular = bool(data.coordinates.angles)
    near_identity = {n: c for n, c in CHARTS.items() if n != "type1"}
    valid = [n for n in near_identity if determinants[n].valid and determinants[n].sign > 0]
    if request == "type1" and angular:
        raise FitError(
            "chart type1 has no meaning for angles: w = (q, Q) is not periodic; use type2"
        )
    if request != "auto":
        determinant = determinants[request]
        if determinant.valid:
            close = determinant.low < SAFE or determinant.sign < 0
            message = _about(request, determinant, "is close to singular over the data", valid)
            return Charts([CHARTS[request]], None, determinants, [message] if close else [])
        if valid:
            raise FitError(_about(request, determinant, "is singular over the data", valid))
    half = fit_half_map(
        data.y0,
        data.y1,
        data.scale,
        angles=data.coordinates.angles,
        reversor=reversor,
    )
    closest = max((determinants[n].low for n in valid), default=0.0)
    if half is not None and closest < _FAR:
        back = np.asarray(half.inverse().matrix)
        inner = back @ jacobians @ back
        with_base = {n: chart_determinant(c, inner, data.scale) for n, c in CHARTS.items()}
        tried = ("midpoint", "type2", "type3") if request == "auto" else (request,)
        good = [n for n in tried if with_base[n].valid and with_base[n].sign > 0]
        if good and with_base[good[0]].low > closest:
            return Charts([CHARTS[n] for n in good[:2]], half, with_base, [])
    if valid:
        # Midpoint and one of types 2 and 3, which mirror each other.
        one_sided = [n for n in ("type2", "type3") if n in valid][:1]
        names = [n for n in ("midpoint", *one_sided) if n in valid]
        return Charts([CHARTS[n] for n in names], None, determinants, [])
    if request in ("auto", "type1") and determinants["type1"].valid and not angular:
        return Charts([TYPE1], None, determinants, [])
    beyond = [n for n in near_identity if determinants[n].valid]
    if request == "auto" and beyond:
        message = _about(
            beyond[0], determinants[beyond[0]], "is used beyond a fold, where w turns back", ()
        )
        return Charts([CHARTS[beyond[0]]], None, determinants, [message])
    lows = ", ".join(f"{n} {j.sign * j.low:.2g}" for n, j in determinants.items())
    raise FitError(
        f"no chart covers these data, with or without a base map: each has a determinant near 0 "
        f"({lows}), and no generating function exists there. Take pairs of a smaller dt or of a "
        "smaller region, or learn H, which needs no chart: --learn hamiltonian (learn=)"
    )


def _about(name, determinant: ChartDeterminant, what, valid) -> str:
    instead = [n for n in ("midpoint", "type2", "type3") if n in valid and n != name]
    advice = f". Use --chart {instead[0]} (chart=)" if instead else ". Take a smaller dt"
    return (
        f"chart {name} {what}: its determinant, of ∂w/∂z, falls to {determinant.low:.2g} and is "
        f"negative for {100 * determinant.negative:.0f} % of the states{advice}"
    )
