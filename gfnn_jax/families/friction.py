"""Friction of a law: the gradient of Rayleigh's R = Σ ρ_k r_k(s) of speeds s, one kind a row of a
table.

With s = c·v, the speed of one coordinate or the relative speed of two, friction is linear, r = ½s²;
quadratic, r = ⅓|s|³; dry, r = √(s² + ε²) − ε; a power a of the speed, r = |s|^(a + 1)/(a + 1); or
one-sided, r = ½ max(s, 0)², which beside linear friction makes it depend on the direction.
Stribeck's is what dry friction loses at speeds above w, r = −|s| + w (1 − e^(−|s|/w)) (Tustin
1947). The drag of a body in a plane or in space is isotropic: r = |v|^(a + 1)/(a + 1), |v| over the
coordinates of c. Friction that depends on a load is dry friction times the size of an input, the
normal force that is recorded, r = |u_j| |s| (Coulomb 1785). Friction that depends on the place
grows with the square of its distance from C, r = ½ (c·q − C)² s²: of a feedback by the amplitude,
as van der Pol's, or of a magnet that leaves the gap of a coil. Everything is batch first, in closed
form, and runs in NumPy or JAX.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from gfnn_jax.arrays import as_row, matmul, namespace, pytree
from gfnn_jax.families.text import added, barred, combination, shown

# Kinds of friction. UNIFORM stands in a fit's `flows.motion.Form` alone. LOADED + j is the kind of
# which input j is the load; PLACED, by the place, is the last of TABLE.
LINEAR, QUADRATIC, DRY, UNIFORM, POWER, ONE_SIDED, ISOTROPIC, STRIBECK, LOADED, PLACED = (
    *range(9),
    -1,
)
_FACTORS = {1 / 2: "½ ", 1 / 3: "⅓ ", 1 / 4: "¼ ", 1 / 8: "⅛ ", 1.0: ""}


class Kind(NamedTuple):
    """A kind of friction. name: as a request has it. text: its term as code, with the number before
    it, of the texts of s and |s| and of the width. tables: (r, r', r'') of (xp, s, |s|, width).
    signed: r' of s, the sign of s, or 0 where r' is analytic and needs none, and the width; None of
    uniform friction. rare: it is taken only where it explains a record much better than others do.
    """

    name: str
    text: Callable[[str, str, float], tuple[str, float]]
    tables: Callable[[Any, Any, Any, Any], tuple[Any, Any, Any]]
    signed: Callable[[Any, Any, float], Any]
    rare: bool = False


def _squared(speed: str) -> str:
    return f"({speed})**2" if " " in speed else f"{speed}**2"


def _dry(xp: Any, s: Any, size: Any, width: Any) -> tuple[Any, Any, Any]:
    # At rest with ε = 0 there is no direction to push: s/root is 0.
    root = xp.sqrt(s * s + width**2 + np.finfo(width.dtype).tiny)
    bent = (width / root) ** 2 / root  # small speeds would underflow in ε²/root³
    return root - width, s / root, bent


def _power(xp: Any, s: Any, size: Any, width: Any) -> tuple[Any, Any, Any]:
    base = xp.where(size > 0, size, 1.0)  # |s|^(a − 1) has no value at rest where a < 1
    raised = xp.where(size > 0, base ** (width - 1), 0.0)
    return raised * size * size / (width + 1), raised * s, width * raised


def _stribeck(xp: Any, s: Any, size: Any, width: Any) -> tuple[Any, Any, Any]:
    fade = xp.exp(-size / width)
    return width * (1 - fade) - size, (fade - 1) * xp.sign(s), -fade / width


def _isotropic(xp: Any, s: Any, size: Any, width: Any) -> tuple[Any, Any, Any]:
    raised = size ** (width - 1)
    return raised * size * size / (width + 1), raised * size, width * raised


_OF_DRY = Kind(
    "dry",
    lambda speed, size, width: (
        (f"sqrt({_squared(speed)} + {width**2:.4g})" if width else size),
        1.0,
    ),
    _dry,
    lambda s, sign, width: s / (s * s + width**2).sqrt() if _is_none(sign) else sign,
)
TABLE = (
    Kind(
        "linear",
        lambda speed, size, width: (_squared(speed), 1 / 2),
        lambda xp, s, size, width: (0.5 * s * s, s, xp.ones_like(s)),
        lambda s, sign, width: s,
    ),
    Kind(
        "quadratic",
        lambda speed, size, width: (f"{size}**3", 1 / 3),
        lambda xp, s, size, width: (size**3 / 3, s * size, 2 * size),
        lambda s, sign, width: sign * s * s,
    ),
    _OF_DRY,
    Kind(
        "uniform",
        lambda speed, size, width: ("T", 1.0),
        lambda xp, s, size, width: (0 * s, 0 * s, 0 * s),
        lambda s, sign, width: 0 * s,
    ),
    Kind(
        "cubic",
        lambda speed, size, width: (f"{size}**{width + 1:g}", 1 / (width + 1)),
        _power,
        lambda s, sign, width: s ** float(width) if _is_none(sign) else sign * (sign * s) ** width,
        rare=True,
    ),
    Kind(
        "one-sided",
        lambda speed, size, width: (f"({added([size, speed])})**2", 1 / 8),
        lambda xp, s, size, width: (
            0.5 * xp.maximum(s, 0.0) ** 2,
            xp.maximum(s, 0.0),
            (s > 0).astype(s.dtype),
        ),
        lambda s, sign, width: 0.5 * (1.0 + sign) * s,
        rare=True,
    ),
    Kind(
        "isotropic",
        lambda speed, size, width: (f"{size}**{width + 1:g}", 1 / (width + 1)),
        _isotropic,
        lambda s, sign, width: s ** float(width),
    ),
    Kind(
        "stribeck",
        lambda speed, size, width: (f"({size} + {width:g}*exp(-{size}/{width:g}))", -1.0),
        _stribeck,
        lambda s, sign, width: sign * ((sign * s * (-1 / width)).exp() - 1),
        rare=True,
    ),
    _OF_DRY._replace(name="load-dependent", rare=True),
    Kind(
        "place-dependent",
        lambda speed, size, width: (_squared(speed), 1 / 2),
        lambda xp, s, size, width: (0.5 * s * s, s, xp.ones_like(s)),
        lambda s, sign, width: s,
        rare=True,
    ),
)


def kind_of(kind: int) -> Kind:
    """The entry of `TABLE` of a kind of friction."""
    return TABLE[min(kind, LOADED)]


def _is_none(sign: Any) -> bool:
    """Return whether no sign of a speed is given."""
    return isinstance(sign, (int, float)) and sign == 0


@pytree()
class Friction:
    """Terms r_k of Rayleigh's R: directions c (F, d), whole numbers; kinds (F,), places in `TABLE`,
    from LOADED on by the input that is the load; widths (F,): ε of dry friction and w of
    Stribeck's, in units of v, C of PLACED, of q, and the exponent a of POWER and ISOTROPIC.

    Methods take inputs u (..., k), or None: a load is 0 where none are given; and positions q
    (..., d), where friction may depend on the place."""

    directions: Any
    kinds: Any
    widths: Any

    @staticmethod
    def of(rows: Sequence[Sequence[Any]], dim: int) -> Friction:
        """Make it of rows (c, kind, ε)."""
        return Friction(
            np.array([r[0] for r in rows], dtype=int).reshape(-1, dim),
            np.array([r[1] for r in rows], dtype=int),
            np.array([float(r[2]) for r in rows]),
        )

    @property
    def count(self) -> int:
        return self.kinds.shape[0]

    def rows(self) -> list[tuple]:
        """(c, kind, ε) of each term, hashable."""
        return [
            (tuple(map(int, self.directions[k])), int(self.kinds[k]), float(self.widths[k]))
            for k in range(self.count)
        ]

    def texts(
        self, speeds: Sequence[str], inputs: Sequence[str] = (), positions: Sequence[str] = ()
    ) -> tuple[tuple[str, float], ...]:
        """Each term as code in the names of the velocities, of the inputs, by default u1, …, and of
        the positions, by default q1, …, and the number before it: ("v1**2", ½), ("abs(v2 -
        v1)**3", ⅓), ("abs(v2)", 1), ("(abs(v1) + v1)**2", ⅛) of one-sided friction, ("sqrt(v1**2 +
        v2**2)**3", ⅓) of isotropic drag, ("abs(u1)*abs(v1)", 1) of friction by a load,
        ("(q1 - 2)**2*v1**2", ½) of that by the place; uniform friction, a row without a direction,
        is γ T.
        """
        places = positions or [f"q{i + 1}" for i in range(self.directions.shape[1])]
        listed = []
        for direction, kind, width in self.rows():
            named = [*speeds][::-1]
            speed = even = combination(direction[::-1], named)
            if even.startswith("-"):  # all kinds but one-sided are the same of −v
                even = combination([-c for c in direction[::-1]], named)
            speed, size = speed if kind == ONE_SIDED else even, f"abs({even})"
            if kind == ISOTROPIC:
                squares = (f"{v}**2" for v, c in zip(speeds, direction, strict=True) if c)
                size = f"sqrt({added(squares)})"
            text, number = kind_of(kind).text(speed, size, width)
            if kind >= LOADED:
                text = f"abs({inputs[kind - LOADED] if inputs else f'u{kind - LOADED + 1}'})*{text}"
            if kind == PLACED:
                centre = f"{-width:+.6g}" if width else ""
                place = combination(direction, places)
                text = f"{_squared(f'{place} {centre[:1]} {centre[1:]}'.strip())}*{text}"
            listed.append((text, number))
        return tuple(listed)

    @property
    def names(self) -> tuple[str, ...]:
        """Each term as it stands in a formula: "½ v1²", "⅓ |v2 - v1|³", "|v2|"."""
        speeds = [f"v{i + 1}" for i in range(self.directions.shape[1])]
        sharp = dataclasses.replace(self, widths=np.where(self.dry, 0.0, self.widths))
        return tuple(
            _FACTORS.get(part, f"{part:.4g} ") + barred(shown(t)) for t, part in sharp.texts(speeds)
        )

    @property
    def dry(self) -> Any:
        """The dry friction (F,), by a load or not."""
        return (self.kinds == DRY) | self.loaded

    @property
    def loaded(self) -> Any:
        """The friction (F,) by a load."""
        return self.kinds >= LOADED

    @property
    def jumps(self) -> np.ndarray:
        """The dry friction (F,) that has no width: its force jumps where its speed turns."""
        return self.dry & (self.widths == 0)

    @property
    def placed(self) -> Any:
        """The friction (F,) by the place."""
        return self.kinds == PLACED

    def factors(self, u: Any, q: Any = None) -> Any:
        """Return the factor of each term at inputs u (..., k) and positions q (..., d): |u_j| (...,
        F) of friction by a load, (c·q − C)² of that by the place, 1 of others; 1.0 where none has
        either."""
        if not self._may_be_placed(q):
            return self._loads(u)
        places, xp = self._places(q), namespace(q, self.kinds)
        placed = xp.where(as_row(self.placed, places), places * places, 1.0)
        return placed * self._loads(u)

    def _places(self, q: Any) -> Any:
        """c·q − C, of friction by the place, at q (..., d): (..., F)."""
        places = matmul(q, self.directions.astype(q.dtype).T)
        return places - as_row(self.widths, places)

    def _loads(self, u: Any) -> Any:
        xp, loaded = namespace(self.kinds, u), self.loaded
        if np.size(u) == 0 or (namespace(loaded) is np and not np.any(loaded)):
            return 1.0
        if u is None:
            return xp.where(loaded, 0.0, 1.0)
        place = xp.clip(self.kinds - LOADED, 0, u.shape[-1] - 1)
        return xp.where(loaded, xp.abs(u[..., place]), 1.0)

    def take(self, keep: Any) -> Friction:
        return Friction(self.directions[keep], self.kinds[keep], self.widths[keep])

    def speeds(self, v: Any) -> Any:
        """c·v, or |v| of isotropic friction, at v (..., d): (..., F)."""
        xp, c = namespace(v), self.directions.astype(v.dtype)
        s = matmul(v, c.T)
        if not self._may_be_isotropic(xp):
            return s
        squares = matmul(v * v, c.T)
        size = xp.sqrt(xp.where(squares > 0, squares, 1.0))  # a root has no slope at 0
        return xp.where(as_row(self.kinds, s) == ISOTROPIC, xp.where(squares > 0, size, 0.0), s)

    def tables(self, v: Any) -> tuple[Any, Any, Any]:
        """r_k, dr_k/ds and d²r_k/ds² at v (..., d), each (..., F)."""
        xp = namespace(v)
        s = self.speeds(v)
        size = xp.abs(s)
        kinds, widths = as_row(xp.minimum(self.kinds, LOADED), s), as_row(self.widths, s)
        every = (*range(LOADED + 1), PLACED)
        some = every if xp is not np else np.unique(kinds).tolist()
        found = (0 * s,) * 3
        for kind in some:
            of_kind = TABLE[kind].tables(xp, s, size, xp.where(kinds == kind, widths, 1.0))
            found = [xp.where(kinds == kind, a, b) for a, b in zip(of_kind, found, strict=True)]
        value, slope, curvature = found
        return value, slope, curvature

    def residuals(self, v: Any, u: Any = None, q: Any = None) -> Any:
        """∂r_k/∂v at v (..., d): (..., F, d)."""
        plain, _, across, _ = self._parts(v)
        plain = plain * self.factors(u, q)
        c = as_row(self.directions.astype(v.dtype), plain[..., None])
        pulls = plain[..., None] * c
        return pulls if across is None else pulls + across[..., None] * c * v[..., None, :]

    def forces(self, v: Any, losses: Any, u: Any = None, q: Any = None) -> Any:
        """∂R/∂v at v (..., d), of coefficients ρ (F,) or (..., F): (..., d)."""
        plain, _, across, _ = self._parts(v)
        plain = plain * self.factors(u, q)
        c, losses = self.directions.astype(v.dtype), as_row(losses, plain)
        along = matmul(losses * plain, c)
        return along if across is None else along + v * matmul(losses * across, c)

    def by_place(self, q: Any, v: Any, losses: Any) -> Any:
        """∂²R/∂v∂q at q, v (..., d), of coefficients ρ (F,) or (..., F): (..., d, d); None where no
        friction depends on the place."""
        if not self._may_be_placed(q):
            return None
        c, d, xp = self.directions.astype(v.dtype), v.shape[-1], namespace(q, self.kinds)
        slopes = 2 * self._places(q) * matmul(v, c.T)
        slopes = xp.where(as_row(self.placed, slopes), slopes, 0.0)
        outer = (c[:, :, None] * c[:, None, :]).reshape(-1, d**2)
        return matmul(as_row(losses, slopes) * slopes, outer).reshape(*v.shape, d)

    def stiffness(self, v: Any, losses: Any, u: Any = None, q: Any = None) -> Any:
        """∂²R/∂v∂v at v (..., d), of coefficients ρ (F,) or (..., F): (..., d, d)."""
        xp, (_, curvature, across, bent) = namespace(v), self._parts(v)
        curvature = curvature * self.factors(u, q)
        c, losses, d = self.directions.astype(v.dtype), as_row(losses, curvature), v.shape[-1]
        outer = (c[:, :, None] * c[:, None, :]).reshape(-1, d**2)
        along = matmul(losses * curvature, outer).reshape(*v.shape, d)
        if across is None:
            return along
        alone = xp.eye(d, dtype=v.dtype).reshape(1, -1)
        along = along + matmul(losses * across, outer * alone).reshape(along.shape)
        turned = matmul(losses * bent, outer).reshape(along.shape)
        return along + turned * v[..., :, None] * v[..., None, :]

    def power(self, v: Any, u: Any = None, q: Any = None) -> Any:
        """v·∂r_k/∂v at v (..., d): (..., F)."""
        return self.tables(v)[1] * self.speeds(v) * self.factors(u, q)

    def _parts(self, v: Any) -> tuple[Any, Any, Any, Any]:
        """dr/ds and d²r/ds² (..., F) of speeds c·v; and of isotropic rows (dr/ds) ÷ |v|, by which
        their force is v, and the derivative of that ÷ |v|, 0 of the others, or None."""
        xp, (_, slope, curvature) = namespace(v), self.tables(v)
        if not self._may_be_isotropic(xp):
            return slope, curvature, None, None
        s, own = self.speeds(v), as_row(self.kinds, slope) == ISOTROPIC
        size = xp.where(s > 0, s, 1.0)
        across = xp.where(own, xp.where(s > 0, slope / size, curvature), 0.0)
        bent = xp.where(own, (curvature - across) / size**2, 0.0)
        return xp.where(own, 0.0, slope), xp.where(own, 0.0, curvature), across, bent

    def _may_be_placed(self, q: Any) -> bool:
        """Return whether positions are given and a row may be friction by the place: traced by JAX,
        kinds are not known."""
        if q is None:
            return False
        return namespace(self.kinds) is not np or bool(np.any(self.placed))

    def _may_be_isotropic(self, xp: Any) -> bool:
        """Return whether a row may be isotropic: traced by JAX, kinds are not known."""
        return xp is not np or bool(np.any(self.kinds == ISOTROPIC))
