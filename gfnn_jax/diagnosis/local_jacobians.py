"""Diagnosis of the map from the pairs by themselves: local Jacobians, of neighbours. NumPy.

The Jacobians give the determinant of each chart over the data, and how symplectic the data are.
Neighbours also tell which pairs are outliers, and the residuals of a fit whether there is friction.
"""

from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]

from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.errors import FitError
from gfnn_jax.fitting.linear_starts import fit_half_map
from gfnn_jax.generating.charts import CHARTS, TYPE1, AnyChart
from gfnn_jax.maps.piece import Affine
from gfnn_jax.phase_space import Pairs, symplecticity_defect


class Options:
    """Options of the local fits (benchmarks/as_a_user.py)."""

    # States at which a Jacobian is taken: so many, or as many as so many operations allow, in
    # eight degrees of freedom 50 instead of ten seconds and more.
    centres: int = 400
    fewest_centres: int = 50
    operations: float = 5000000000.0
    # From so many pairs on the neighbourhoods keep their size: more pairs then average the noise
    # away instead of shrinking them below it.
    local_enough: int = 4_000
    most_neighbours: int = 1_000
    # Neighbours are sought among so many pairs: a tree of a million takes a second more.
    most_among: int = 200_000
    # of a neighbourhood's size: a thinner one says nothing of the direction across
    filled: float = 0.03
    # a smaller singular value of a local fit is a direction without neighbours
    spanned: float = 1e-8
    # Neighbourhoods grow until noise leaves no more than this error in the Jacobian's entries.
    slope_error: float = 0.05
    # Pairs are held not to be symplectic whose Jacobians are known well enough, as a part of
    # their distance from the identity, and miss by so many errors and by more than this part of
    # it.
    known: float = 0.06
    errors: float = 3.0
    missed: float = 0.1
    # Neighbours that spread less than this part of their largest spread do not fill a direction.
    thin: float = 0.05


# Neighbours per unknown of a local fit: enough to average noise, few enough to stay local.
NEIGHBOURS_PER_TERM = 3
# With more terms than these a local fit goes by its Gram matrix, which tells no directions apart
# that are smaller than the second figure: with 65 terms ten times as fast as singular values.
MANY_TERMS, _SPANNED_OF_GRAM = 40, 1e-7
# A determinant this far from zero is safe; below the lower figure the chart folds inside the data.
SAFE, SINGULAR = 0.2, 0.03


def check_number(pairs: Pairs) -> None:
    """Raises FitError where there are fewer pairs than a local Jacobian needs."""
    if len(pairs) < 8 * pairs.dim:
        turned = 8 * len(pairs) < 2 * pairs.dim
        raise FitError(
            f"expected at least {8 * pairs.dim} different pairs for d = {pairs.dim}, "
            f"got {len(pairs)}" + turned * ": a row is a state; are the arrays transposed?"
        )


class ChartDeterminant(NamedTuple):
    """The determinant of a chart over the data.

    low: its 1 % quantile towards zero, counted in the sign of the majority (negative where the sign
    changes). sign: of the majority. negative: the fraction below zero.
    """

    low: float
    sign: int
    negative: float

    @property
    def valid(self) -> bool:
        """Return whether w determines z over the data."""
        return self.low > SINGULAR


def local_jacobians(y0, y1, scale, given=None, *, seed: int = 0) -> tuple[np.ndarray, float]:
    """Jacobians of y0 -> y1 at 50 to 400 of the states, (n, 2d, 2d), and the error of their entries
    in coordinates of unit size, infinite where most are not known in all directions.

    y0, y1: (N, 2d) with angles lifted; scale (2d,) makes the coordinates comparable. given: (N, k)
    of unit sizes, what else a move depends on. A local
    quadratic fit where there are pairs enough, else a local linear one; over more neighbours where
    the pairs are noisy.
    """
    n, of_state = y0.shape
    x, move = np.asarray(y0) / scale, (np.asarray(y1) - np.asarray(y0)) / scale
    x = x if given is None else np.concatenate([x, given], axis=1)
    width = x.shape[1]
    i, j = np.triu_indices(width)
    quadratic = n >= 20 * (1 + width + len(i))
    terms = 1 + width + (len(i) if quadratic else 0)
    fewest = NEIGHBOURS_PER_TERM * terms
    count = min(n, max(fewest, min(Options.most_neighbours, fewest * n // Options.local_enough)))
    affordable = max(Options.fewest_centres, int(Options.operations / (6 * count * terms**2)))
    chosen = _centres(n, min(Options.centres, affordable), seed)
    among = _among(n, seed)
    tree = cKDTree(x[among])
    while True:
        _, near = tree.query(x[chosen], k=count)
        near = among[near]
        offset = x[near] - x[chosen][:, None, :]
        columns = [np.ones((*offset.shape[:2], 1)), offset]
        if quadratic:
            columns.append(offset[..., i] * offset[..., j])
        design = np.concatenate(columns, axis=-1)
        inverse = pseudo_inverse(design)
        solution = inverse @ move[near]
        rest = move[near] - design @ solution
        noise = np.sqrt(np.sum(rest**2, axis=1) / max(1, count - terms))
        spread = np.sqrt(np.sum(inverse[:, 1 : 1 + width] ** 2, axis=-1))
        error = np.median(noise.max(axis=1) * spread.max(axis=1))
        if error <= Options.slope_error or count >= min(n, Options.most_neighbours):
            break
        count = min(n, Options.most_neighbours, 2 * count)
    slope = np.eye(of_state) + np.swapaxes(solution[:, 1 : 1 + of_state], 1, 2)
    # How far neighbours reach in the direction where they differ least, apart from what the other
    # columns tell of it: along a curve or a torus the rest of the map is anybody's guess.
    reach = 1 / (np.sqrt(count) * spread.max(axis=1) * np.sqrt(np.mean(offset**2, axis=(1, 2))))
    if terms <= MANY_TERMS:
        apart = np.linalg.matrix_rank(design, rtol=Options.spanned) == terms
    else:
        squares = np.linalg.eigvalsh(np.swapaxes(design, 1, 2) @ design)
        apart = squares[:, 0] > _SPANNED_OF_GRAM**2 * squares[:, -1]
    filled = apart & (reach > Options.filled)
    known = float(error + 0.5 * count * error**2) if np.mean(filled) > 0.5 else np.inf
    return slope * scale[:, None] / scale[None, :], known


def centres(y0, jacobians, seed: int) -> np.ndarray:
    """(n, 2d): the states among y0 (N, 2d) at which `local_jacobians` of this seed are."""
    return np.asarray(y0)[_centres(len(y0), len(jacobians), seed)]


def _centres(count: int, most: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).permutation(count)[:most]


def _among(count: int, seed: int) -> np.ndarray:
    """The rows of so many among which neighbours are sought."""
    if count <= Options.most_among:
        return np.arange(count)
    return np.sort(_centres(count, Options.most_among, seed))


def pseudo_inverse(design):
    """Pseudo-inverses of local designs (n, neighbours, terms). They take the map for the identity
    in what the neighbours do not span: a thin tube of data, the torus of a single orbit."""
    if design.shape[-1] <= MANY_TERMS:
        return np.linalg.pinv(design, rcond=Options.spanned)
    across = np.swapaxes(design, 1, 2)
    gram = across @ design
    ridge = _SPANNED_OF_GRAM**2 * np.trace(gram, axis1=1, axis2=2)
    inverse = np.linalg.inv(gram + ridge[:, None, None] * np.eye(gram.shape[-1])) @ across
    return 2 * inverse - (inverse @ design) @ inverse  # a step of Newton's takes the ridge back


def chart_determinant(chart: AnyChart, jacobians, scale) -> ChartDeterminant:
    """The chart's determinant over the data; type 1's in coordinates of unit size."""
    dim = len(scale) // 2
    determinant = chart.determinant(np.asarray(jacobians))
    if chart.name == "type1":
        determinant = determinant * np.prod(scale[dim:] / scale[:dim])
    sign = 1 if np.median(determinant) >= 0 else -1
    low = float(np.quantile(sign * determinant, 0.01))
    return ChartDeterminant(low, sign, float(np.mean(determinant < 0)))


def data_defect(jacobians, scale) -> float:
    """Median over the data of ‖Mᵀ J M − J‖ (largest entry, coordinates of unit size).

    For pairs of a symplectic map that of the local fits' error.
    """
    return float(np.median(symplecticity_defect(np.asarray(jacobians), np.asarray(scale))))


def look_symplectic(jacobians, error: float, scale) -> bool:
    """Return whether the pairs may be those of a symplectic map, as far as their local Jacobians
    tell.

    Every map of a short step is close to the identity and so to a symplectic one: the defect is
    held against M − 1, and against the Jacobians' own error. Columns in another order miss by a
    third of M − 1 or more, as does a rate of friction that is as large as the system's own.
    """
    move = np.abs(jacobians * scale[None, None, :] / scale[None, :, None] - np.eye(len(scale)))
    size = float(np.median(move.max(axis=(1, 2))))
    defect = data_defect(jacobians, scale)
    most = max(Options.errors * error, Options.missed * size)
    return error > Options.known * size or defect <= most


def sampled_dimension(y, scale) -> int:
    """Dimension of the set that the states y (N, 2d) were sampled from: 1 along a curve, 2d where
    they fill a region.

    Local principal components: in how many directions, in units of scale (2d,), the neighbours of a
    state spread by more than a twentieth of their largest spread, in the median over the states.
    """
    x, width = np.asarray(y) / scale, np.shape(y)[1]
    count = min(len(x), NEIGHBOURS_PER_TERM * (1 + width))
    centres = np.linspace(0, len(x) - 1, min(Options.centres, len(x))).astype(int)
    among = x[_among(len(x), 0)]
    _, near = cKDTree(among).query(x[centres], k=count)
    offset = among[near] - among[near].mean(axis=1, keepdims=True)
    spread = np.linalg.svd(offset, compute_uv=False)
    return int(np.median(np.sum(spread > Options.thin * spread[:, :1], axis=1)))


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
    angles = data.coordinates.angles
    near_identity = {n: c for n, c in CHARTS.items() if n != "type1"}
    valid = [n for n in near_identity if determinants[n].valid and determinants[n].sign > 0]
    if request == "type1" and angles:
        raise FitError("chart type1 has no meaning for angles: (q, Q) is not periodic; use type2")
    if request != "auto":
        determinant = determinants[request]
        if determinant.valid:
            close = determinant.low < SAFE or determinant.sign < 0
            message = _about(request, determinant, "is close to singular over the data", valid)
            return Charts([CHARTS[request]], None, determinants, [message] if close else [])
        if valid:
            raise FitError(_about(request, determinant, "is singular over the data", valid))
    half = fit_half_map(data.y0, data.y1, data.scale, angles=angles, reversor=reversor)
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
    if request in ("auto", "type1") and determinants["type1"].valid and not angles:
        return Charts([TYPE1], None, determinants, [])
    beyond = [n for n in near_identity if determinants[n].valid]
    if request == "auto" and beyond:
        name, folded = beyond[0], "is used beyond a fold, where w turns back"
        message = _about(name, determinants[name], folded, ())
        return Charts([CHARTS[beyond[0]]], None, determinants, [message])
    lows = ", ".join(f"{n} {j.sign * j.low:.2g}" for n, j in determinants.items())
    raise FitError(
        "no chart covers these data, with or without a base map: each has a determinant near 0 "
        f"({lows}), and no generating function exists there. Take pairs of a smaller dt or region, "
        "or learn H without a chart: --learn hamiltonian"
    )


def _about(name, determinant: ChartDeterminant, what, valid) -> str:
    instead = [n for n in ("midpoint", "type2", "type3") if n in valid and n != name]
    advice = f". Use --chart {instead[0]}" if instead else ". Take a smaller dt"
    return (
        f"chart {name} {what}: its determinant, of ∂w/∂z, falls to {determinant.low:.2g} and is "
        f"negative for {100 * determinant.negative:.0f} % of the states{advice}"
    )
