"""Compiled motion of laws, one lane after another: a law is read as tables, none is compiled.

The equation of motion is r(q, v, a; p) = M a − ∂L/∂q + (∂²L/∂v∂q) v + ∂R/∂v + γ ∂L/∂v − G u = 0.
It is linear in the coefficients p of a law, so that with the acceleration known its derivatives are
explicit:

    ∂a/∂x = −M⁻¹ ∂r/∂x,      ∂a/∂p_k = −M⁻¹ r_k,      r_k the residual of term k alone

Each term is ∏ v_i^k_i (at most two factors) times f = ∏ q_i^n_i cos(m·q + φ), and touches the rows
of its own coordinates alone. f may have another factor, a shape: operations on a stack of numbers
with their first and second derivatives in the coordinates of the term. Steps are those of Dormand
and Prince, with their derivatives D (2d, n) in the state and in the coefficients.

Where coordinates drive others that do not act back on them, a term acts on those coordinates alone
that have its own level, the highest of a coordinate in it: M is not symmetric then.

Dry friction without a width jumps:

    M a = f(q, v) − Σ c λ,      λ = ρ sign(s) where s slides,      |λ| ≤ ρ, c·a = 0 where it sticks

with s = c·v for each direction c, and ρ in proportion to the size of an input where that is the
load (J. J. Moreau, in "Nonsmooth Mechanics and Applications" (1988) 1). As long as no direction
changes from one to the other the motion is smooth. A step in which a sliding speed turns, or a λ
that holds passes ρ, ends there: at the root of a cubic through the speeds and their slopes at the
step's ends, from which Newton's method goes on between bounds, or of a line through λ and ρ. Where
a speed turns at the time τ the acceleration jumps from a₋ to a₊, and so do the derivatives, for τ
depends on the state too (M. A. Aizerman & F. R. Gantmacher, Q. J. Mech. Appl. Math. 11 (1958) 225):

    D → D + (0, a₋ − a₊) dτ,      dτ = −c·D_v / c·a₋

A direction that sticks has lost the error of its speed. All loops are bounded: a lane with more
events than can be followed, a singular M or a motion that diverges ends with NaN and a status.

Whole numbers of a law stand in rows of one array n; all its other numbers, and what is computed of
one lane, in rows of another, f.
"""

import math
from typing import NamedTuple

import numpy as np

from gfnn_jax.flows.sines import sines
from gfnn_jax.flows.translated import compiled, function

FINE, UNFINISHED, LOST = range(3)  # status of a lane: followed; too many events; not finite
# Kinds of friction; COULOMB: dry, without a width.
VISCOUS, CUBIC, SMOOTHED, COULOMB, EVEN, RAISED_SPEED, ONE_SIDED, DRAG, FADING, PLACED = range(10)

# Rows of n: sizes (below); of each term its degree in v, the coordinates of its factors v, its wave
# m·q, the number of coordinates in its factor f(q), whether it has powers, and its level; the level
# of each coordinate; a term of each wave; where the columns of each term begin among those of ∂θ/∂c
# without zeros; kinds of friction, and the inputs that are their loads, -1 of others; where the
# operations of each term's shape begin, and operations. Then rows, as many as there are coordinates
# in an f at the most, of coordinates, of powers and of modes of f.
SIZES, DEGREE, FIRST_V, LAST_V, WAVE, COUNT, POWERED, LEVEL, LEVELS = range(9)
WAVES, BEGINS, COLUMNS, KINDS, LOADS, PROGRAMS, CODE, COORDINATES = range(9, 17)

# Operations: variables, constants, values of the stack and inputs are put on it. Of two numbers
# that are taken from it sum, product, the larger one, whether the first is greater; of three one,
# by the first; of x, f, f' and f'' f(x).
VARIABLE, CONSTANT, COPY, INPUT, PLUS, TIMES, LARGER, GREATER, SELECT, COMPOSE = range(10)
SQUARE, INVERSE_OF, ROOT, RAISED, SIN, COS, TAN, EXP, LOG = range(10, 19)
SINH, COSH, TANH, ARCTAN, ABS = range(19, 24)

# In the row of sizes: numbers of coordinates, terms, waves, frictions, dry ones without a width,
# inputs, free coefficients of terms, coordinates in an f at the most; then where blocks of rows of
# f begin: M, M⁻¹, 1 − moved holding, the response of a to forces, moved (of a to λ), gains and
# directions c (transposed), ∂r/∂(q, v, p), derivatives D at the begin and the end of a step and at
# a stage, their rates at all stages; holding (of λ to a), small systems; ∂f/∂q and ∂²f/∂q² of
# terms; values, slopes and curvatures on the stack, a column each.
DIM, TERMS, NUM_WAVES, FRICTIONS, COULOMBS, INPUTS, FREE_TERMS, MOST = range(8)
MASSES, INVERSE, FREE, RESPONSE, MOVED, GAINS, DIRECTIONS, RAW = range(8, 16)
D0, D1, D, SLOPES, HOLDING, ALIKE, MATRIX, RHS, PAIRS, SLOPE, CURVATURE, JET = range(16, 28)
NUM_SIZES = 28

# Rows of f: states (q, v) at the begin and the end of a step and at a stage; a at the stage and at
# the begin; forces; momenta ∂L/∂v; of terms θ, cos φ, sin φ, f, ∂f/∂q · v; cos and sin of each
# wave; ∂θ/∂c without zeros; of friction ρ, ε, dr/ds, λ and the most that it can be, both at the
# begin, modes (1 or −1 where it slides, 0 where it sticks), directions that turned, that are
# carried, and speeds along the modes at the end; a row of derivatives, or of phases; operands of
# operations, and a row as long as the stack; powers of coordinates with derivatives; rates and
# inputs at the stages; the tableau of Dormand and Prince. Numbers of other modules would stay as
# they were in compiled code, which is known by this file.
X0, X1, X, A, A_FIRST, FORCE, MOMENTUM, THETA, COS_PHASE, SIN_PHASE, FACTOR, ALONG = range(12)
COSINE, SINE, PARTS, LOSSES, WIDTHS, PULL, HELD, LIMIT, HELD_FIRST, LIMIT_FIRST = range(12, 22)
MODES, TURNED, CARRIED, AFTER, ROW, POWER, POWER_BY, POWER_BY_TWO = range(22, 30)
OPERANDS, STACK, RATES = range(30, 33)
_STAGES = 6
U = RATES + _STAGES
INSIDE = U + _STAGES
STAGES = INSIDE + _STAGES
NODES = STAGES + _STAGES
WEIGHTS, BLOCKS = NODES + 1, NODES + 2

_EVENTS = 64  # of a lane in one substep, after which it has no solution
_APART_FROM = 1e-6  # of a direction, left of others that it depends on
_ALIKE = 1e-9  # of the largest entry, added for λ of directions that depend on each other
_ROOT_STEPS = 60  # of Newton's method or bisection, to the root of a cubic: bisection needs 53
# Of a step, at the most: before Newton's method, for of a cubic with three roots they choose one,
# and where its steps leave the bounds.
_HALVINGS = 10
_ROOT = 1e-15  # of a step, that the root is told to
_NEAR = 0.01  # of a step, by which Newton's method may be off before the last time


class Task(NamedTuple):
    """N lanes: where they start, x (N, 2d), and in which modes (N, F), NaN for those of the state;
    M steps h (N, M) with inputs u (N, M, substeps, 6, k) at their stages; and what becomes of the
    lanes: states (N, M, 2d), their derivatives by (N, M, 2d, n) in the state before the step and
    the coefficients, modes after (N, M, F) each step, and a status (N,)."""

    x: np.ndarray
    modes: np.ndarray
    h: np.ndarray
    u: np.ndarray
    states: np.ndarray
    by: np.ndarray
    after: np.ndarray
    status: np.ndarray


@function
def _add(row, share, other):
    """Add a share of another row to a row."""
    for m in range(len(row)):
        row[m] += share * other[m]


@function
def _copy(row, other):
    for m in range(len(row)):
        row[m] = other[m]


@function
def _sign(value):
    if value > 0.0:
        return 1.0
    return -1.0 if value < 0.0 else 0.0


@function
def _solve(f, matrix, rhs, size, width):
    """The solution of a system of the rows from ``matrix`` on into those from ``rhs`` on, by
    elimination with partial pivoting."""
    for k in range(size):
        pivot = k
        for i in range(k + 1, size):
            if abs(f[matrix + i, k]) > abs(f[matrix + pivot, k]):
                pivot = i
        if pivot != k:
            for j in range(size):
                one, other = f[matrix + k, j], f[matrix + pivot, j]
                f[matrix + k, j], f[matrix + pivot, j] = other, one
            for j in range(width):
                one, other = f[rhs + k, j], f[rhs + pivot, j]
                f[rhs + k, j], f[rhs + pivot, j] = other, one
        for i in range(k + 1, size):
            factor = f[matrix + i, k] / f[matrix + k, k]
            if factor != 0.0:
                for j in range(k + 1, size):
                    f[matrix + i, j] -= factor * f[matrix + k, j]
                for j in range(width):
                    f[rhs + i, j] -= factor * f[rhs + k, j]
    for k in range(size - 1, -1, -1):
        for j in range(width):
            value = f[rhs + k, j]
            for i in range(k + 1, size):
                value -= f[matrix + k, i] * f[rhs + i, j]
            f[rhs + k, j] = value / f[matrix + k, k]


@function
def _shape(n, f, j, u):
    """The shape of a term at X with inputs in the row u, with its derivatives in the term's
    coordinates, into the first column of the stack."""
    count, most, jet, top = n[COUNT, j], n[SIZES, MOST], n[SIZES, JET], -1
    bent = jet + 1 + most
    for e in range(n[PROGRAMS, j], n[PROGRAMS, j + 1]):
        operation, operand = n[CODE, e], f[OPERANDS, e]
        if operation <= INPUT:
            top += 1
            for i in range(1 + most + most * most):
                f[jet + i, top] = 0.0
            f[jet, top] = f[jet, int(operand)] if operation == COPY else operand
            if operation == INPUT:
                f[jet, top] = f[u, int(operand)]
            if operation == VARIABLE:
                own = int(operand)
                f[jet, top] = f[X, n[COORDINATES + own, j]]
                f[jet + 1 + own, top] = 1.0
        elif PLUS <= operation <= SELECT:
            top -= 2 if operation == SELECT else 1
            x, y = f[jet, top], f[jet, top + 1]
            if operation != TIMES:
                taken = top + (1 if operation == LARGER and y > x else 0)
                if operation == SELECT:
                    taken = top + (1 if x != 0.0 else 2)
                for i in range(1 + most + most * most):
                    if operation == PLUS:
                        f[jet + i, top] += f[jet + i, top + 1]
                    else:
                        f[jet + i, top] = 0.0 if operation == GREATER else f[jet + i, taken]
                if operation == GREATER and x > y:
                    f[jet, top] = 1.0
                continue
            for i in range(count):
                for k in range(count):
                    at, xi, yi = bent + i * most + k, f[jet + 1 + i, top], f[jet + 1 + i, top + 1]
                    xk, yk = f[jet + 1 + k, top], f[jet + 1 + k, top + 1]
                    f[at, top] = f[at, top] * y + x * f[at, top + 1] + xi * yk + xk * yi
            for i in range(count):
                at = jet + 1 + i
                f[at, top] = f[at, top] * y + x * f[at, top + 1]
            f[jet, top] = x * y
        else:
            top -= 3 if operation == COMPOSE else 0
            x = f[jet, top]
            if operation == COMPOSE:
                value, by, by_two = f[jet, top + 1], f[jet, top + 2], f[jet, top + 3]
            elif operation == SQUARE:
                value, by, by_two = x * x, 2.0 * x, 2.0
            elif operation == INVERSE_OF:
                value = 1.0 / x
                by = -value * value
                by_two = -2.0 * by * value
            elif operation == ROOT:
                value = math.sqrt(x)
                by = 0.5 / value
                by_two = -0.5 * by / x
            elif operation == RAISED:
                value, by = x**operand, operand * x ** (operand - 1.0)
                by_two = operand * (operand - 1.0) * x ** (operand - 2.0)
            elif operation == SIN:
                value, by = math.sin(x), math.cos(x)
                by_two = -value
            elif operation == COS:
                value, by = math.cos(x), -math.sin(x)
                by_two = -value
            elif operation == TAN:
                value = math.tan(x)
                by = 1.0 + value * value
                by_two = 2.0 * value * by
            elif operation == EXP:
                value = by = by_two = math.exp(x)
            elif operation == LOG:
                value, by = math.log(x), 1.0 / x
                by_two = -by * by
            elif operation == SINH:
                value, by = math.sinh(x), math.cosh(x)
                by_two = value
            elif operation == COSH:
                value, by = math.cosh(x), math.sinh(x)
                by_two = value
            elif operation == TANH:
                value = math.tanh(x)
                by = 1.0 - value * value
                by_two = -2.0 * value * by
            elif operation == ARCTAN:
                value, by = math.atan(x), 1.0 / (1.0 + x * x)
                by_two = -2.0 * x * by * by
            else:
                value, by, by_two = abs(x), _sign(x), 0.0
            for i in range(count):
                for k in range(count):
                    both = f[jet + 1 + i, top] * f[jet + 1 + k, top]
                    at = bent + i * most + k
                    f[at, top] = by * f[at, top] + by_two * both
            for i in range(count):
                f[jet + 1 + i, top] *= by
            f[jet, top] = value


@function
def _with_shape(n, f, j, u, value):
    """Multiply the factor ``value`` of a term and its derivatives by the shape; return f."""
    count, most, jet = n[COUNT, j], n[SIZES, MOST], n[SIZES, JET]
    slope, curvature, bent = n[SIZES, SLOPE], n[SIZES, CURVATURE], jet + 1 + most
    _shape(n, f, j, u)
    g = f[jet, 0]
    for i in range(count):
        for k in range(count):
            at = i * most + k
            both = f[slope + i, j] * f[jet + 1 + k, 0] + f[slope + k, j] * f[jet + 1 + i, 0]
            f[curvature + at, j] = f[curvature + at, j] * g + both + value * f[bent + at, 0]
    for i in range(count):
        f[slope + i, j] = f[slope + i, j] * g + value * f[jet + 1 + i, 0]
    return value * g


@function
def _terms(n, f, gamma, u, order):
    """The terms' factors f = ∏ q_i^n_i cos(m·q + φ) at X with their derivatives, and the masses,
    forces and momenta that the terms make, with inputs in the row u."""
    d, masses, most = n[SIZES, DIM], n[SIZES, MASSES], n[SIZES, MOST]
    slope, curvature = n[SIZES, SLOPE], n[SIZES, CURVATURE]
    powers, modes = COORDINATES + most, COORDINATES + 2 * most
    for i in range(d):
        f[FORCE, i] = 0.0
        f[MOMENTUM, i] = 0.0
        for k in range(d):
            f[masses + i, k] = 0.0
    waves = (n[SIZES, NUM_WAVES] + 8) // 8 * 8  # with that of no angle, and others of none
    for wave in range(waves):
        phase = 0.0
        if 0 < wave <= n[SIZES, NUM_WAVES]:
            j = n[WAVES, wave - 1]
            for i in range(n[COUNT, j]):
                phase += n[modes + i, j] * f[X, n[COORDINATES + i, j]]
        f[ROW, wave] = phase
    sines(f[ROW], f[SINE], f[COSINE], waves)
    for j in range(n[SIZES, TERMS]):
        degree, count = n[DEGREE, j], n[COUNT, j]
        powered, wave, product = n[POWERED, j] > 0, n[WAVE, j], 1.0
        c = f[COSINE, wave] * f[COS_PHASE, j] - f[SINE, wave] * f[SIN_PHASE, j]
        s = f[SINE, wave] * f[COS_PHASE, j] + f[COSINE, wave] * f[SIN_PHASE, j]
        for i in range(count if powered else 0):
            power, q, twice = n[powers + i, j], f[X, n[COORDINATES + i, j]], 1.0
            for _ in range(power - 2):
                twice *= q
            once = twice * q if power > 1 else 1.0
            f[POWER, i] = once * q if power > 0 else 1.0
            f[POWER_BY, i] = power * once if power > 0 else 0.0
            f[POWER_BY_TWO, i] = power * (power - 1) * twice if power > 1 else 0.0
            product *= f[POWER, i]
        value, along = c * product, 0.0
        for i in range(count):
            mode, of_i = n[modes + i, j], 0.0
            if powered:
                of_i = f[POWER_BY, i]
                for m in range(count):
                    of_i *= f[POWER, m] if m != i else 1.0
            f[slope + i, j] = of_i * c - mode * s * product
            for k in range(count if order > 0 else 0):
                bent = -mode * n[modes + k, j] * value
                if powered:
                    of_k = f[POWER_BY, k]
                    both = f[POWER_BY_TWO, i] if i == k else f[POWER_BY, i] * f[POWER_BY, k]
                    for m in range(count):
                        of_k *= f[POWER, m] if m != k else 1.0
                        both *= f[POWER, m] if m not in (i, k) else 1.0
                    bent += both * c - s * (mode * of_k + n[modes + k, j] * of_i)
                f[curvature + i * most + k, j] = bent
        if n[PROGRAMS, j] < n[PROGRAMS, j + 1]:
            value = _with_shape(n, f, j, u, value)
        for i in range(count):
            along += f[slope + i, j] * f[X, d + n[COORDINATES + i, j]]
        f[FACTOR, j] = value
        f[ALONG, j] = along
        weight, g = f[THETA, j], 1.0
        turning = weight * (along + gamma * value)
        for side in range(degree):  # the derivative of g in v of this side is v of the other
            row, other, dg = n[FIRST_V + side, j], n[LAST_V - side, j], 1.0
            if degree == 2:
                dg = f[X, d + other]
            g *= f[X, d + row]
            if n[LEVELS, row] == n[LEVEL, j]:
                f[FORCE, row] -= turning * dg
                f[MOMENTUM, row] += weight * value * dg
                if degree == 2:
                    f[masses + row, other] += weight * value
        for i in range(count):
            at = n[COORDINATES + i, j]
            if n[LEVELS, at] == n[LEVEL, j]:
                f[FORCE, at] += weight * g * f[slope + i, j]


@function
def _other(n, f, k, i):
    """The factor beside c_i of a direction: v_i of friction of |v|, which c is the coordinates
    of."""
    return f[X, n[SIZES, DIM] + i] if n[KINDS, k] == DRAG else 1.0


@function
def _friction(n, f, u, order):
    """The forces of friction but for uniform friction, with inputs in the row u, and their
    derivatives in v, and in q where they depend on the place."""
    d, c, raw = n[SIZES, DIM], n[SIZES, DIRECTIONS], n[SIZES, RAW]
    for k in range(n[SIZES, FRICTIONS]):
        kind, loss = n[KINDS, k], f[LOSSES, k]
        if kind == EVEN:
            continue
        speed, stiffness, turned = 0.0, 0.0, 0.0
        load = abs(f[u, n[LOADS, k]]) if n[LOADS, k] >= 0 else 1.0
        for i in range(d):
            speed += f[c + i, k] * f[X, d + i] * _other(n, f, k, i)
        pull = speed
        if kind in (VISCOUS, PLACED):
            stiffness = 1.0
        elif kind == CUBIC:
            pull, stiffness = speed * abs(speed), 2.0 * abs(speed)
        elif kind == SMOOTHED:
            root = math.hypot(speed, f[WIDTHS, k])
            ratio = f[WIDTHS, k] / root
            pull, stiffness = speed / root, ratio * ratio / root  # ε²/root³ would underflow
        elif kind == RAISED_SPEED:
            if speed != 0.0:
                stiffness = abs(speed) ** (f[WIDTHS, k] - 1.0)
            pull, stiffness = speed * stiffness, f[WIDTHS, k] * stiffness
        elif kind == ONE_SIDED:
            pull = max(speed, 0.0)
            stiffness = 1.0 if speed > 0.0 else 0.0
        elif kind == FADING:
            stiffness = -math.exp(-abs(speed) / f[WIDTHS, k]) / f[WIDTHS, k]
            pull = -math.copysign(1.0 + f[WIDTHS, k] * stiffness, speed)
        elif kind == DRAG:  # of |v|, by v: pull is that of a unit of v
            pull = turned = math.sqrt(speed) ** (f[WIDTHS, k] - 1.0)
            if speed > 0.0:
                stiffness = (f[WIDTHS, k] - 1.0) * pull / speed
        else:
            pull = f[MODES, k]
        place = 0.0
        if kind == PLACED:
            place = -f[WIDTHS, k]
            for i in range(d):
                place += f[c + i, k] * f[X, i]
            load = place * place
            place *= 2.0 * speed
        pull, stiffness = pull * load, stiffness * load
        f[PULL, k] = pull
        f[HELD, k], f[LIMIT, k] = loss * pull, loss * load
        for i in range(d):
            if f[c + i, k] != 0.0:
                along = f[c + i, k] * _other(n, f, k, i)
                f[FORCE, i] -= loss * pull * along
                for m in range(d if order > 0 else 0):
                    by = f[c + m, k] * _other(n, f, k, m)
                    f[raw + i, d + m] += loss * stiffness * along * by
                    if kind == PLACED:
                        f[raw + i, m] += loss * place * along * by
                    if i == m:
                        f[raw + i, d + m] += loss * turned * f[c + i, k]


@function
def _stuck(n, f):
    """The number of directions that stick."""
    stuck = 0
    for k in range(n[SIZES, FRICTIONS]):
        stuck += n[KINDS, k] == COULOMB and f[MODES, k] == 0.0
    return stuck


@function
def _hold(n, f):
    """Constrain the directions that stick, of which M⁻¹ is known: HOLDING (F, d) of a that makes λ,
    MOVED (d, F) what λ does to a, and FREE = 1 − moved holding. False where none sticks."""
    d, count, c = n[SIZES, DIM], n[SIZES, FRICTIONS], n[SIZES, DIRECTIONS]
    moved, holding, alike = n[SIZES, MOVED], n[SIZES, HOLDING], n[SIZES, ALIKE]
    if _stuck(n, f) == 0:
        return False
    for k in range(count):
        for i in range(d):
            f[moved + i, k] = 0.0
            for m in range(d):
                f[moved + i, k] += f[n[SIZES, INVERSE] + i, m] * f[c + m, k]
            f[holding + k, i] = f[c + i, k]
    for k in range(count):
        for m in range(count):
            f[alike + k, m] = 0.0
            for i in range(d):
                f[alike + k, m] += f[c + i, k] * f[moved + i, m]
    _among(n, f, holding, d)
    for i in range(d):
        for m in range(d):
            f[n[SIZES, FREE] + i, m] = 1.0 if i == m else 0.0
            for k in range(count):
                f[n[SIZES, FREE] + i, m] -= f[moved + i, k] * f[holding + k, m]
    return True


@function
def _among(n, f, target, width):
    """The x with ALIKE (F, F) x = target (F, width) among the directions that stick, 0 of the
    others, into the target; the least x where they depend on each other (Tikhonov's, iterated
    once)."""
    count, alike = n[SIZES, FRICTIONS], n[SIZES, ALIKE]
    matrix, rhs, some, size = n[SIZES, MATRIX], n[SIZES, RHS], _stuck(n, f), 0.0
    for k in range(count):
        for m in range(count):
            size = max(size, abs(f[alike + k, m]) if n[KINDS, k] == COULOMB else 0.0)
    for k in range(count):
        sticks = n[KINDS, k] == COULOMB and f[MODES, k] == 0.0
        for i in range(width):
            f[rhs + k, i] = 0.0
            if not sticks:
                f[target + k, i] = 0.0
            elif some == 1:
                f[target + k, i] /= f[alike + k, k]
    if some == 1:
        return
    for k in range(count):
        for m in range(count):
            both = n[KINDS, k] == COULOMB and n[KINDS, m] == COULOMB
            if not (both and f[MODES, k] == 0.0 and f[MODES, m] == 0.0):
                f[alike + k, m] = 0.0
        for i in range(width):
            f[rhs + k, i] = f[target + k, i]
    for again in range(2):
        for k in range(count):
            for m in range(count):
                f[matrix + k, m] = f[alike + k, m]
            sticks = n[KINDS, k] == COULOMB and f[MODES, k] == 0.0
            f[matrix + k, k] += _ALIKE * size if sticks else 1.0
        _solve(f, matrix, target if again else rhs, count, width)
        for k in range(count):
            for i in range(width):
                if again:
                    f[target + k, i] += f[rhs + k, i]
                else:
                    for m in range(count):
                        f[target + k, i] -= f[alike + k, m] * f[rhs + m, i]


@function
def _derivatives(n, f, gamma, order):
    """∂r/∂(q, v) of all terms, and with ``order`` 2 their own residuals, added to RAW."""
    d, raw, most = n[SIZES, DIM], n[SIZES, RAW], n[SIZES, MOST]
    slopes, curvature = n[SIZES, SLOPE], n[SIZES, CURVATURE]
    for j in range(n[SIZES, TERMS]):
        degree, count, weight = n[DEGREE, j], n[COUNT, j], f[THETA, j]
        value, along, g = f[FACTOR, j], f[ALONG, j], 1.0
        if degree > 0:
            g = f[X, d + n[FIRST_V, j]]
        if degree > 1:
            g *= f[X, d + n[LAST_V, j]]
        for i in range(count):
            at = n[COORDINATES + i, j]
            if n[LEVELS, at] != n[LEVEL, j]:
                continue
            for k in range(count):
                bent = f[curvature + i * most + k, j]
                f[raw + at, n[COORDINATES + k, j]] -= weight * g * bent
            for e in range(n[BEGINS, j], n[BEGINS, j + 1] if order > 1 else 0):
                f[raw + at, 2 * d + n[COLUMNS, e]] -= f[PARTS, e] * g * f[slopes + i, j]
        for side in range(degree):  # the derivative of g in v of this side is v of the other
            row, other = n[FIRST_V + side, j], n[LAST_V - side, j]
            dg, push, acts = 1.0, 0.0, n[LEVELS, row] == n[LEVEL, j]
            if degree == 2:
                dg, push = f[X, d + other], f[A, other]
                if acts:
                    f[raw + row, d + other] += weight * (along + gamma * value)
            for k in range(count):
                at, slope, bent = n[COORDINATES + k, j], f[slopes + k, j], 0.0
                for i in range(count):
                    bent += f[curvature + k * most + i, j] * f[X, d + n[COORDINATES + i, j]]
                if acts:
                    f[raw + row, at] += weight * (slope * (push + gamma * dg) + dg * bent)
                    f[raw + row, d + at] += weight * dg * slope
                if n[LEVELS, at] == n[LEVEL, j]:
                    f[raw + at, d + row] -= weight * dg * slope
            own = value * (push + gamma * dg) + dg * along
            for e in range(n[BEGINS, j], n[BEGINS, j + 1] if order > 1 and acts else 0):
                f[raw + row, 2 * d + n[COLUMNS, e]] += f[PARTS, e] * own


@function
def _width(n, order):
    """The number of derivatives of each part of a state."""
    width = 2 * n[SIZES, DIM] if order > 0 else 0
    if order > 1:
        width += n[SIZES, FREE_TERMS] + n[SIZES, FRICTIONS] + n[SIZES, DIM] * n[SIZES, INPUTS]
    return width


@function
def _rates(n, f, u, order):
    """Accelerations A at the state X, with inputs in the row u, and the forces HELD of friction;
    with ``order`` 1 or 2 ∂r/∂(q, v) or ∂r/∂(q, v, p) in RAW, of which −RESPONSE makes derivatives
    of a."""
    d, raw, width = n[SIZES, DIM], n[SIZES, RAW], _width(n, order)
    masses, inverse, response = n[SIZES, MASSES], n[SIZES, INVERSE], n[SIZES, RESPONSE]
    gains = n[SIZES, GAINS]
    for i in range(d if order > 0 else 0):
        for k in range(width):
            f[raw + i, k] = 0.0
    gamma = 0.0
    for k in range(n[SIZES, FRICTIONS]):
        if n[KINDS, k] == EVEN:
            gamma += f[LOSSES, k]
    _terms(n, f, gamma, u, order)
    _friction(n, f, u, order)
    for i in range(d):
        for m in range(n[SIZES, INPUTS]):
            f[FORCE, i] += f[gains + i, m] * f[u, m]
    if d > 2:
        for i in range(d):
            for m in range(d):
                f[inverse + i, m] = 1.0 if i == m else 0.0
        _solve(f, masses, inverse, d, d)
    elif d == 2:
        size = f[masses, 0] * f[masses + 1, 1] - f[masses, 1] * f[masses + 1, 0]
        f[inverse, 0], f[inverse, 1] = f[masses + 1, 1] / size, -f[masses, 1] / size
        f[inverse + 1, 0], f[inverse + 1, 1] = -f[masses + 1, 0] / size, f[masses, 0] / size
    else:
        f[inverse, 0] = 1.0 / f[masses, 0]
    for i in range(d):
        f[A, i] = 0.0
        for m in range(d):
            f[A, i] += f[inverse + i, m] * f[FORCE, m]
            f[response + i, m] = f[inverse + i, m]
    if _hold(n, f):
        moved, holding, free = n[SIZES, MOVED], n[SIZES, HOLDING], n[SIZES, FREE]
        rhs, count = n[SIZES, RHS], n[SIZES, FRICTIONS]
        for k in range(count):
            f[rhs, k] = 0.0
            for i in range(d):
                f[rhs, k] += f[holding + k, i] * f[A, i]
            f[HELD, k] += f[rhs, k]
        for i in range(d):
            for k in range(count):
                f[A, i] -= f[moved + i, k] * f[rhs, k]
            for m in range(d):
                f[response + i, m] = 0.0
                for k in range(d):
                    f[response + i, m] += f[free + i, k] * f[inverse + k, m]
    if order > 0:
        _derivatives(n, f, gamma, order)
    if order > 1:
        first = 2 * d + n[SIZES, FREE_TERMS]
        for i in range(d):
            for k in range(n[SIZES, FRICTIONS]):
                own = f[n[SIZES, DIRECTIONS] + i, k] * f[PULL, k] * _other(n, f, k, i)
                f[raw + i, first + k] = f[MOMENTUM, i] if n[KINDS, k] == EVEN else own
            for m in range(n[SIZES, INPUTS]):
                column = n[SIZES, FRICTIONS] + i * n[SIZES, INPUTS] + m
                f[raw + i, first + column] = -f[u, m]


@function
def _smooth(n, f, span, order, u):
    """A step of the time ``span`` from X0 and its derivatives D0 to X1 and D1, with inputs in six
    rows from u on; a and λ at its begin stay in A_FIRST and HELD_FIRST. With an ``order`` below 0
    the rates at X alone, with inputs in the row u."""
    d = n[SIZES, DIM]
    begin, end, stage, slopes = n[SIZES, D0], n[SIZES, D1], n[SIZES, D], n[SIZES, SLOPES]
    raw, response, rows = n[SIZES, RAW], n[SIZES, RESPONSE], 2 * d if order > 0 else 0
    for i in range(_STAGES + 1):
        last = i == _STAGES
        x, target = (X1, end) if last else (X, stage)
        shares = WEIGHTS if last else STAGES + i
        if order >= 0:
            for k in range(2 * d):
                f[x, k] = f[X0, k]
                for j in range(i):
                    share = f[shares, j]
                    f[x, k] += share * span * f[RATES + j, k]
            for k in range(rows):
                _copy(f[target + k], f[begin + k])
                for j in range(i):
                    share = span * f[shares, j]
                    if share != 0.0:
                        _add(f[target + k], share, f[slopes + 2 * d * j + k])
        if last:
            return
        _rates(n, f, u + i, order)
        if order < 0:
            return
        for k in range(d):
            f[RATES + i, k] = f[X, d + k]
            f[RATES + i, d + k] = f[A, k]
        if i == 0:
            for k in range(d):
                f[A_FIRST, k] = f[A, k]
            for k in range(n[SIZES, FRICTIONS]):
                f[HELD_FIRST, k], f[LIMIT_FIRST, k] = f[HELD, k], f[LIMIT, k]
        slope = slopes + 2 * d * i
        for k in range(rows // 2):
            _copy(f[slope + k], f[stage + d + k])
            for m in range(f.shape[1]):
                f[slope + d + k, m] = 0.0
        for k in range(rows // 2):
            for m in range(f.shape[1]):
                f[ROW, m] = f[raw + k, m] if m >= 2 * d else 0.0
            for j in range(2 * d):
                if f[raw + k, j] != 0.0:
                    _add(f[ROW], f[raw + k, j], f[stage + j])
            for j in range(d):
                if f[response + j, k] != 0.0:
                    _add(f[slope + d + j], -f[response + j, k], f[ROW])


@function
def _within(n, f, begin, end):
    """Inputs INSIDE at the nodes of the part of a step from ``begin`` to ``end``, by the polynomial
    through those at the nodes of the whole, U."""
    for k in range(n[SIZES, INPUTS]):
        for i in range(_STAGES):
            if begin == 0.0 and end == 1.0:
                f[INSIDE + i, k] = f[U + i, k]
                continue
            at, value = begin + (end - begin) * f[NODES, i], 0.0
            for j in range(_STAGES):
                weight = 1.0
                for m in range(_STAGES):
                    if m != j:
                        weight *= (at - f[NODES, m]) / (f[NODES, j] - f[NODES, m])
                value += weight * f[U + j, k]
            f[INSIDE + i, k] = value


@function
def _speed(n, f, k, row, first):
    """c·v of the direction k, v from the place ``first`` of a row on."""
    speed = 0.0
    for i in range(n[SIZES, DIM]):
        speed += f[n[SIZES, DIRECTIONS] + i, k] * f[row, first + i]
    return speed


@function
def _root(before, after, slope_before, slope_after):
    """The part of a step at which the cubic with these values and slopes at its ends, first above
    and then below zero, crosses it: Newton's method between bounds."""
    low, high, s = 0.0, 1.0, 0.5
    for step in range(_ROOT_STEPS):
        r = 1.0 - s
        value = r * r * ((1.0 + 2.0 * s) * before + s * slope_before)
        value += s * s * ((1.0 + 2.0 * r) * after - r * slope_after)
        if value > 0.0:
            low = s
        else:
            high = s
        slope = 6.0 * s * r * (after - before)
        slope += r * (1.0 - 3.0 * s) * slope_before + s * (3.0 * s - 2.0) * slope_after
        nearer = s - value / slope
        if step < _HALVINGS or not (low < nearer < high):
            nearer = 0.5 * (low + high)
        if abs(nearer - s) <= _ROOT:
            break
        s = nearer
    return s


@function
def _carried(n, f):
    """The directions that slide by their modes and whose speeds are sums of those that stick, as a
    relative speed where both bodies do, or a load's beside dry friction: they are 0, and turn
    nowhere. λ is then ρ there, and the others hold the rest."""
    count, d, c = n[SIZES, FRICTIONS], n[SIZES, DIM], n[SIZES, DIRECTIONS]
    alike, pairs = n[SIZES, ALIKE], n[SIZES, PAIRS]
    for k in range(count):
        f[CARRIED, k] = 0.0
    if _stuck(n, f) > 0:
        for k in range(count):
            for m in range(count):
                f[alike + k, m] = 0.0
                for i in range(d):
                    f[alike + k, m] += f[c + i, k] * f[c + i, m]
                f[pairs + k, m] = f[alike + k, m]
        _among(n, f, pairs, count)
        for k in range(count):
            most = 0.0
            for i in range(d):
                left = f[c + i, k]
                for m in range(count):
                    left -= f[pairs + m, k] * f[c + i, m]
                most = max(most, abs(left))
            if f[MODES, k] != 0.0 and most < _APART_FROM:
                f[CARRIED, k] = 1.0


@function
def _changes(n, f):
    """Speeds along the modes AFTER the step, of directions that slide; whether one of them has
    turned or one sticks."""
    d, changes = n[SIZES, DIM], False
    for k in range(n[SIZES, FRICTIONS]):
        if n[KINDS, k] == COULOMB:
            f[AFTER, k] = f[MODES, k] * _speed(n, f, k, X1, d)
            if f[TURNED, k] != 0.0 or f[CARRIED, k] != 0.0:
                f[AFTER, k] = 0.0
            changes = changes or f[AFTER, k] < 0.0 or f[MODES, k] == 0.0
    return changes


@function
def _first_event(n, f, span):
    """The part of a step at which its first direction changes, 1 where none does, and which one: of
    the rates at both ends of the step."""
    d, part, event = n[SIZES, DIM], 1.0, 0
    for k in range(n[SIZES, FRICTIONS]):
        mode, share = f[MODES, k], 1.0
        if n[KINDS, k] != COULOMB:
            continue
        if mode == 0.0:
            spare = f[LIMIT, k] - abs(f[HELD, k])
            if spare < 0.0:
                begun = max(f[LIMIT_FIRST, k] - abs(f[HELD_FIRST, k]), 0.0)
                share = begun / (begun - spare)
        elif f[AFTER, k] < 0.0:
            before, slope = mode * _speed(n, f, k, X0, d), mode * _speed(n, f, k, A_FIRST, 0)
            slope_after = mode * _speed(n, f, k, A, 0)
            share = _root(before, f[AFTER, k], span * slope, span * slope_after)
        if share < part:
            part, event = share, k
    return part, event


@function
def _turn(n, f, event):
    """The modes after that of a direction has changed at X1, whose a is kept in A_FIRST; speeds
    that stick become 0."""
    d = n[SIZES, DIM]
    if f[MODES, event] == 0.0:
        f[MODES, event] = _sign(f[HELD, event])
    elif f[LOSSES, event] > 0.0:
        f[MODES, event] = 0.0
    else:  # without friction it turns and does not stick
        f[MODES, event] = -f[MODES, event]
        f[TURNED, event] = 1.0
    for i in range(d):
        f[A_FIRST, i] = f[A, i]
    if _hold(n, f):
        for i in range(d):
            f[X1, d + i] = 0.0
            for m in range(d):
                f[X1, d + i] += f[n[SIZES, FREE] + i, m] * f[X, d + m]
    for i in range(2 * d):
        f[X, i] = f[X1, i]


@function
def _jump(n, f, event, turning):
    """The derivatives D1 after a has jumped from A_FIRST to A, where a speed turned at this
    rate."""
    d, end = n[SIZES, DIM], n[SIZES, D1] + n[SIZES, DIM]
    for m in range(f.shape[1]):
        late = 0.0
        for i in range(d):
            late -= f[n[SIZES, DIRECTIONS] + i, event] * f[end + i, m]
        late /= turning
        for i in range(d):
            f[end + i, m] += (f[A_FIRST, i] - f[A, i]) * late


@function
def _released(n, f):
    """Let go the direction that sticks by a λ farthest beyond ρ: it slides to where λ held it from.
    False where there is none."""
    most, event = 0.0, 0
    for k in range(n[SIZES, FRICTIONS]):
        beyond = abs(f[HELD, k]) - f[LIMIT, k]
        if n[KINDS, k] == COULOMB and f[MODES, k] == 0.0 and beyond > most:
            most, event = beyond, k
    if most > 0.0:
        f[MODES, event] = _sign(f[HELD, event])
    return most > 0.0


@function
def _forget(n, f):
    """Take from derivatives the speeds of directions that stick: they end at once."""
    d, begin, stage = n[SIZES, DIM], n[SIZES, D0] + n[SIZES, DIM], n[SIZES, D]
    for i in range(d):
        for m in range(f.shape[1]):
            f[stage + i, m] = f[begin + i, m]
            f[begin + i, m] = 0.0
    for i in range(d):
        for k in range(d):
            free = f[n[SIZES, FREE] + i, k]
            for m in range(f.shape[1]):
                f[begin + i, m] += free * f[stage + k, m]


@function
def _coefficients(n, f, laws, lane):
    """The numbers of the law that a lane follows."""
    (coefficients, turns), count, frictions = laws, n[SIZES, TERMS], n[SIZES, FRICTIONS]
    row, turn = min(lane, len(coefficients) - 1), min(lane, len(turns) - 1)
    for j in range(count):
        f[THETA, j] = coefficients[row, j]
        f[COS_PHASE, j] = turns[turn, j]
        f[SIN_PHASE, j] = turns[turn, count + j]
    for k in range(frictions):
        f[LOSSES, k] = coefficients[row, count + k]
    inputs = n[SIZES, INPUTS]
    for i in range(n[SIZES, DIM]):
        for m in range(inputs):
            place = count + frictions + i * inputs + m
            f[n[SIZES, GAINS] + i, m] = coefficients[row, place]


@function
def _lane(n, f, task, lane, begins):
    """Begin a lane: its state and its modes, those of the state where ``begins``."""
    d = n[SIZES, DIM]
    for i in range(2 * d):
        f[X0, i] = f[X, i] = task.x[lane, i]
    for k in range(n[SIZES, FRICTIONS]):
        f[MODES, k] = task.modes[lane, k] if n[KINDS, k] == COULOMB else 1.0
        if begins and n[KINDS, k] == COULOMB:
            f[MODES, k] = _sign(_speed(n, f, k, X0, d))
            if f[MODES, k] == 0.0 and f[LOSSES, k] <= 0.0:
                f[MODES, k] = 1.0


@function
def _store(n, f, task, place, fine):
    """Keep the state after a step, its derivatives and modes; NaN where none was found."""
    (lane, m), d = place, n[SIZES, DIM]
    for i in range(2 * d):
        task.states[lane, m, i] = f[X0, i] if fine else np.nan
        for k in range(task.by.shape[3]):
            task.by[lane, m, i, k] = f[n[SIZES, D0] + i, k] if fine else np.nan
    for k in range(n[SIZES, FRICTIONS]):
        task.after[lane, m, k] = f[MODES, k] if fine else np.nan


@compiled("the motion of laws", 3)
def follow(n, f, laws, task, order):
    """Follow all lanes of a task, with derivatives in the state (``order`` 1) and in the
    coefficients (2). laws: the coefficients (R, ·) and the cosines and sines of the phases (R', 2
    P), of all lanes or of each."""
    (lanes, steps), substeps = task.h.shape, task.u.shape[2]
    last = INSIDE + _STAGES - 1
    d, begin, end = n[SIZES, DIM], n[SIZES, D0], n[SIZES, D1]
    dry, rows = n[SIZES, COULOMBS], 2 * d if order > 0 else 0
    for lane in range(lanes):
        _coefficients(n, f, laws, lane)
        begins = dry > 0 and np.isnan(task.modes[lane, 0])
        _lane(n, f, task, lane, begins)
        status = FINE
        for m in range(steps):
            for i in range(rows):
                for k in range(f.shape[1]):
                    f[begin + i, k] = 1.0 if i == k else 0.0
            for part_of in range(substeps if status == FINE else 0):
                h, done = task.h[lane, m] / substeps, 0.0
                for i in range(_STAGES):
                    for k in range(n[SIZES, INPUTS]):
                        f[U + i, k] = task.u[lane, m, part_of, i, k]
                again = dry + 1 if begins else 0
                begins = False
                while again > 0:  # directions that start at rest and are not held
                    _smooth(n, f, 0.0, -1, U)
                    again = again - 1 if _released(n, f) else 0
                if dry > 0 and order > 0 and _stuck(n, f) > 0:
                    for i in range(2 * d):
                        f[X, i] = f[X0, i]
                    _smooth(n, f, 0.0, -1, U)
                    _forget(n, f)
                for k in range(n[SIZES, FRICTIONS]):
                    f[TURNED, k] = 0.0
                events = _EVENTS
                while events > 0:
                    events -= 1
                    part, event, left, turning = 1.0, 0, 1.0 - done, np.inf
                    _within(n, f, done, 1.0)
                    _smooth(n, f, left * h, order, INSIDE)
                    if dry > 0:
                        _carried(n, f)
                        if _changes(n, f):
                            for i in range(2 * d):
                                f[X, i] = f[X1, i]
                            _smooth(n, f, 0.0, -1, last)
                            part, event = _first_event(n, f, left * h)
                    cut = part < 1.0
                    low, high, tries = 0.0, 1.0, _HALVINGS if cut else 0
                    while tries > 0:  # from the cubic's root: Newton's method, between bounds
                        tries -= 1
                        _within(n, f, done, done + part * left)
                        _smooth(n, f, part * left * h, order if tries == 0 else 0, INSIDE)
                        for i in range(2 * d):
                            f[X, i] = f[X1, i]
                        _smooth(n, f, 0.0, -1, last)
                        speed, turning = _speed(n, f, event, X1, d), _speed(n, f, event, A, 0)
                        if f[MODES, event] == 0.0 or turning == 0.0:
                            turning = np.inf  # let go, where nothing jumps
                        if f[MODES, event] * speed > 0.0:
                            low = part
                        else:
                            high = part
                        nearer = part - speed / turning / (left * h)
                        if low <= nearer <= high:
                            tries = min(tries, 1) if abs(nearer - part) < _NEAR else tries
                        elif tries > 0:
                            nearer = 0.5 * (low + high)
                        part = min(max(nearer, low), high) if nearer == nearer else 1.0
                    if cut:
                        _turn(n, f, event)
                        again = dry + 1
                        while again > 0:
                            _smooth(n, f, 0.0, -1, last)
                            again = again - 1 if _released(n, f) else 0
                        if order > 0:
                            _jump(n, f, event, turning)
                    size = 0.0
                    for i in range(2 * d):
                        f[X0, i] = f[X1, i]
                        size += abs(f[X0, i])
                    for i in range(rows):
                        _copy(f[begin + i], f[end + i])
                    done += part * left
                    if not size < np.inf:
                        status = LOST
                        break
                    if not (cut and part < 1.0 and done < 1.0):
                        break
                    if events == 0:
                        status = UNFINISHED
                if status != FINE:
                    break
            _store(n, f, task, (lane, m), status == FINE)
        task.status[lane] = status
