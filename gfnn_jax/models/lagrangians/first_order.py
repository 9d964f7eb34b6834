"""First order, q̇ = f(q): the rival of a law of forces where positions tell the velocities.

Along one closed orbit, and of populations and membranes, velocities are functions of the positions,
and both follow the record. Every orbit of q̇ = f(q) is one of L = ½|q̇ − f(q)|², a
mechanical law with as many terms as f, f² and their gradients have. So the number of numbers
decides: coefficients, and d or 2d for the state that each part of the record begins with, beside
what they leave of it (Schwarz's criterion). An ellipse about a sun is a law of one force, and of a
dozen terms of f; a membrane is the other way round.
"""

from __future__ import annotations

import dataclasses
import re
from typing import Any

import numpy as np

from gfnn_jax.dataset.stretches import Arcs
from gfnn_jax.families.expressions import coordinate_names
from gfnn_jax.families.terms import Terms, exponents
from gfnn_jax.families.text import added, digits, plain
from gfnn_jax.fitting.evidence import EVIDENCE, criterion
from gfnn_jax.fitting.linearised import Linearised
from gfnn_jax.fitting.significance import significant
from gfnn_jax.models.lagrangians.fit import ArcProblem, LawFit
from gfnn_jax.models.lagrangians.nature import told_by_positions
from gfnn_jax.solve.latent_arcs import Defects, Fitted, Readings, flow_defects, observed_whole


class Options:
    """Options of the rival (`benchmarks/any_record.py`, one orbit).

    degree: of the polynomials f, at most. columns: of them at most. as_well: times the law's
    residual, up to which the rival's is another draw of the noise. rate: largest h‖f'‖ of a
    Runge–Kutta step; most: of them between nodes.
    """

    degree: int = 3
    columns: int = 60
    as_well: float = 1.1
    rate: float = 0.3
    most: int = 8


def products(dim: int, angles: tuple[int, ...], degree: int) -> Terms:
    """Products, up to a degree, of lengths, in the order of coordinates, then sines and cosines of
    ``angles``; sin² is 1 − cos², and left out."""
    q = coordinate_names(dim)[:dim]
    of = [x for i, x in enumerate(q) if i not in angles]
    of += [f"{function}({q[i]})" for function in ("sin", "cos") for i in angles]
    sines = slice(dim - len(angles), dim)
    rows = [(0,) * len(of), *exponents(len(of), degree)]
    return Terms(dim, tuple(of), tuple(row for row in rows if max(row[sines], default=0) < 2))


@dataclasses.dataclass(frozen=True, eq=False)
class FieldOnArcs:
    """q̇_i = Σ p_k φ_j of the pairs (i, j) = places (K, 2) along arcs of steps h (A, L − 1): the
    model of `Readings.fit`, by Runge–Kutta steps of order 4."""

    products: Terms
    places: np.ndarray
    h: np.ndarray
    substeps: int = 1

    def take(self, arcs: np.ndarray) -> FieldOnArcs:
        return dataclasses.replace(self, h=self.h[arcs])

    def observe(self, p: np.ndarray, x: np.ndarray) -> Any:
        return observed_whole(x, len(p))

    def matrix(self, p: np.ndarray) -> np.ndarray:
        """The coefficients as (d, J)."""
        c = np.zeros((self.products.dim, self.products.num_parameters))
        c[tuple(self.places.T)] = p
        return c

    def defects(self, p: np.ndarray, x: np.ndarray) -> Defects:
        d, c, h = x.shape[-1], self.matrix(p), self.h.reshape(-1, 1)
        i, j = self.places.T
        own = np.arange(len(p))

        def rates(z: np.ndarray, slope: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            values = self.products.term_values(z)
            moving = c @ self.products.term_gradients(z).swapaxes(1, 2) @ slope
            moving[:, i, d + own] += values[:, j]
            return values @ c.T, moving

        return flow_defects(rates, x, h, len(p), self.substeps)


@dataclasses.dataclass(frozen=True, eq=False)
class FirstOrder:
    """A field q̇ = f(q) that was fitted to arcs; rms (k,) of what it leaves for each free number."""

    model: FieldOnArcs
    fitted: Fitted
    rms: np.ndarray

    def text(self, names: tuple[str, ...]) -> str:
        """The equations, in the names of coordinates."""
        errors, parts = Linearised.of_arcs(self.fitted).errors, [[] for _ in names]
        terms = [
            re.sub(r"q(\d+)", lambda q: names[int(q[1]) - 1], plain(term))
            for term in self.model.products.term_names
        ]
        for (i, j), c, e in zip(self.model.places, self.fitted.p, errors, strict=True):
            number = digits(float(c), float(e))
            parts[i].append(f"{number}*{terms[j]}" if terms[j] else number)
        return ", ".join(
            f"{name}_dot = {added(own) or '0'}" for name, own in zip(names, parts, strict=True)
        )


def first_order(
    arcs: Arcs, angles: tuple[int, ...], sigma: np.ndarray, most: np.ndarray
) -> FirstOrder | None:
    """The plainest field that leaves at most ``most`` (k,) of arcs whose channels are the
    coordinates, with noise σ (k,); None where there is none."""
    d = arcs.y.shape[2]
    x, seen = arcs.x[..., :d], np.isfinite(arcs.y).all(axis=2)
    q, v = x[seen], arcs.x[..., d:][seen]
    h = np.diff(arcs.t, axis=1)
    for degree in range(1, Options.degree + 1):
        library = products(d, angles, degree)
        if library.num_parameters > Options.columns:
            break
        values, slopes = library.term_values(q), library.term_gradients(q).swapaxes(1, 2)
        size = np.linalg.norm(values, axis=0)
        c = (np.linalg.lstsq(values / size, v, rcond=1e-9)[0] / size[:, None]).T
        rate = np.abs(c @ slopes).sum(axis=2).max(axis=1)
        fast = float(np.quantile(rate, 0.99) * np.max(h)) / Options.rate
        places = np.argwhere(np.ones_like(c, bool))
        model = FieldOnArcs(library, places, h, int(np.clip(np.ceil(fast), 1, Options.most)))
        found = _fitted(model, c.ravel(), arcs, x, sigma)
        if found is not None and np.all(found.rms <= Options.as_well * most):
            return _pruned(found, arcs, sigma, Options.as_well * most)
    return None


def _fitted(
    model: FieldOnArcs, p: np.ndarray, arcs: Arcs, x: np.ndarray, sigma: np.ndarray
) -> FirstOrder | None:
    """The field fitted from coefficients p and states x (A, L, d); None where it follows none."""
    noise = sigma * arcs.noise
    speed = np.max(np.abs(np.diff(x, axis=1)), axis=(0, 1))
    scale = np.maximum(sigma, 1e-6 * speed)
    fitted = Readings(model, arcs.y, noise).fit(p, x, scale, tolerance=1e-3, max_iterations=15)
    if not np.isfinite(fitted.cost):
        return None
    left = fitted.residuals * noise
    count = np.isfinite(left).sum(axis=(0, 1))
    free = np.maximum(count - len(x) - len(p) / x.shape[2], 1)
    return FirstOrder(model, fitted, np.sqrt(np.nansum(left**2, axis=(0, 1)) / free))


def _pruned(found: FirstOrder, arcs: Arcs, sigma: np.ndarray, most: np.ndarray) -> FirstOrder:
    """The field without terms that are not significant, close to the fit."""
    while True:
        model, near = found.model, Linearised.of_arcs(found.fitted)
        kept, p = significant(near.triangle, near.p, EVIDENCE.significant, 1.0)
        if not 0 < len(kept) < len(near.p):
            return found
        smaller = dataclasses.replace(model, places=model.places[kept])
        other = _fitted(smaller, p, arcs, found.fitted.x, sigma)
        if other is None or np.any(other.rms > most):
            return found
        found = other


def plain_field(problem: ArcProblem, names: tuple[str, ...]) -> str:
    """The equations of first order that follow the arcs of a problem to their noise, in the names
    of coordinates; "" where there are none, or inputs act."""
    if not _applies(problem):
        return ""
    sigma = problem.scales.sigma
    found = first_order(problem.arcs(1.0), problem.angles, sigma, sigma)
    return "" if found is None else found.text(names)


def _applies(problem: ArcProblem) -> bool:
    """Return whether a problem has a rival of first order: one of several coordinates that are seen
    as they are, without inputs or parameters, whose positions tell their velocities."""
    q, v = np.split(problem.states, 2, axis=1)
    others = problem.num_inputs or problem.parameters or not problem.observation.is_plain
    return not others and told_by_positions(q, v, problem.angles)


def rival(fit: LawFit, names: tuple[str, ...]) -> str:
    """A line on the field of first order that follows a record as a law does, with as few numbers;
    "" where there is none, or where the law has clearly fewer."""
    problem, d = fit.problem, fit.form.dim
    if not _applies(problem):
        return ""
    arcs = dataclasses.replace(fit.followed, y=fit.arcs.y - fit.zeros)
    count = np.isfinite(arcs.y).sum(axis=(0, 1))
    free = np.maximum(count - 2 * len(arcs.t) - len(fit.p) / d, 1)
    own = fit.rms() * np.sqrt(count / free)
    found = first_order(arcs, problem.angles, fit.sigma, own)
    if found is None:
        return ""
    parts, n = len({i for i, _, _ in arcs.home}), float(count.sum()) / fit.correlation
    numbers = len(found.fitted.p) + d * parts, len(fit.p) + 2 * d * parts
    costs = [np.exp(2 * np.mean(np.log(rms))) for rms in (found.rms, own)]
    unlikely, likely = (criterion(c, n, k) for c, k in zip(costs, numbers, strict=True))
    if unlikely - likely > EVIDENCE.deciding:
        return ""
    return (
        "first order or mechanical: along this record the positions determine the velocities, and "
        f"{found.text(names)} follows it as the law does, with {numbers[0]} numbers for its "
        f"{numbers[1]}. Another start at the same positions would decide"
    )
