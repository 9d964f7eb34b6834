"""The brackets that a field allows, each with its H, and the rule that chooses among several.

Where several brackets make the same motion, the one is taken whose algebra has a name and an exact
step, compact before other; then that of fewest constants; in three dimensions, where a pencil of
brackets shares the motion, the one whose Casimir is nearest to a sphere in units of the
coordinates. NumPy.
"""

import contextlib
import dataclasses
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import least_squares, minimize

from gfnn_jax.brackets import Bracket, jacobi_failure
from gfnn_jax.errors import FitError
from gfnn_jax.families.terms import Terms, exponents, multiplied
from gfnn_jax.flows.damped import Dilations
from gfnn_jax.models.brackets.algebra import Algebra, analysed
from gfnn_jax.models.brackets.null_space import CONSTANT, LINEAR, LOG, NullSpace
from gfnn_jax.models.brackets.poisson_field import (
    OfField,
    PoissonField,
    hamiltonian_of,
    sparse,
    term_sizes,
)


class Options:
    """Options of the choice among brackets (benchmarks/brackets.py)."""

    # ÷ the largest constant: a constant, or a failure of Jacobi's identity, that is none
    zero: float = 1e-8
    misfit: float = 1e-8  # of f that a bracket with H may leave, relative
    # times these: entries of y = Lz that are whole numbers, and a constant part that is none
    snapped: float = 10.0
    rounded: float = 1.5  # times the least misfit: that of constants made whole numbers
    starts: int = 6  # random combinations of several null vectors, brought to Jacobi's identity
    places: int = 12  # of largest constants, at which null vectors of few constants are looked for
    seed: int = 0


class Found(NamedTuple):
    """A bracket that a field allows. hamiltonian: H over ``library``. several: number m of
    independent bivectors that the flow conserves. name: of its kind. rule: why it was taken."""

    field: PoissonField
    name: str
    hamiltonian: OfField
    several: int
    rule: str

    @property
    def rank(self) -> tuple:
        """Order of preference, least first."""
        blocks = getattr(self.field.bracket, "blocks", None)
        return (
            self.hamiltonian.misfit > Options.misfit,
            blocks == (),
            self.several_terms,
        )

    @property
    def several_terms(self) -> int:
        """Number of constants of the bracket."""
        bracket = self.field.bracket
        probe = np.random.default_rng(Options.seed).uniform(0.5, 1.5, bracket.size)
        return len(bracket.relations()) + int(np.count_nonzero(bracket.matrix(probe)))


def polynomials(
    names: tuple[str, ...], degree: int, *, constant: bool = False, factors: Terms | None = None
) -> Terms:
    """All monomials of degree 1 to ``degree`` in the coordinates of these names, times all of the
    factors; with 1 first."""
    rows = exponents(len(names), degree)
    return _times(names, ((0,) * len(names), *rows) if constant else tuple(rows), names, factors)


def _times(variables, rows, names: tuple[str, ...], factors: Terms | None) -> Terms:
    """Products of these terms and the factors, whose names are the coordinates' and more."""
    if factors is None:
        return Terms(0, variables, rows, (), names)
    return multiplied(Terms(0, variables, rows, (), factors.names), factors)


def library_of(
    kind: str,
    names: tuple[str, ...],
    degree: int,
    given: Terms | None,
    factors: Terms | None = None,
) -> Terms:
    """Terms of H for a field of this degree, times the factors."""
    if given is not None:
        return given
    if kind == CONSTANT:
        return polynomials(names, degree + 1, factors=factors)
    if kind == LINEAR:
        return polynomials(names, degree, factors=factors)
    n, own = len(names), exponents(len(names), max(degree - 1, 1))
    logs = [tuple(int(k == n + i) for k in range(2 * n)) for i in range(n)]
    rows = (*logs, *((*row, *(0,) * n) for row in own))
    return _times((*names, *(f"log({name})" for name in names)), rows, names, factors)


def brackets_of(
    null: NullSpace, z: np.ndarray, f: np.ndarray, library: Terms, noise: float = 0.0
) -> list[Found]:
    """Brackets among the null vectors with an H whose B∇H is the field, best first; of those that
    shrink with the uniform friction that the field then has.

    z, f: (N, ≥ n) states, with what H depends on beside them, and the field there. noise: of f,
    relative.
    """
    found, states = [], z[:, : null.tensors.width]
    names = library.names[: null.tensors.width]
    for vector, rule in _combinations(null, states, noise):
        made = [
            (name, *_with_energy(bracket, library, z, f, noise, bool(null.rate)))
            for bracket, name in _made(null, vector, names, noise, states)
        ]
        least = min((own.misfit for *_, own in made), default=0.0)
        limit = min(max(Options.misfit, 3 * noise), Options.rounded * least + Options.misfit)
        for name, field, own in made:
            if own.misfit <= limit:
                found.append(Found(field, name, own, len(null.vectors), rule))
    return sorted(found, key=lambda one: one.rank)


def _combinations(null: NullSpace, z: np.ndarray, noise: float) -> Iterator[tuple[np.ndarray, str]]:
    """Null vectors, or combinations of several that may have Jacobi's identity, each with the rule
    that takes it; its largest coefficient is 1 in units of the coordinates."""
    if len(null.vectors) == 1:
        yield null.vectors[0], ""
        return
    if not len(null.vectors):
        return
    rows, few = sparse_rows(null.vectors), "that of fewest constants"
    if null.tensors.kind != LINEAR:
        yield from ((row, few) for row in (*rows, rows.sum(axis=0)))
        return
    if null.tensors.width == 3:
        yield _nearest_sphere(null, rows, z), "the one whose Casimir is nearest to a sphere"
    yield from ((row, few) for row in rows if _jacobi(null, row) <= max(Options.zero, noise))
    rng, many = np.random.default_rng(Options.seed), null.tensors.width > 6
    for _ in range(0 if many else Options.starts):
        start = rng.normal(size=len(rows))
        start /= np.linalg.norm(start)
        solved = least_squares(
            lambda t: np.append(_identity(_constants(null, t @ rows)[1]).ravel(), t @ t - 1), start
        )
        vector = solved.x @ rows
        if _jacobi(null, vector) <= max(Options.zero, noise):
            yield vector, few


def sparse_rows(vectors: np.ndarray) -> np.ndarray:
    """Vectors of few entries that span the same space as vectors (m, J), the fewest first: each the
    one of least Σ|x_j| whose entry at one place is 1 (Spielman, Wang & Wright, COLT 2012)."""
    found = list(vectors)
    size = np.linalg.norm(vectors, axis=0)
    places = np.argsort(-size)[: Options.places]
    for place in places[size[places] > Options.zero * size.max()]:
        first = vectors[:, place] / (vectors[:, place] @ vectors[:, place])
        others = np.linalg.svd(vectors[:, place][None], full_matrices=True)[2][1:]
        found.append(sparse(first @ vectors, others @ vectors))
    found = [x / np.abs(x).max() for x in found]
    rows: list[np.ndarray] = []
    for x in sorted(found, key=lambda x: int((np.abs(x) > Options.zero).sum())):
        if np.linalg.matrix_rank(np.array([*rows, x]), tol=1e-6) > len(rows):
            rows.append(x)
    return np.array(rows)


def _constants(null: NullSpace, vector: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """B_0 (n, n) and c (n, n, n) of an affine bivector."""
    n = null.tensors.width
    table = vector.reshape(-1, n + 1)
    form, c = np.zeros((n, n)), np.zeros((n, n, n))
    for row, (a, b) in zip(table, null.tensors.places, strict=True):
        form[a, b], form[b, a] = row[0], -row[0]
        c[a, b], c[b, a] = row[1:], -row[1:]
    return form, c


def _identity(c: np.ndarray) -> np.ndarray:
    once = np.einsum("ijl,lkm->ijkm", c, c)
    return once + once.transpose(1, 2, 0, 3) + once.transpose(2, 0, 1, 3)


def _jacobi(null: NullSpace, vector: np.ndarray) -> float:
    """Failure of Jacobi's identity, ÷ the square of the constants."""
    c = _constants(null, vector)[1]
    return jacobi_failure(c) / max(np.abs(c).max() ** 2, 1e-300)


def _nearest_sphere(null: NullSpace, rows: np.ndarray, z: np.ndarray) -> np.ndarray:
    """The combination (J,) whose Casimir ½ zᵀQz has the least condition number, in units of the
    coordinates: B = [Qz]ₓ in three dimensions."""
    scale = np.sqrt(np.mean(z**2, axis=0))
    constants = (_constants(null, row)[1] for row in rows)
    forms = np.array([[c[1, 2], c[2, 0], c[0, 1]] for c in constants])
    forms = 0.5 * (forms + forms.transpose(0, 2, 1)) * scale * scale[:, None]
    norms = np.linalg.norm(forms, axis=(1, 2))
    forms /= norms[:, None, None]

    def condition(t: np.ndarray) -> float:
        values = np.linalg.eigvalsh(np.tensordot(t / np.linalg.norm(t), forms, 1))
        return float(np.abs(values).max() / max(np.abs(values.sum()) / 3, 1e-9) + np.ptp(values))

    rng = np.random.default_rng(Options.seed)
    starts = rng.normal(size=(Options.starts, len(rows)))
    best = min((minimize(condition, t, method="Nelder-Mead") for t in starts), key=lambda s: s.fun)
    return (best.x / norms) @ rows


def _made(
    null: NullSpace, vector: np.ndarray, names: tuple[str, ...], noise: float, z: np.ndarray
) -> Iterator[tuple[Bracket, str]]:
    """The bracket of a null vector, in standard constants where there are such and all states z
    (N, n) have a step."""
    n, zero = null.tensors.width, max(Options.zero, noise)
    if null.tensors.kind != LINEAR:
        form = np.zeros((n, n))
        for value, (a, b) in zip(vector, null.tensors.places, strict=True):
            form[a, b], form[b, a] = value, -value
        form = _rounded(form / np.abs(form).max(), zero)
        if null.tensors.kind == LOG:
            yield Bracket.log(form, names), "log-canonical"
        else:
            yield Bracket.constant(form, names), "constant"
        return
    form, raw = _constants(null, vector)
    c = np.where(np.abs(raw) > zero * np.abs(raw).max(), raw, 0.0)
    if np.abs(form).max() > Options.snapped * zero * np.abs(vector).max():
        with contextlib.suppress(FitError, np.linalg.LinAlgError):  # not one of a charge
            magnetic = _magnetic(form, c, names, zero)
            if magnetic is not None:
                yield magnetic, "canonical after p = v + A(x)"
        return
    # what is zero of a Killing form is less certain than constants are
    tried = [analysed(c, min(factor * zero, 0.1)) for factor in (10.0, 100.0)]
    algebra = next((a for a in tried if a.lifted is not None), tried[0])
    if algebra.lifted is not None:
        basis, inside = sized(algebra, z), False
        bases = [(basis, Options.snapped * zero), (basis, zero)]
        exact = analysed(raw, min(100 * zero, 0.1)) if noise > Options.zero else algebra
        if exact is not algebra and exact.blocks == algebra.blocks:
            bases.append((sized(exact, z), Options.zero))  # constants that are small, and no noise
        for basis, by in bases:
            with contextlib.suppress(FitError):  # rounded to a singular one
                bracket = Bracket.lie(algebra.blocks, _rounded(basis, by), names)
                if not bracket.outside(z).any():
                    inside = True
                    yield bracket, algebra.name
        if inside:
            return
    c = _rounded(c / (np.abs(c).max() or 1.0), zero)
    if c.any() and jacobi_failure(c) <= 1e-10:
        yield Bracket.from_constants(c, names), algebra.name


def sized(algebra: Algebra, z: np.ndarray) -> np.ndarray:
    """L of an algebra, y = Lz as large as z: B is known but for a factor, which H has the inverse
    of."""
    basis = np.array(algebra.lifted)
    if "aff" in algebra.blocks:  # {a, b} = a holds for a of any size and sign
        a, b = (np.arange(2 * algebra.blocks.count("aff"))[k::2] for k in (0, 1))
        basis[a] *= np.sign(np.median(z @ basis[a].T, axis=0))[:, None]
        basis[b] /= np.abs(basis[b]).max()
        still = basis[2 * len(a) :]  # of Casimirs, whose whole numbers are told only at this size
        still /= np.abs(still).max(axis=1, keepdims=True)
        return basis
    basis *= np.sqrt(3) / np.linalg.norm(basis[:3])
    if algebra.blocks == ("se3",):  # {M, Γ} = Γ holds for Γ of any size
        basis[3:] *= np.sqrt(3) / np.linalg.norm(basis[3:])
    return basis


def _rounded(values: np.ndarray, zero: float) -> np.ndarray:
    """Entries that are 0 but for what is zero, and whole numbers but for it."""
    near = np.round(values)
    return np.where(np.abs(values - near) <= zero * np.abs(values).max(), near + 0.0, values)


def _magnetic(form, c, names, zero: float) -> Bracket | None:
    """{x_i, v_j} constant, {v_i, v_j} affine in x; None of any other affine bracket."""
    n = len(form)
    size = np.abs(form).max()
    still = [i for i in range(n) if np.abs(c[i]).max() == 0]
    d = n // 2
    x, v = list(range(d)), list(range(d, n))
    if n % 2 or not set(x) <= set(still) or np.abs(form[np.ix_(x, x)]).max() > zero * size:
        return None
    if np.abs(c[np.ix_(v, v, v)]).max(initial=0.0) > 0:
        return None
    form, c = form / form[0, d], c / form[0, d]
    inverse = form[np.ix_(x, v)]
    mass = np.linalg.inv(inverse)
    field = np.concatenate([form[np.ix_(v, v)][None], np.moveaxis(c[np.ix_(v, v, x)], -1, 0)])
    field = _rounded(mass @ field @ mass, zero)
    powers = np.concatenate([np.zeros((1, d), int), np.eye(d, dtype=int)])
    kept = [k for k, f in enumerate(field) if np.abs(f).max() > 0]
    return Bracket.magnetic(field[kept], powers[kept], _rounded(mass, zero), names)


def _with_energy(bracket, library, z, f, noise, damped: bool) -> tuple[PoissonField, OfField]:
    """The field with H, convex where it can be."""
    field = PoissonField(bracket, library, Dilations.of(bracket) if damped else None)
    own = hamiltonian_of(field, z, f, noise)
    bracket, c = upright(bracket, library, field.of_h(own.c), z)
    c = np.concatenate([c, own.c[len(c) :]])
    return dataclasses.replace(field, bracket=bracket), own._replace(c=c)


def upright(bracket: Any, library: Terms, c: np.ndarray, z: np.ndarray) -> tuple[Any, np.ndarray]:
    """The bracket and H, both reversed where H would be concave: (−B, −H) is the same motion."""
    some = z[:: max(1, len(z) // 50)]
    hessian, n = library.gradient_and_hessian(c, some)[1], bracket.size
    bends = (np.diagonal(hessian, axis1=1, axis2=2) * np.mean(z**2, axis=0))[:, :n]
    if np.abs(bends.sum()) <= 1e-6 * np.abs(bends).sum():
        bends = c * term_sizes(library, z)
    if bends.sum() >= 0:
        return bracket, c
    return _reversed(bracket), -c


def _reversed(bracket: Any) -> Any:
    """−B."""
    if hasattr(bracket, "constants"):
        return bracket.opposite
    if hasattr(bracket, "form"):
        return dataclasses.replace(bracket, form=-bracket.form)
    return dataclasses.replace(bracket, field=-bracket.field, mass=-bracket.mass)
