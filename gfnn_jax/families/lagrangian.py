"""A Lagrangian with forces, linear in its coefficients: the law of a mechanical system as arrays.

    d/dt ∂L/∂v − ∂L/∂q + ∂R/∂v = G u,      L = Σ θ_j ℓ_j(q, v),      R = Σ ρ_k r_k(v)

    ℓ_j = ∏ v_i^k_ji · ∏ q_i^n_ji · cos(m_j·q + φ_j) · g_j(q)

k, n and m are whole numbers, and a term has at most two factors v: kinetic, gyroscopic and
potential terms. g, where a term has one, is any other formula: its *shape*, 1/√(q1² + q2²) or
exp(−q1); of a term without v it may have inputs too, u1²/(0.3 + q1). R is that of
`families.friction`. Everything is batch first, in closed form, and runs in NumPy or JAX.

Of systems that differ in parameters μ, a length or a mass, each coefficient is multiplied by a
product of whole powers of these: L = Σ θ_j ∏ μ_i^a_ji ℓ_j(q, v), and R and G alike. The law of one
system, `Lagrangian.at`, has plain coefficients again.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from functools import cache, cached_property
from typing import Any, NamedTuple

import numpy as np

from gfnn_jax.arrays import as_row, matmul, namespace, pytree
from gfnn_jax.families.expressions import (
    Expression,
    coordinate,
    depends_on,
    has_parameters,
    leaves,
    number,
    parse,
    to_named_text,
    to_text,
    with_leaves,
)
from gfnn_jax.families.friction import Friction
from gfnn_jax.families.jets import jets
from gfnn_jax.families.text import added, combination, power

INPUTS = tuple(f"u{j + 1}" for j in range(64))  # their names in shapes
MAX_POWER = 8  # of one coordinate in one term; powers come from a table of this length
Powers = tuple[tuple[int, ...], ...]  # of the parameters, (m, k), for each coefficient


class Potentials(NamedTuple):
    """The factors of terms that depend on q, with derivatives, None above the order asked."""

    value: Any  # (..., P)
    slope: Any  # (..., P, d)
    curvature: Any  # (..., P, d, d)


class Derivatives(NamedTuple):
    """L and its derivatives; ``by_vq`` [..., i, j] is ∂²L/∂v_i∂q_j, ``by_qv`` ∂²L/∂q_i∂v_j, and
    ``by_vv`` the masses M. Rows i are those of the terms that act on coordinate i."""

    value: Any  # (...)
    by_q: Any  # (..., d)
    by_v: Any  # (..., d)
    by_qq: Any  # (..., d, d)
    by_vq: Any  # (..., d, d)
    by_qv: Any  # (..., d, d)
    by_vv: Any  # (..., d, d)


def shape_of(row: Sequence[Any]) -> str:
    """The shape of a row (k, n, m, φ, shape), as text in q1, …, qd and inputs u1, …; "" where it
    has none."""
    return row[4] if len(row) > 4 and isinstance(row[4], str) else ""


@cache
def tree_of(shape: str, dim: int) -> Expression:
    """The tree of a shape, whose parameters are the inputs; of "" that of 1."""
    return parse(shape or "1", dim, INPUTS)


def has_inputs(row: Sequence[Any]) -> bool:
    """Return whether a row has inputs in its shape."""
    return has_parameters(tree_of(shape_of(row), len(row[0])))


def coordinates_in(row: Sequence[Any], phased: bool = True) -> tuple[bool, ...]:
    """Return whether the factor f(q) of a row depends on each coordinate; where not ``phased``, by
    its powers and its shape alone."""
    powers, wave = row[1:3]
    found = [bool(n or (m and phased)) for n, m in zip(powers, wave, strict=True)]
    for i in depends_on(tree_of(shape_of(row), len(powers))):
        found[i] = True
    return tuple(found)


def row_about(row: Sequence[Any], centre: Mapping[int, float]) -> tuple[Any, ...]:
    """A row whose powers and shape are of q_i − c_i in place of q_i."""
    speeds, powers, wave, phase = row[:4]

    def moved(leaf: Expression) -> Expression:
        at = centre.get(leaf.operands[0]) if leaf.operation == "coordinate" else None
        return leaf if at is None else leaf - at

    d, kept = len(powers), tuple(0 if i in centre else n for i, n in enumerate(powers))
    tree = with_leaves(tree_of(shape_of(row), d), moved)
    for i, n in enumerate(powers):
        tree = tree * (coordinate(i) - centre[i]) ** n if n and i in centre else tree
    shape = to_text(tree, d, INPUTS)
    return (speeds, kept, wave, phase, shape if shape != "1" else "")


@pytree("shapes", "leaders")
class Terms:
    """The terms ℓ_j of a Lagrangian: whole numbers k, n and m, each (P, d), phases (P,), and their
    shapes as text in q1, …, qd and inputs u1, …, "" of a term without, () where none has one.

    A phase is 0 for a cosine and −π/2 for a sine. leaders: coordinates that move others and are not
    moved by them, as a cart whose motor holds its course: a term with one of the others acts on the
    others alone.
    """

    speeds: Any
    powers: Any
    modes: Any
    phases: Any
    shapes: tuple[str, ...] = ()
    leaders: tuple[int, ...] = ()

    @staticmethod
    def of(rows: Sequence[Sequence[Any]], dim: int, leaders: tuple[int, ...] = ()) -> Terms:
        """Make it of rows (k, n, m, φ) or (k, n, m, φ, shape). Raises ValueError for more than two
        factors v, or a power > 8."""
        k, n, m = (np.array([r[i] for r in rows], dtype=int).reshape(-1, dim) for i in range(3))
        if (k.sum(1) > 2).any() or k.min(initial=0) < 0:
            raise ValueError("a term of a Lagrangian has at most two factors v")
        if n.max(initial=0) > MAX_POWER or n.min(initial=0) < 0:
            raise ValueError(f"powers of coordinates are from 0 to {MAX_POWER}")
        shapes = tuple(map(shape_of, rows))
        phases = np.array([float(r[3]) for r in rows])
        return Terms(k, n, m, phases, shapes if any(shapes) else (), leaders)

    @property
    def count(self) -> int:
        return self.speeds.shape[0]

    @property
    def dim(self) -> int:
        return self.speeds.shape[1]

    def rows(self) -> list[tuple]:
        """(k, n, m, φ), and the shape where there is one, of each term, hashable."""
        whole = (self.speeds, self.powers, self.modes)
        shapes = [(s,) if s else () for s in self.shapes] or [()] * self.count
        return [
            (*(tuple(map(int, a[j])) for a in whole), float(self.phases[j]), *shapes[j])
            for j in range(self.count)
        ]

    @cached_property
    def trees(self) -> dict[int, Expression]:
        """The shapes of the terms that have one."""
        return {j: tree_of(text, self.dim) for j, text in enumerate(self.shapes) if text}

    @cached_property
    def driven(self) -> bool:
        """Return whether some term has inputs in its shape."""
        return any(map(has_parameters, self.trees.values()))

    def first_inputs(self, count: int) -> np.ndarray:
        """1 (P, count) of each term that has inputs, at the first of them; 0 elsewhere."""
        found = np.zeros((self.count, count))
        for j, tree in self.trees.items():
            for leaf in [x for x in leaves(tree) if x.operation == "parameter"][:1]:
                found[j, leaf.operands[0]] = 1.0
        return found

    def texts(
        self, names: Sequence[str], speeds: Sequence[str], inputs: Sequence[str] = INPUTS
    ) -> tuple[str, ...]:
        """Each term as code in the names of the coordinates, their velocities and the inputs; a
        phase other than that of a cosine or a sine stays in the argument."""
        listed = []
        for j, (k, n, m, phase, *_) in enumerate(self.rows()):
            factors = [power(x, e) for x, e in zip((*speeds, *names), (*k, *n), strict=True) if e]
            if any(m):  # cos or sin of m·q + φ, whichever has the smaller |φ|
                sine = abs(phase + np.pi / 2) < np.pi / 4
                rest = phase + np.pi / 2 if sine else phase
                shift = [f"{rest:.5g}"] if abs(rest) > 1e-12 else []
                inside = added([combination(m, names), *shift])
                factors.append(f"{'sin' if sine else 'cos'}({inside})")
            text = "*".join(factors)
            if j in self.trees:
                shape = to_named_text(self.trees[j], names, inputs, as_factor=True)
                below = text and shape.startswith("1/")
                text = text + shape[1:] if below else "*".join([*factors, shape])
            listed.append(text or "1")
        return tuple(listed)

    def take(self, keep: Any) -> Terms:
        """The terms with these indices, or where this mask holds."""
        shapes = tuple(np.array(self.shapes or [""] * self.count, dtype=object)[keep])
        own = (self.speeds[keep], self.powers[keep], self.modes[keep], self.phases[keep])
        return Terms(*own, shapes if any(shapes) else (), self.leaders)

    @property
    def follows(self) -> Any:
        """Return whether each term (P,) is one of coordinates that are moved by ``leaders``."""
        others = [i for i in range(self.dim) if i not in self.leaders]
        touched = (self.speeds != 0) | (self.powers != 0) | (self.modes != 0)
        of_shape = np.zeros(touched.shape, bool)
        for j, tree in self.trees.items():
            of_shape[j, list(depends_on(tree))] = True
        return (touched | of_shape)[:, others].any(axis=1)

    def acting(self, values: Any, axes: int = 1) -> Any:
        """Values (..., P, d, …) of the terms, with this many ``axes`` from d on, 0 in the rows d of
        coordinates that a term does not act on."""
        if not self.leaders:
            return values
        leads = np.isin(np.arange(self.dim), self.leaders)[None]
        acts = ~(self.follows[:, None] & leads).reshape(*self.speeds.shape, *(1,) * (axes - 1))
        return values * as_row(acts.astype(values.dtype), values)

    def quadratic(self) -> tuple[Any, Any, Any]:
        """A (P, d, d), b (P, d), c (P,) of ∏ v_i^k_i = ½ vᵀA v + b·v + c."""
        return self._known_quadratic if namespace(self.phases) is np else self._quadratic()

    @cached_property
    def _known_quadratic(self) -> tuple[Any, Any, Any]:
        return self._quadratic()

    def _quadratic(self) -> tuple[Any, Any, Any]:
        xp, k = namespace(self.phases), self.speeds
        k = k.astype(self.phases.dtype)
        degree = k.sum(1)
        outer = k[:, :, None] * k[:, None, :]
        twice, once, never = ((degree == n).astype(k.dtype) for n in (2, 1, 0))
        own = as_row(xp.eye(self.dim, dtype=k.dtype), outer) * k[:, None, :]
        return (outer - own) * twice[:, None, None], k * once[:, None], never

    def potentials(self, q: Any, order: int = 2, u: Any = None) -> Potentials:
        """∏ q_i^n_i cos(m·q + φ) g(q) at q (..., d), with its derivatives up to ``order`` 0, 1 or
        2; u (..., inputs), None for none: terms that have inputs are 0 there."""
        found = self._waves(q, order)
        if not self.shapes:
            return found
        trees = self.trees
        if u is None and self.driven:
            trees = {j: number(0.0) if has_parameters(g) else g for j, g in trees.items()}
        return _shaped(found, trees, q, order, u if self.driven else None)

    def _waves(self, q: Any, order: int) -> Potentials:
        """The same without shapes."""
        xp = namespace(q)
        m = self.modes.astype(q.dtype)
        phase = matmul(q, m.T)
        phase = phase + as_row(self.phases, phase)
        cos = xp.cos(phase)
        plain = xp is np and not np.any(self.powers)  # angles alone: no powers to compute
        if plain and order == 0:
            return Potentials(cos, None, None)
        sin = xp.sin(phase) if order > 0 else None
        if plain:
            slope = -_outer(sin, m)
            curvature = None
            if order > 1:
                curvature = -_outer(cos, m[:, :, None] * m[:, None, :])
            return Potentials(cos, slope, curvature)
        b, db, ddb = _monomials(q, self.powers, order)
        slope = curvature = None
        if order > 0:
            dcos = -_outer(sin, m)
            slope = dcos * b[..., None] + cos[..., None] * db
        if order > 1:
            both = dcos[..., :, None] * db[..., None, :]
            ddcos = -_outer(cos, m[:, :, None] * m[:, None, :])
            curvature = ddcos * b[..., None, None] + cos[..., None, None] * ddb
            curvature = curvature + both + xp.swapaxes(both, -1, -2)
        return Potentials(cos * b, slope, curvature)

    def motion(self, v: Any) -> tuple[Any, Any]:
        """∏ v_i^k_i (..., P) and its gradient (..., P, d) at v (..., d)."""
        A, b, c = self.quadratic()
        slope = matmul(v, A.reshape(-1, self.dim).T).reshape(*v.shape[:-1], *b.shape)
        b = as_row(b, slope)
        value = (v[..., None, :] * (0.5 * slope + b)).sum(-1)
        return value + as_row(c, value), slope + b

    def residuals(self, q: Any, v: Any, a: Any) -> Any:
        """d/dt ∂ℓ_j/∂v − ∂ℓ_j/∂q along motion with acceleration a: (..., P, d)."""
        f, df, _ = self.potentials(q, order=1)
        g, dg = self.motion(v)
        A, _, _ = self.quadratic()
        push = matmul(a, A.reshape(-1, self.dim).T).reshape(*a.shape[:-1], *A.shape[:2])
        along = (df * v[..., None, :]).sum(-1)
        return self.acting(push * f[..., None] + dg * along[..., None] - g[..., None] * df)


@pytree("powers")
class Lagrangian:
    """L = Σ θ_j ℓ_j with θ ``coefficients`` (P,), friction R = Σ ρ_k r_k with ρ ``losses`` (F,),
    uniform friction −γ ∂L/∂v with γ ``uniform`` in 1/time, and gains G (d, inputs) of inputs u.

    powers: of the system's parameters, by which (θ, ρ, G row by row) are multiplied; None where the
    law has no parameters. Values and forces are those of the law of one system, `at`.
    """

    terms: Terms
    coefficients: Any
    friction: Friction
    losses: Any
    uniform: Any
    gains: Any
    powers: Powers | None = None

    @property
    def dim(self) -> int:
        return self.terms.dim

    @property
    def num_inputs(self) -> int:
        return self.gains.shape[-1]

    def at(self, args: Any) -> Lagrangian:
        """The law of the system with these parameters (k,), or of one for each lane (..., k)."""
        if self.powers is None:
            return self
        weights, first = functions_of(self.powers, args), self.terms.count
        last = first + self.friction.count
        of_gains = weights[..., last:].reshape(*weights.shape[:-1], *self.gains.shape)
        return dataclasses.replace(
            self,
            coefficients=self.coefficients * weights[..., :first],
            losses=self.losses * weights[..., first:last],
            gains=self.gains * of_gains,
            powers=None,
        )

    def derivatives(self, q: Any, v: Any, u: Any = None) -> Derivatives:
        """L and its first and second derivatives at q, v (..., d); u as in `Terms.potentials`."""
        f, df, ddf = self.terms.potentials(q, u=u)
        g, dg = self.terms.motion(v)
        A, _, _ = self.terms.quadratic()
        theta, acting = as_row(self.coefficients, f), self.terms.acting
        weight, swapped = theta * g, namespace(f).swapaxes
        by_vq = (theta[..., None, None] * acting(dg)[..., :, None] * df[..., None, :]).sum(-3)
        by_qv = swapped(by_vq, -1, -2)
        if self.terms.leaders:
            by_qv = (theta[..., None, None] * acting(df)[..., :, None] * dg[..., None, :]).sum(-3)
        return Derivatives(
            (weight * f).sum(-1),
            (weight[..., None] * acting(df)).sum(-2),
            ((theta * f)[..., None] * acting(dg)).sum(-2),
            (weight[..., None, None] * acting(ddf, 2)).sum(-3),
            by_vq,
            by_qv,
            self._masses(f, A),
        )

    def _masses(self, f: Any, A: Any) -> Any:
        d = self.dim
        weighted = as_row(self.coefficients, f) * f
        return matmul(weighted, self.terms.acting(A, 2).reshape(-1, d * d)).reshape(
            *f.shape[:-1], d, d
        )

    def momentum(self, q: Any, v: Any) -> Any:
        """p = ∂L/∂v (..., d)."""
        f, _, _ = self.terms.potentials(q, order=0)
        _, dg = self.terms.motion(v)
        return ((as_row(self.coefficients, f) * f)[..., None] * self.terms.acting(dg)).sum(-2)

    def masses(self, q: Any) -> Any:
        """M = ∂²L/∂v∂v (..., d, d), which depends on q alone."""
        f, _, _ = self.terms.potentials(q, order=0)
        return self._masses(f, self.terms.quadratic()[0])

    def energy(self, q: Any, v: Any) -> Any:
        """v·∂L/∂v − L (...)."""
        f, _, _ = self.terms.potentials(q, order=0)
        g, dg = self.terms.motion(v)
        return (as_row(self.coefficients, f) * f * ((dg * v[..., None, :]).sum(-1) - g)).sum(-1)

    def forces(self, q: Any, v: Any, u: Any = None) -> Any:
        """−∂R/∂v − γ ∂L/∂v + G u (..., d); u is (..., inputs), or None for none."""
        push = -self.friction.forces(v, self.losses, u, q) - self.uniform * self.momentum(q, v)
        return push if u is None else push + pushed(self.gains, u)

    def losses_by_v(self, q: Any, v: Any, u: Any = None) -> Any:
        """∂²R/∂v∂v (..., d, d)."""
        return self.friction.stiffness(v, self.losses, u, q)

    def balance(self, q: Any, v: Any, u: Any = None) -> tuple[Any, Any]:
        """M (..., d, d) and the force (..., d) of M a = ∂L/∂q − (∂²L/∂v∂q) v − ∂R/∂v − γ ∂L/∂v +
        G u, at q, v (..., d)."""
        f, df, _ = self.terms.potentials(q, 1, u)
        g, dg = self.terms.motion(v)
        theta = as_row(self.coefficients, f)
        along = (df * v[..., None, :]).sum(-1)
        force = self.terms.acting((theta * g)[..., None] * df - (theta * along)[..., None] * dg)
        force = force.sum(-2)
        return self._masses(f, self.terms.quadratic()[0]), force + self.forces(q, v, u)

    def acceleration(self, q: Any, v: Any, u: Any = None) -> Any:
        """a (..., d), the solution of `balance`."""
        return _solve(*self.balance(q, v, u))

    def power(self, q: Any, v: Any, u: Any = None) -> tuple[Any, Any]:
        """Energy per unit of time: lost to each friction (..., F + 1), the last one uniform
        friction, and supplied by each input (..., inputs)."""
        xp = namespace(v)
        lost = self.friction.power(v, u, q)
        lost = lost * as_row(self.losses, lost)
        even = self.uniform * (self.momentum(q, v) * v).sum(-1)
        lost = xp.concatenate([lost, even[..., None]], axis=-1)
        supplied = pushed(xp.swapaxes(self.gains, -1, -2), v) * (0.0 if u is None else u)
        return lost, supplied


def pushed(gains: Any, u: Any) -> Any:
    """G u (..., d) of gains (d, k), or those of each lane (..., d, k), and u (..., k)."""
    if gains.ndim == 2:
        return matmul(u, gains.T)
    column = u[..., None]
    return matmul(as_row(gains, column) if column.ndim > gains.ndim else gains, column)[..., 0]


def functions_of(powers: Powers, args: Any) -> Any:
    """∏ args_i^n_i (..., m) of parameters args (..., k) and whole powers n (m, k). NumPy or JAX."""
    columns = []
    for row in powers:
        column = namespace(args).ones_like(args[..., 0])
        for i, n in enumerate(row):
            for _ in range(abs(n)):
                column = column * args[..., i] if n > 0 else column / args[..., i]
        columns.append(column)
    return namespace(args).stack(columns, axis=-1)


def _monomials(x: Any, n: Any, order: int) -> tuple[Any, Any, Any]:
    """∏ x_i^n_i (..., P) of x (..., d) and n (P, d), and its derivatives up to the order."""
    xp, d = namespace(x), x.shape[-1]
    rank = n.astype(x.dtype)
    table = [xp.ones_like(x)]
    for _ in range(MAX_POWER if xp is not np else int(n.max(initial=0))):
        table.append(table[-1] * x)
    powers = xp.stack(table, axis=-1)
    factors = [[powers[..., i, n[:, i]] for i in range(d)]]
    if order > 0:
        slopes = [_rows(rank[:, i], powers[..., i, xp.maximum(n[:, i] - 1, 0)]) for i in range(d)]
        factors.append(slopes)
    if order > 1:
        curvatures = [
            _rows(rank[:, i] * (rank[:, i] - 1), powers[..., i, xp.maximum(n[:, i] - 2, 0)])
            for i in range(d)
        ]
        factors.append(curvatures)

    def product(*orders: int) -> Any:
        found = factors[orders[0]][0]
        for i in range(1, d):
            found = found * factors[orders[i]][i]
        return found

    value, slope, curvature = product(*[0] * d), None, None
    if order > 0:
        slope = xp.stack([product(*(int(i == k) for i in range(d))) for k in range(d)], axis=-1)
    if order > 1:
        entries = [
            product(*(int(i == k) + int(i == j) for i in range(d)))
            for k in range(d)
            for j in range(d)
        ]
        curvature = xp.stack(entries, axis=-1).reshape(*value.shape, d, d)
    return value, slope, curvature


def _shaped(
    f: Potentials, trees: dict[int, Expression], q: Any, order: int, u: Any = None
) -> Potentials:
    """Factors f of terms multiplied by the shapes that some of them have."""
    xp, d, places = namespace(q), q.shape[-1], np.array(list(trees))
    with np.errstate(all="ignore"):  # a shape may have a boundary: NaN beyond it
        found, zero = jets(tuple(trees.values()), q, order, u), 0 * q[..., 0]

        def rows(entries: list[Any], *shape: int) -> Any:
            whole = xp.stack([zero + entry for entry in entries], axis=-1)
            return whole.reshape(*zero.shape, len(places), *shape)

        c, g = f.value[..., places], rows([jet.value for jet in found])
        parts, slope, curvature = [c * g], None, None
        if order > 0:
            dc = f.slope[..., places, :]
            dg = rows([jet.slope.get(i, 0.0) for jet in found for i in range(d)], d)
            slope = dc * g[..., None] + c[..., None] * dg
        if order > 1:
            pairs = [(min(i, k), max(i, k)) for i in range(d) for k in range(d)]
            bent = rows([jet.curvature.get(pair, 0.0) for jet in found for pair in pairs], d, d)
            both = dc[..., :, None] * dg[..., None, :]
            curvature = f.curvature[..., places, :, :] * g[..., None, None]
            curvature = curvature + both + xp.swapaxes(both, -1, -2) + c[..., None, None] * bent
    parts += [slope, curvature]
    others = [j for j in range(f.value.shape[-1]) if j not in trees]
    order_of = np.argsort([*others, *places])

    def placed(old: Any, new: Any, axis: int) -> Any:
        if new is None:
            return None
        kept = xp.take(old, np.array(others, dtype=int), axis=axis)
        return xp.take(xp.concatenate([kept, new], axis=axis), order_of, axis=axis)

    return Potentials(
        *(placed(a, b, -1 - k) for k, (a, b) in enumerate(zip(f, parts, strict=True)))
    )


def _outer(f: Any, m: Any) -> Any:
    """f (..., P) times m (P, ...), term by term."""
    f = f.reshape(*f.shape, *(1,) * (m.ndim - 1))
    return f * as_row(m, f)


def _rows(n: Any, f: Any) -> Any:
    return as_row(n, f) * f


def _solve(matrix: Any, vector: Any) -> Any:
    """matrix⁻¹ vector of a batch of small systems: (..., d, d), (..., d)."""
    if matrix.shape[-1] == 1:
        return vector / matrix[..., 0]
    return namespace(vector).linalg.solve(matrix, vector[..., None])[..., 0]
