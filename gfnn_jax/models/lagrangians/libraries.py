"""Candidates for the terms of a law, by what its coordinates are: angles come in modes, lengths in
powers.

The first library is that of textbooks: masses that are constant or depend on one angle, a sum or a
difference of two, potentials of the same modes, and potentials of lengths to degree 2. One degree
of freedom has T = ½v². `more` are the next orders, of which a fit takes only those that the record
asks for.
"""

import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from itertools import combinations, combinations_with_replacement, permutations

import numpy as np

from gfnn_jax.families.expressions import parse, product_of, to_text
from gfnn_jax.families.friction import (
    DRY,
    ISOTROPIC,
    LINEAR,
    LOADED,
    ONE_SIDED,
    PLACED,
    POWER,
    QUADRATIC,
    STRIBECK,
    UNIFORM,
    kind_of,
)
from gfnn_jax.families.lagrangian import INPUTS, shape_of, tree_of
from gfnn_jax.models.lagrangians.structure import SINE, Loss, Row

KINDS = (*range(LOADED), LOADED, PLACED)
FRICTIONS = tuple(kind_of(kind).name for kind in KINDS)
ALTERNATIVES = ({LINEAR, UNIFORM}, {QUADRATIC, ISOTROPIC})  # of which a law has one by choice
CUBIC = 3.0  # the power of the speed that is tried
HIGHEST = 6  # degree of potentials of lengths
WAVES = 3  # of a turn, at most, that a potential of angles has
FEW = 3  # coordinates: of more of them a term couples two, for others would be too many
SHAPES = (  # of a length q, of which powers may be the series
    "exp(A*q) + exp(2*A*q)",  # of Morse
    "exp(A*q) + q",  # of Toda
    "exp(A*q) + exp(-A*q)",
    "cos(A*q) + sin(A*q)",
    "sqrt(1+(A*q)**2) + q",
    "1/(1+A*q) + q",
    "1/(1+A*q)**3 + q",  # of two magnets
    # Of two atoms (Lennard-Jones), of one and a wall, by the distance or from a zero of its own
    "1/q**12 + 1/q**6",
    "1/q**9 + 1/q**3",
    "1/(q+A)**12 + 1/(q+A)**6",
    "1/(q+A)**9 + 1/(q+A)**3",
    # Of one length about a centre C: wells of light, of Pöschl and Teller, of a charge, of a plate,
    # of a ring of current
    "exp(-(A*(q-C))**2)",
    "1/(exp(A*(q-C))+exp(-A*(q-C)))**2",
    "1/sqrt(1+(A*(q-C))**2)",
    "1/(1+(A*(q-C))**2)",
    "1/sqrt(1+(A*(q-C))**2)**3",
    "sqrt(1+(A*(q-C))**2) + (q-C)**2",  # a spring across the way
)
GAINS = ("1/(1+A*q)", "1/(1+A*q)**2", "exp(A*q)")  # by which a force of inputs depends on q


def unit(dim: int, *axes: int) -> tuple[int, ...]:
    """Ones (or counts) at these axes."""
    return tuple(axes.count(i) for i in range(dim))


def powers(dim: int, axes: Iterable[int], *degrees: int) -> list[tuple[int, ...]]:
    """Exponents of the products of these coordinates, of one degree after another."""
    axes = tuple(axes)
    return [unit(dim, *own) for n in degrees for own in combinations_with_replacement(axes, n)]


def potentials(dim: int, axes: Iterable[int], *degrees: int) -> list[Row]:
    """Potentials that are such products."""
    none = (0,) * dim
    return [(none, own, none, 0.0) for own in powers(dim, axes, *degrees)]


def _lengths(dim: int, angles: tuple[int, ...]) -> list[int]:
    return [i for i in range(dim) if i not in angles]


def textbook(dim: int, angles: tuple[int, ...]) -> list[Row]:
    """Pendulums in a chain, bodies on springs: masses, v_i v_j cos(q_i − q_j), cos q_i; lengths to
    degree 2. Where it explains a record as well as more does, small swings cannot imitate it."""
    pairs = [p for p in combinations(range(dim), 2) if p[0] in angles and p[1] in angles]
    differences = {tuple(int(k == i) - int(k == j) for k in range(dim)) for i, j in pairs}
    coupled = {unit(dim, *p) for p in pairs}
    kept = []
    for row in first(dim, angles):
        speeds, powers, wave, _ = row
        if max(speeds) == 2 or (sum(speeds) == 2 and speeds not in coupled):
            wanted = not any(wave)
        elif sum(speeds) == 2:
            wanted = wave in differences and all(
                a == abs(b) for a, b in zip(speeds, wave, strict=True)
            )
        else:
            wanted = any(powers) or sum(map(abs, wave)) == 1
        kept += [row] if wanted else []
    return kept


def uncoupled(dim: int, angles: tuple[int, ...]) -> list[Row]:
    """The textbook's terms of one coordinate each."""
    rows = textbook(dim, angles)
    return [row for row in rows if sum(map(any, zip(*row[:3], strict=True))) == 1]


def bodies(dim: int, angles: tuple[int, ...], highest: int = 4) -> list[Row]:
    """The same, and potentials of lengths to a degree: bodies with masses of their own."""
    richer = potentials(dim, _lengths(dim, angles), *range(2, highest + 1))
    return list(dict.fromkeys([*uncoupled(dim, angles), *richer]))


def relative(dim: int, angles: tuple[int, ...]) -> list[Row]:
    """The same chain where each angle is measured from the link before it: with φ_i = q_1 + … + q_i
    masses v_k v_l, v_k v_l cos(φ_j − φ_i), and cos φ_i."""
    none = (0,) * dim

    def link(a: int, b: int) -> tuple[int, ...]:
        return tuple(int(a < k <= b) for k in range(dim))

    masses = [
        (unit(dim, k, j), none, link(i, e), 0.0)
        for i in range(dim)
        for e in range(i, dim)
        for k in range(i + 1)
        for j in range(k, e + 1)
    ]
    potentials = [(none, none, link(-1, i), 0.0) for i in range(dim)]
    start = (unit(dim, 0, 0), none, none, 0.0)
    return list(dict.fromkeys([start, *masses, *potentials]))


def side_by_side(dim: int, angles: tuple[int, ...], highest: int = 2) -> list[Row]:
    """A chain or ring of pendulums on axes of their own, or of bodies, with springs between
    neighbours: cos q_i and cos(q_i − q_j), or lengths to a degree."""
    rows, none = uncoupled(dim, angles), (0,) * dim
    for pair in ((i, (i + 1) % dim) for i in range(dim)):
        if all(i in angles for i in pair):
            rows.append(
                (none, none, tuple((i == pair[0]) - (i == pair[1]) for i in range(dim)), 0.0)
            )
        lengths = [i for i in pair if i not in angles]
        rows += potentials(dim, lengths, *range(2, highest + 1))
    return list(dict.fromkeys(rows))


def by_twos(
    of: Callable[[int, tuple[int, ...]], list[Row]], dim: int, angles: tuple[int, ...]
) -> list[Row]:
    """The terms that a library ``of`` two coordinates has of each two of these."""
    rows: dict[Row, None] = {}
    for pair in combinations(range(dim), 2):
        at = [pair.index(i) if i in pair else 2 for i in range(dim)]
        for *parts, phase in of(2, tuple(k for k, i in enumerate(pair) if i in angles)):
            placed = (tuple((*part, 0)[k] for k in at) for part in parts)
            rows[(*placed, phase)] = None  # pyright: ignore[reportArgumentType]
    return list(rows)


def first(dim: int, angles: tuple[int, ...]) -> list[Row]:
    """The first library; its first term is v₁²."""
    if dim > FEW:
        return by_twos(first, dim, angles)
    none, waves = (0,) * dim, modes(dim, angles, 1)
    rows: list[Row] = []
    for speeds in powers(dim, range(dim), 2):
        rows.append((speeds, none, none, 0.0))
        rows += [(speeds, none, m, 0.0) for m in waves if dim > 1]
    rows += [(none, none, m, 0.0) for m in waves]
    return rows + potentials(dim, _lengths(dim, angles), 1, 2)


def gyroscopic(dim: int, angles: tuple[int, ...], degree: int) -> list[Row]:
    """v_j f(q), of forces at right angles to the motion: powers of lengths and modes up to
    ``degree``, of which some coordinate comes before the j-th. a(q) and a + ∇χ move alike, and so
    each field has one representative among them."""
    none, rows = (0,) * dim, list[Row]()
    products = powers(dim, _lengths(dim, angles), *range(1, degree + 1))
    for j in range(1, dim):
        rows += [(unit(dim, j), n, none, 0.0) for n in products if any(n[:j])]
        waves = [m for m in modes(dim, angles, degree) if any(m[:j])]
        rows += [(unit(dim, j), none, m, phase) for m in waves for phase in (0.0, SINE)]
    return rows


def couplings(dim: int, angles: tuple[int, ...]) -> list[Row]:
    """Masses of second modes, of which a turning arm makes centrifugal forces."""
    speeds, none, twice = powers(dim, range(dim), 2), (0,) * dim, [unit(dim, i, i) for i in angles]
    return [(k, none, m, phase) for k in speeds for m in twice for phase in (0.0, SINE)]


def spun(dim: int, angles: tuple[int, ...]) -> list[Row]:
    """The textbook's terms, and v_j² cos 2q_i: a body at an angle to an axis, about which it is
    spun, has the inertia sin² q_i."""
    spins = [
        (unit(dim, j, j), (0,) * dim, unit(dim, i, i), 0.0) for i in angles for j in range(dim)
    ]
    return [*textbook(dim, angles), *(row for row in spins if row[0] != row[2])]


def polar(dim: int, angles: tuple[int, ...]) -> list[Row]:
    """The textbook's terms, and v_j² q_i² of lengths and angles, 1/q_i, q_i cos q_j: a body in a
    plane, by its distance and its direction, where springs, a weight or gravity pull at it."""
    none, lengths = (0,) * dim, _lengths(dim, angles)
    rows = textbook(dim, angles)
    for i in lengths if angles else []:
        rows += [(unit(dim, j, j), unit(dim, i, i), none, 0.0) for j in angles]
        rows += [(none, unit(dim, i), unit(dim, j), 0.0) for j in angles]
        rows.append((none, none, none, 0.0, f"1/q{i + 1}"))
    return rows


def on_a_surface(dim: int, angles: tuple[int, ...]) -> list[Row]:
    """The textbook's terms, and v_i v_j q_i q_j of lengths: a body on a surface whose height is of
    degree 2 in them moves up and down too."""
    none, pairs = (0,) * dim, powers(dim, _lengths(dim, angles), 2)
    return [*textbook(dim, angles), *((two, two, none, 0.0) for two in pairs)]


def more(dim: int, angles: tuple[int, ...]) -> list[Row]:
    """Modes up to |m| = `WAVES` and their sines in V, up to 2 in T; powers of lengths up to
    `HIGHEST` in V, 2 in T."""
    none, lengths = (0,) * dim, _lengths(dim, angles)
    rows: list[Row] = []
    for speeds in powers(dim, range(dim), 2):
        for m in modes(dim, angles, 2):
            rows += [(speeds, none, m, 0.0), (speeds, none, m, SINE)]
        rows += [(speeds, own, none, 0.0) for own in powers(dim, lengths, 1, 2)]
    for m in modes(dim, angles, WAVES):
        rows += [(none, none, m, 0.0), (none, none, m, SINE)]
    rows += potentials(dim, lengths, *range(3, HIGHEST + 1))
    for i in lengths:
        for m in modes(dim, angles, 1):
            rows += [(none, unit(dim, i), m, 0.0), (none, unit(dim, i), m, SINE)]
    return rows


def last_of_series(rows: Sequence[Row]) -> Row | None:
    """The first potential of the highest degree, where that is one of the two highest tried, or the
    shortest wave of an angle beside longer ones: a series of another shape may have been cut there.
    None where there is none."""
    alone = [row for row in rows if not any(row[0])]
    ends = [row for row in alone if sum(row[1]) >= HIGHEST - 1]
    if ends:
        return max(ends, key=lambda row: sum(row[1]))
    longer = {i for row in alone for i, m in enumerate(row[2]) if 0 < abs(m) < WAVES}
    shortest = (r for r in alone if any(abs(r[2][i]) == WAVES for i in longer))
    return next(shortest, None)


def of_atoms(rows: Sequence[Row]) -> Row | None:
    """The first potential of two atoms, or of one and a wall, None where there is none: their
    powers are two of many that such laws have."""
    alone = (row for row in rows if not any(row[0]))
    return next((row for row in alone if re.search(r"\*\*(12|9)$", shape_of(row))), None)


def central(dim: int, exponent: float) -> list[Row]:
    """A potential r^a of the distance from the origin, and the two fields v_j q_i r^a of each plane
    through it."""
    distance = parse("sqrt(" + " + ".join(f"q{i + 1}**2" for i in range(dim)) + ")", dim)
    none, shape = (0,) * dim, to_text(product_of({distance: exponent}), dim)
    across = permutations(range(dim), 2)
    fields = [(unit(dim, j), unit(dim, i), none, 0.0, shape) for i, j in across]
    return [(none, none, none, 0.0, shape), *fields]


def is_centred(shape: str) -> bool:
    """Return whether a shape has a centre of its own."""
    return "C" in shape


def shaped(
    shape: str, place: tuple[float, float], along: Sequence[int], times: str = "1"
) -> list[Row]:
    """The potentials that a sum of `SHAPES` is of, with a constant A and a centre C, its
    ``place``, of the coordinate that is 1 in ``along``, less the one that is −1; ``times`` a
    function of inputs."""
    d, names = len(along), {1: "", -1: ""}
    names |= {sign: f"q{i + 1}" for i, sign in enumerate(along) if sign}
    length = f"({names[1]}-{names[-1]})" if names[-1] else names[1]
    plain = {"q": potentials(d, np.flatnonzero(along), 1)} if times == "1" else {}
    if not place[1]:
        plain["(q-C)**2"] = potentials(d, np.flatnonzero(along), 2)
    rows: list[Row] = []
    for text in shape.split(" + "):
        own = text.replace("A", f"({place[0]:.8g})").replace("C", f"({place[1]:.8g})")
        own = re.sub(r"\bq\b", length, own)
        tree = tree_of(times, d) * tree_of(own, d)
        one: Row = ((0,) * d, (0,) * d, (0,) * d, 0.0, to_text(tree, d, INPUTS))
        rows += plain.get(text, [one])
    return rows


def springs(dim: int, angles: Sequence[int]) -> list[Row]:
    """Potentials of degree 2 of angles that stay within a turn: torsion."""
    return potentials(dim, angles, 2)


def springs_between(dim: int, angles: Sequence[int]) -> list[Row]:
    """Springs (q_i − q_j)² between angles that stay within a turn, of many between neighbours: a
    wave of the difference imitates them."""
    none = (0,) * dim
    pairs = [p for p in combinations(angles, 2) if dim <= FEW or p[1] == p[0] + 1]
    shapes = (to_text(parse(f"(q{i + 1}-q{j + 1})**2", dim), dim) for i, j in pairs)
    return [(none, none, none, 0.0, shape) for shape in shapes]


def torques(dim: int, angles: Sequence[int]) -> list[Row]:
    """Constant torques on angles: of a motor, on which V falls with every turn."""
    return potentials(dim, angles, 1)


def driven(dim: int, angles: Sequence[int], inputs: int, squares: bool) -> list[Row]:
    """Potentials times an input, or its square: forces whose gain depends on the position, as of a
    magnet by its current, or a stiffness that is driven."""
    none, rows = (0,) * dim, []
    for j, power in ((j, power) for power in range(1, 2 + squares) for j in range(inputs)):
        shape = f"u{j + 1}" if power == 1 else f"u{j + 1}**{power}"
        for i in range(dim):
            if i in angles:
                rows += [(none, none, unit(dim, i), phase, shape) for phase in (0.0, SINE)]
            else:  # a force in proportion to an input is its gain
                degrees = range(2 if power == 1 else 1, 4)
                rows += [(none, unit(dim, *[i] * n), none, 0.0, shape) for n in degrees]
    return rows


def every(dim: int, angles: tuple[int, ...]) -> list[Row]:
    """All terms that a search may come to."""
    if dim > FEW:
        return by_twos(every, dim, angles)
    rows = (*first(dim, angles), *gyroscopic(dim, angles, 2), *more(dim, angles))
    return list(dict.fromkeys(rows))


def forces(dim: int, angles: tuple[int, ...]) -> list[Row]:
    """All potentials and fields that a search may come to, with the masses of the first library."""
    plain = first(dim, angles)
    return [row for row in every(dim, angles) if sum(row[0]) < 2 or row in plain]


def without_forces(rows: Sequence[Row], axes: Sequence[int]) -> tuple[Row, ...]:
    """The rows without constant forces along these axes, whose zero is where the force is none."""
    constant = potentials(len(rows[0][0]), axes, 1)
    return tuple(row for row in rows if row not in constant)


def modes(dim: int, angles: tuple[int, ...], order: int) -> list[tuple[int, ...]]:
    """Multiples up to ``order`` of one angle, and sums and differences of two with |m_i| up to
    order − 1 (at least 1), each up to its sign."""
    found = [tuple(n * e for e in unit(dim, i)) for n in range(1, order + 1) for i in angles]
    top = max(1, order - 1)
    for i, j in combinations(angles, 2):
        for a in range(1, top + 1):
            for b in (*range(-top, 0), *range(1, top + 1)):
                wave = [0] * dim
                wave[i], wave[j] = a, b
                found.append(tuple(wave))
    return found


def names_of(kinds: Iterable[int]) -> tuple[str, ...]:
    """The names of kinds of friction, as a request has them."""
    return tuple(dict.fromkeys(kind_of(kind).name for kind in kinds))


def kind_named(name: str) -> int:
    """The kind of friction of one of `FRICTIONS`."""
    return KINDS[FRICTIONS.index(name)]


def losses(
    dim: int,
    kinds: tuple[int, ...],
    width: float,
    lengths: Sequence[int] = (),
    inputs: int = 0,
    joints: Sequence[tuple[int, ...]] | None = None,
) -> list[Loss]:
    """Friction of each coordinate, and of relative speeds (``joints``; unless given of neighbours);
    uniform friction has no direction. Rare kinds are those of single coordinates, one-sided
    friction of either side, Stribeck's of the width 1, by the place, and by the load of each of so
    many ``inputs``. Isotropic drag, as |v|², is that of the plane or the space of the
    ``lengths``."""
    directions = [unit(dim, i) for i in range(dim)]
    of_power = [(c, POWER, CUBIC) for c in directions if POWER in kinds]
    of_power += [(c, STRIBECK, 1.0) for c in directions if STRIBECK in kinds]
    of_power += [(c, PLACED, 0.0) for c in directions if PLACED in kinds]
    loads = range(inputs * (LOADED in kinds))
    of_power += [(c, LOADED + j, width) for c in directions for j in loads]
    sides = [(tuple(side * i for i in c), ONE_SIDED, 0.0) for c in directions for side in (1, -1)]
    neighbours = [tuple((k == i + 1) - (k == i) for k in range(dim)) for i in range(dim - 1)]
    directions += neighbours if joints is None else joints
    rows = [
        (c, kind, width if kind == DRY else 0.0)
        for kind in kinds
        if kind not in (UNIFORM, ISOTROPIC) and not kind_of(kind).rare
        for c in directions
    ]
    rows += of_power + sides * (ONE_SIDED in kinds)
    if ISOTROPIC in kinds and 1 < len(lengths) <= FEW:
        rows.append((unit(dim, *lengths), ISOTROPIC, 2.0))
    return rows + [((0,) * dim, UNIFORM, 0.0)] * (UNIFORM in kinds)


def between(losses: Sequence[Loss]) -> list[Loss]:
    """Friction by the power 3/2 of the speed of a coordinate in place of linear and quadratic
    friction, which together imitate it."""
    both = [c for c, kind, *_ in losses if kind == QUADRATIC and (c, LINEAR, 0.0) in losses]
    return [(c, POWER, 1.5) for c in both if sum(map(abs, c)) == 1]


def together(kinds: Collection[int]) -> bool:
    """Return whether a law may have these kinds of friction beside each other by choice: Stribeck's
    is a part of dry friction."""
    alone = STRIBECK in kinds and DRY not in kinds
    return not alone and not any(one <= set(kinds) for one in ALTERNATIVES)


def feeds(losses: Mapping[Loss, float]) -> bool:
    """Return whether friction falls below zero at high speeds: Stribeck's takes more than there is
    of dry friction."""
    dry = {row[0]: size for row, size in losses.items() if row[1] == DRY}
    return any(s > dry.get(row[0], 0.0) for row, s in losses.items() if row[1] == STRIBECK)


def opposite(row: Loss) -> Loss | None:
    """Friction of the sum of two speeds for that of their difference: the drag on an arm that hangs
    from another, and what a negative coefficient of the difference stands for. Else None."""
    direction, kind, width = row
    if min(direction) >= 0 or max(direction) <= 0:
        return None
    return tuple(map(abs, direction)), kind, width
