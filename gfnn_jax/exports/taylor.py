"""The flow of a law by Taylor series in time, to roundoff, over any time, as C.

    z(t + τ) = Σ_k z_k τ^k,      (k + 1) z_{k+1} = f_k

The coefficients f_k of the rates follow from those of z by recurrences, one for each operation of
the graph (Å. Jorba & M. Zou, Exp. Math. 14 (2005) 99; A. Griewank & A. Walther, "Evaluating
Derivatives", ch. 13). A series ends where two terms in a row are rounding; where the most terms are
too few for the time that is left, it is followed as far as they reach. A flow computed to roundoff
is symplectic to roundoff.

Friction has events: f is analytic between two of them only. The series of a speed tells when it
turns, that of the force which holds a body when it exceeds what friction holds; a body that is held
has the series of this force as one unknown more of each order, from d^k(c·v)/dt^k = 0.
"""

import re
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from gfnn_jax.errors import InputError
from gfnn_jax.exports.graph import LawGraph
from gfnn_jax.exports.symbols import Symbol, Tape, literal


class Sum(NamedTuple):
    """Σ_j w_j a_j b_{k−j} of the coefficients of two series, j from ``first`` to k or, where
    ``below``, to k − 1. weight, by: w as C has it, and what C divides the sum by; share: w ÷ k of
    (j, k, exponent)."""

    first: int
    below: bool = False
    weight: str = ""
    by: str = ""
    share: Callable[[int, int, float], float] | None = None

    def in_c(self, name: str) -> str:
        """Write it as a function of series that begin in rows a and b of T."""
        more = ", double exponent" * ("exponent" in self.weight)
        return f"""\
static double {name}(const double *T, int a, int b{more}, int k)
{{
    double sum = 0.0;
    for (int j = {self.first}; j {"<" if self.below else "<="} k; j++)
        sum += {self.weight}T[a + j]*T[b + k - j];
    return sum{self.by};
}}
"""


SUMS = {
    "product": Sum(0),
    "rest": Sum(1),
    "derived": Sum(1, False, "j*", "/k", lambda j, k, _: j / k),
    "inner": Sum(1, True, "j*", "/k", lambda j, k, _: j / k),
    "powered": Sum(
        1, False, "(exponent*j - (k - j))*", "/(k*T[a])", lambda j, k, e: (e * j - (k - j)) / k
    ),
}
SQUARE = """\
static double square(const double *T, int a, int k)
{
    double sum = 0.0;
    for (int j = 0; 2*j < k; j++)
        sum += T[a + j]*T[a + k - j];
    sum *= 2.0;
    return k % 2 == 0 ? sum + T[a + k/2]*T[a + k/2] : sum;
}
"""

MOVED = """\
/* z a time t later; whether it is of numbers. */
static int moved(const double *T, int order, double t, double *z)
{
    double sum[WIDTH], all = 0.0;
    for (int i = 0; i < WIDTH; i++)
        sum[i] = 0.0;
    for (int k = order; k > 0; k--)
        for (int i = 0; i < WIDTH; i++)
            sum[i] = (sum[i] + T[i*SIZE + k])*t;
    for (int i = 0; i < WIDTH; i++) {
        z[i] = T[i*SIZE] + sum[i];
        all += fabs(z[i]);
    }
    return isfinite(all);
}

/* A time, or as much of it as terms of all orders reach: the last ones are rounding there. */
static double reach(const double *T, int order, double left)
{
    double most = INFINITY;
    if (order < ORDER)
        return left;
    for (int k = ORDER - 1; k <= ORDER; k++) {
        double large = 0.0;
        for (int i = 0; i < WIDTH; i++)
            large = fmax(large, fabs(T[i*SIZE + k])/(fabs(T[i*SIZE]) + scale[i]));
        most = fmin(most, pow(ROUNDING/large, 1.0/k));
    }
    return fabs(left) <= most ? left : left < 0.0 ? -most : most;
}
"""

COUNTING = """\
/* Whether the terms behind order k count, power = h^(k + 1). */
static int counting(const double *T, int k, double power)
{
    for (int i = 0; i < WIDTH; i++)
        if (!(fabs(T[i*SIZE + k + 1]*power) <= ROUNDING*(fabs(T[i*SIZE]) + scale[i])))
            return 1;
    return 0;
}
"""

SMOOTH = """\
/* z a time h later. */
static int flow(double *z, double h, const double *u, const double *p)
{
    double T[ROWS*SIZE];
    double done = 0.0;
    for (int count = 0; count < MOST_SERIES; count++) {
        const double left = h - done;
        for (int i = 0; i < WIDTH; i++)
            T[i*SIZE] = z[i];
        given(T, u, done);
        const int order = series(T, left, p);
        const double step = reach(T, order, left);
        if (!moved(T, order, step, z))
            return NON_FINITE;
        if (step == left)
            return OK;
        done += step;
    }
    return NOT_CONVERGED;
}
"""

SERIES = """\
/* The series of z, as long as its terms count within h; returns their order. */
static int series(double *T, double h, const double *p)
{
    double power = 1.0;
    int small = 0;
    for (int k = 0; k < ORDER; k++) {
        operations(T, k, p);
        for (int i = 0; i < WIDTH; i++)
            T[i*SIZE + k + 1] = T[rates[i] + k]/(k + 1);
        power *= h;
        small = counting(T, k, power) ? 0 : small + 1;
        if (small == 2)
            return k + 1;
    }
    return ORDER;
}
"""

WITH_FRICTION = """\
/* The series that begins in row a, from its term `first` on, at t. */
static double value(const double *T, int a, int first, int order, double t)
{
    double sum = 0.0;
    for (int k = order; k > first; k--)
        sum = (sum + T[a + k])*t;
    return T[a + first] + sum;
}

/* lambda of A lambda = e for the bodies that are held, A (FRICTIONS, FRICTIONS) symmetric; 0 where
   others hold a body already. */
static void held_forces(const double *A, const double *e, const double *held, double *lambda)
{
    double a[FRICTIONS*FRICTIONS], b[FRICTIONS];
    for (int i = 0; i < FRICTIONS; i++) {
        b[i] = held[i]*e[i];
        for (int j = 0; j < FRICTIONS; j++)
            a[i*FRICTIONS + j] = held[i]*held[j]*A[i*FRICTIONS + j];
    }
    for (int k = 0; k < FRICTIONS; k++) {
        const int free = a[k*FRICTIONS + k] > 1e-10*A[k*FRICTIONS + k];
        for (int i = k + 1; i < FRICTIONS; i++) {
            const double part = free ? a[i*FRICTIONS + k]/a[k*FRICTIONS + k] : 0.0;
            for (int j = k; j < FRICTIONS; j++)
                a[i*FRICTIONS + j] -= part*a[k*FRICTIONS + j];
            b[i] -= part*b[k];
        }
        lambda[k] = free ? 1.0 : 0.0;
    }
    for (int k = FRICTIONS - 1; k >= 0; k--) {
        for (int j = k + 1; j < FRICTIONS; j++)
            b[k] -= a[k*FRICTIONS + j]*lambda[j];
        lambda[k] = lambda[k] > 0.0 ? b[k]/a[k*FRICTIONS + k] : 0.0;
    }
}

/* The series of z up to an order, as long as its terms count within h; returns their order. */
static int series(double *T, double h, int most, const double *p, const double *sigma,
                  const double *held)
{
    double A[FRICTIONS*FRICTIONS], e[FRICTIONS], lambda[FRICTIONS], speed[FRICTIONS];
    double power = 1.0;
    int small = 0, any = 0;
    for (int j = 0; j < FRICTIONS; j++)
        any = any || held[j] > 0.0;
    operations(T, 0, p, sigma);
    for (int i = 0; i < FRICTIONS; i++)
        speed[i] = T[speeds[i]];
    for (int j = 0; any && j < FRICTIONS; j++) {
        for (int i = 0; i < DIM; i++)
            T[(DIM + i)*SIZE] += directions[j*DIM + i];
        operations(T, 0, p, sigma);
        for (int i = 0; i < FRICTIONS; i++)
            A[i*FRICTIONS + j] = T[speeds[i]] - speed[i];
        for (int i = 0; i < DIM; i++)
            T[(DIM + i)*SIZE] -= directions[j*DIM + i];
    }
    for (int k = 0; k < most; k++) {
        operations(T, k, p, sigma);
        for (int i = 0; i < WIDTH; i++)
            T[i*SIZE + k + 1] = T[rates[i] + k]/(k + 1);
        if (any) {
            operations(T, k + 1, p, sigma);
            for (int j = 0; j < FRICTIONS; j++)
                e[j] = (k + 1)*T[speeds[j] + k + 1];
            held_forces(A, e, held, lambda);
            for (int j = 0; j < FRICTIONS; j++) {
                T[(WIDTH + j)*SIZE + k] = lambda[j];
                for (int i = 0; i < DIM; i++)
                    T[(DIM + i)*SIZE + k + 1] -= directions[j*DIM + i]*lambda[j]/(k + 1);
            }
        }
        power *= h;
        small = counting(T, k, power) ? 0 : small + 1;
        if (small == 2) {
            operations(T, k + 1, p, sigma);
            return k + 1;
        }
    }
    operations(T, most, p, sigma);
    return most;
}

static double sign(double x)
{
    return (x > 0.0 ? 1.0 : 0.0) - (x < 0.0 ? 1.0 : 0.0);
}

/* The first time until `end` at which side*(a series) is below a level; INFINITY where none is. */
static double first_below(const double *T, int a, int first, int order, double end, double side,
                          double level)
{
    for (int i = 1; i <= SCAN; i++) {
        if (!(side*value(T, a, first, order, end*i/SCAN) < level))
            continue;
        double low = end*(i - 1)/SCAN, high = end*i/SCAN;
        for (int n = 0; n < 60; n++) {
            const double middle = 0.5*(low + high);
            if (side*value(T, a, first, order, middle) < level)
                high = middle;
            else
                low = middle;
        }
        return high;
    }
    return INFINITY;
}

/* z a time h later, from one event of friction to the next; backwards there is no motion of bodies
   that stick. */
static int flow(double *z, double h, const double *u, const double *p)
{
    double T[ROWS*SIZE], sigma[FRICTIONS], held[FRICTIONS], still[FRICTIONS];
    double done = 0.0, all = 0.0;
    if (STICKS && h < 0.0)
        return NOT_CONVERGED;
    for (int j = 0; j < FRICTIONS; j++)
        sigma[j] = 0.0;
    for (int i = 0; i < WIDTH; i++)
        T[i*SIZE] = z[i];
    given(T, u, 0.0);
    operations(T, 0, p, sigma);
    for (int i = 0; i < DIM; i++)
        all += fabs(T[rates[i]]);
    for (int j = 0; j < FRICTIONS; j++) {
        still[j] = fabs(T[speeds[j]]) <= REST*all ? 1.0 : 0.0;
        sigma[j] = still[j] > 0.0 ? 0.0 : sign(T[speeds[j]]);
        held[j] = still[j] > 0.0 && limit(T, p, j) > 0.0 ? 1.0 : 0.0;
    }
    for (int count = 0; count < MOST_SERIES; count++) {
        const double left = h - done;
        for (int i = 0; i < WIDTH; i++)
            T[i*SIZE] = z[i];
        given(T, u, done);
        for (int again = 0; again <= 2*FRICTIONS; again++) {
            int changed = 0;
            for (int j = 0; j < FRICTIONS; j++)
                if (held[j] > 0.0)
                    sigma[j] = 0.0;
            series(T, left, 1, p, sigma, held);
            for (int j = 0; j < FRICTIONS; j++) {
                const double force = T[(WIDTH + j)*SIZE];
                if (held[j] > 0.0 && fabs(force) > limit(T, p, j)) {
                    held[j] = 0.0;
                    sigma[j] = sign(force);
                    changed = 1;
                } else if (!(held[j] > 0.0) && sigma[j] == 0.0) {
                    sigma[j] = T[speeds[j] + 1] < 0.0 ? -1.0 : 1.0;
                    changed = 1;
                }
            }
            if (!changed)
                break;
        }
        const int order = series(T, left, ORDER, p, sigma, held);
        double step = reach(T, order, left);
        int event = -1;
        for (int j = 0; j < FRICTIONS; j++) {
            double at = INFINITY;
            if (held[j] > 0.0) {
                const double most = limit(T, p, j)*(1.0 + REST);
                at = fmin(first_below(T, (WIDTH + j)*SIZE, 0, order - 1, step, 1.0, -most),
                          first_below(T, (WIDTH + j)*SIZE, 0, order - 1, step, -1.0, -most));
            } else {
                const int first = still[j] > 0.0 ? 1 : 0;
                at = first_below(T, speeds[j], first, order, step, sigma[j], 0.0);
            }
            if (fabs(at) < fabs(step) || (fabs(at) == fabs(step) && event < 0)) {
                step = at;
                event = j;
            }
        }
        if (!moved(T, order, step, z))
            return NON_FINITE;
        if (step == left)
            return OK;
        done += step;
        for (int j = 0; j < FRICTIONS; j++)
            if (j != event)
                still[j] = held[j];
        if (event >= 0) {
            still[event] = 1.0;
            if (held[event] > 0.0) {
                held[event] = 0.0;
                sigma[event] = sign(value(T, (WIDTH + event)*SIZE, 0, order - 1, step));
            } else if (limit(T, p, event) > 0.0) {
                held[event] = 1.0;
            } else {
                sigma[event] = -sigma[event];
                still[event] = 0.0;
            }
        }
    }
    return NOT_CONVERGED;
}
"""


class Options:
    """Options of the series (`benchmarks/machines.py`)."""

    # The most terms: 28 let one series reach dt in most scenes, where 20, the cheapest for each
    # unit of time (Jorba & Zou), take two.
    order: int = 28
    rounding: float = 2.0**-52  # of a term ÷ (size of its coordinate), that ends a series
    most: int = 2_000  # series of a step, from event to event
    scan: int = 16  # places in a series where an event is looked for
    rest: float = 1e-12  # speed ÷ all speeds, that rounding leaves of one that is 0
    # Sums over products in a law whose loops are written out: a compiler then keeps the
    # coefficients in registers.
    unrolled: int = 6
    first: int = 4  # terms of a series before it is asked whether it ends


def _refused(_: Any) -> Any:
    raise InputError("this law has no Taylor series: abs is not analytic; use --to stablehlo")


def _whole_power(u: Any, exponent: float) -> Any:
    """u to a whole power by products, which a u of 0 does not stop."""
    if exponent != int(exponent):
        return u.tape.made("pow", u, exponent)
    made: Any = 1.0
    for _ in range(int(abs(exponent))):
        made = made * u
    return made if exponent > 0 else 1.0 / made


def _beside(own: str, other: str) -> Any:
    """A function whose series is made together with another's."""

    def both(u: Any) -> Any:
        made = u.tape.made(own, u)
        u.tape.made(other, u)
        return made

    return both


def _arctan(u: Any) -> Any:
    u.tape.made("+", 1.0, u * u)  # divides its derivative
    return u.tape.made("atan", u)


_PARTNERS = {"sin": "cos", "cos": "sin", "sinh": "cosh", "cosh": "sinh"}
_FUNCTIONS = {
    **{own: _beside(own, other) for own, other in _PARTNERS.items()},
    **{name: (lambda u, name=name: u.tape.made(name, u)) for name in ("exp", "log", "sqrt")},
    "tan": lambda u: _FUNCTIONS["sin"](u) / _FUNCTIONS["cos"](u),
    "tanh": lambda u: _FUNCTIONS["sinh"](u) / _FUNCTIONS["cosh"](u),
    "atan": _arctan,
    "pow": _whole_power,
    "fabs": _refused,
}


def _has_row(rate: Any) -> bool:
    """Return whether a rate has a row in T: no number has one, as of a body without a force, and
    no coefficient."""
    return isinstance(rate, Symbol) and (rate.operation != "input" or rate.operands[0][0] in "zu")


class _Rows:
    """The rows of a table T, a series each: z, the forces that hold bodies, then all operations.

    unrolled: whether coefficients are variables of their own instead of entries of T."""

    def __init__(self, graph: LawGraph, values: Any, unrolled: bool | None):
        self.graph, tape = graph, Tape()
        self.width, self.count = len(graph.rates), len(graph.speeds)
        z, u = tape.inputs("z", self.width)[0], tape.inputs("u", len(graph.arguments))
        inputs = {"z": z, "u": u[0] if u.size else (), "p": values}
        inputs["sigma"] = tape.inputs("sigma", self.count)[0] if self.count else ()
        if values is None:
            inputs["p"] = tape.inputs("p", len(graph.values))[0] if len(graph.values) else ()
        wanted = [*graph.rates, *graph.speeds, *graph.limits]
        found = graph.tape.evaluated(wanted, inputs, _FUNCTIONS)
        ends, each = [self.width, self.width + self.count], np.array([*found, None], dtype=object)
        rates, speeds, limits = np.split(each[:-1], ends)
        self.rates = [rate if _has_row(rate) else tape.made("+", rate, 0.0) for rate in rates]
        self.speeds, self.limits = speeds.tolist(), limits.tolist()
        self.tape, self.size = tape, Options.order + 1
        self.made = self._used()
        self.varies: set[int] = set()
        self.rows: dict[int, int] = {s.number: i for i, s in enumerate(z)}
        self.holds = [self.width + j for j in range(self.count)]
        moving = {f"u[{i}]" for i, own in enumerate(graph.series) if len(own) > 1}
        moving |= {f"u[{graph.time}]"} | {f"z[{i}]" for i in range(self.width)}
        for s in self.made:
            if s.operation == "input":
                if s.operands[0] in moving:
                    self.varies.add(s.number)
            elif any(isinstance(o, Symbol) and o.number in self.varies for o in s.operands):
                self.varies.add(s.number)
            if s.operation != "input" or s.operands[0][0] == "u":
                self.rows.setdefault(s.number, self.width + self.count + len(self.rows) - len(z))
        sums = 0  # coefficients that are sums over products of others
        for s in self.made:
            linear = s.operation in ("+", "-", "negative", "input")
            one = s.operation == "*" and sum(map(self.varying, s.operands)) == 1
            sums += s.number in self.varies and not (linear or one)
        few = sums <= Options.unrolled and not self.count
        self.unrolled = few if unrolled is None else unrolled

    @property
    def num(self) -> int:
        return self.width + self.count + len(self.rows) - self.width

    def _used(self) -> list[Symbol]:
        """The operations that are needed, and the arguments of the law, in their order."""
        ahead = [r for r in (*self.rates, *self.speeds, *self.limits) if isinstance(r, Symbol)]
        used = {s.number for s in self.tape.made_so_far if s.operation == "input"}
        while ahead:
            s = ahead.pop()
            if s.number not in used or s.operation == "input":
                used.add(s.number)
                ahead += [o for o in s.operands if isinstance(o, Symbol)]
                if s.operation in _PARTNERS:
                    ahead.append(self.tape.made(_PARTNERS[s.operation], s.operands[0]))
                if s.operation == "atan":
                    ahead.append(1.0 + s.operands[0] * s.operands[0])
        return [s for s in self.tape.made_so_far if s.number in used]

    def varying(self, value: Any) -> bool:
        return isinstance(value, Symbol) and value.number in self.varies

    def begin(self, value: Any) -> str:
        """Text of where the series of an operand begins in T."""
        return str(self.rows[value.number] * self.size)

    def at(self, value: Any, k: int | str) -> str:
        """Text of the k-th coefficient of an operand: a number, or the index ``k`` itself."""
        if not isinstance(value, Symbol):
            text = literal(value)
            return f"({text})" if text.startswith("-") else text
        if value.operation == "input" and value.operands[0][0] in "ps":
            return value.operands[0]
        if self.unrolled:
            return f"t{self.rows[value.number]}_{k}"
        begin = self.rows[value.number] * self.size
        return f"T[{begin}{'' if k == 0 else f' + {k}'}]"

    def written(self, k: int | str) -> list[str]:
        """The lines that compute the k-th coefficients of all operations."""
        lines, declared = [], "const double " if self.unrolled else ""
        for s in self.made:
            if s.operation == "input" or (k != 0 and s.number not in self.varies):
                continue
            texts = [self.at(o, 0) for o in s.operands]
            if k != 0:
                made = self._later(s, k)
            elif s.operation in ("+", "-", "*", "/"):
                made = f" {s.operation} ".join(texts)
            else:
                made = f"{s.operation.replace('negative', '-')}({', '.join(texts)})"
            lines.append(f"{declared}{self.at(s, k)} = {made};")
        return lines

    def _later(self, s: Symbol, k: int | str) -> str:
        operation, own = s.operation, s.operands
        moving = [o for o in own if self.varying(o)]
        if operation == "negative" or (operation == "-" and not self.varying(own[0])):
            return f"-{self.at(moving[0], k)}"
        if operation in ("+", "-"):
            return f" {operation} ".join(self.at(o, k) for o in moving)
        if operation == "*" and len(moving) == 2:
            same = own[0] is own[1]
            return self._sum("square", own[:1], k) if same else self._sum("product", own, k)
        if operation == "*":
            still = own[0] if moving[0] is own[1] else own[1]
            return f"{self.at(still, 0)}*{self.at(moving[0], k)}"
        if operation == "/":
            by = self._sum("rest", (own[1], s), k)
            factor = "" if not isinstance(own[0], Symbol) and own[0] == 1 else self.at(own[0], 0)
            first = f"{self.at(s, 0)}/{factor}" if factor else self.at(s, 0)
            return f"-{first}*{by}"
        if operation in _PARTNERS:
            other = self.tape.made(_PARTNERS[operation], own[0])
            return f"{'-' if operation == 'cos' else ''}{self._sum('derived', (own[0], other), k)}"
        if operation == "exp":
            return self._sum("derived", (own[0], s), k)
        if operation in ("log", "atan"):
            by = own[0] if operation == "log" else 1.0 + own[0] * own[0]
            left = f"{self.at(own[0], k)} - {self._sum('inner', (s, by), k)}"
            return f"({left})/{self.at(by, 0)}"
        exponent = 0.5 if operation == "sqrt" else own[1]
        return self._sum("powered", (own[0], s), k, literal(exponent))

    def _sum(self, name: str, operands: Sequence[Symbol], k: int | str, *more: str) -> str:
        """A sum over products of coefficients: a call, or its terms where k is a number."""
        if isinstance(k, str):
            given = ", ".join([*map(self.begin, operands), *more])
            return f"{name}(T, {given}, {k})"
        a, b = operands[0], operands[-1]

        def pair(i: int, j: int) -> str:
            return f"{self.at(a, i)}*{self.at(b, j)}"

        if name == "square":
            halves = [pair(j, k - j) for j in range((k + 1) // 2)]
            twice = [f"2.0*({_added(halves)})"] if halves else []
            return f"({_added(twice + ([pair(k // 2, k // 2)] if k % 2 == 0 else []))})"
        own, exponent = SUMS[name], float(more[0]) if more else 0.0
        pairs = [(j, pair(j, k - j)) for j in range(own.first, k + 1 - own.below)]
        if own.share is not None:
            pairs = [(j, f"{literal(own.share(j, k, exponent))}*({text})") for j, text in pairs]
        whole = f"({_added([text for _, text in pairs]) or '0.0'})"
        return f"{whole}/{self.at(a, 0)}" if more else whole


def _added(terms: Sequence[str]) -> str:
    """A sum in pairs, which a processor adds side by side."""
    if len(terms) <= 2:
        return " + ".join(terms)
    half = len(terms) // 2
    return f"({_added(terms[:half])}) + ({_added(terms[half:])})"


def c_of_flow(graph: LawGraph, coefficients: bool = False, unrolled: bool | None = None) -> str:
    """Write ``static int flow(double *z, double h, const double *u, const double *p)`` in C: z is
    moved by h, a time of either sign, and the answer is a status of ``exports.c_parts``.

    coefficients: whether those of the law are ``p``; else they are constants, and p is not read.
    unrolled: whether the sums are written out, by default those of small laws.
    """
    rows = _Rows(graph, None if coefficients else graph.values.tolist(), unrolled)
    sizes = {"DIM": graph.dim, "WIDTH": rows.width, "ORDER": Options.order, "SIZE": rows.size}
    sizes |= {"ROWS": rows.num, "MOST_SERIES": Options.most}
    tables = {"double scale[WIDTH]": map(literal, graph.scale)}
    numbers = {"ROUNDING": Options.rounding}
    if not rows.unrolled:
        tables["int rates[WIDTH]"] = map(rows.begin, rows.rates)
    if rows.count:
        sizes |= {"FRICTIONS": rows.count, "STICKS": int(graph.sticks), "SCAN": Options.scan}
        numbers["REST"] = Options.rest
        tables["int speeds[FRICTIONS]"] = map(rows.begin, rows.speeds)
        tables["double directions[FRICTIONS*DIM]"] = map(literal, np.ravel(graph.directions))
    parts = ["enum { " + ", ".join(f"{name} = {value}" for name, value in sizes.items()) + " };"]
    parts += [f"static const double {name} = {literal(value)};" for name, value in numbers.items()]
    parts += [f"static const {name} = {{{', '.join(of)}}};" for name, of in tables.items()] + [""]
    if rows.unrolled:
        return "\n".join([*parts, MOVED, _given(rows), _written_out(rows), SMOOTH])
    signed = ", const double *sigma" if rows.count else ""
    zeroth, later = rows.written(0), rows.written("k")
    operations = _function(
        f"operations(double *T, int k, const double *p{signed})",
        ["if (k == 0) {", *_indented(zeroth), "    return;", "}", *later],
        [name for name in ("p", "sigma")[: 1 + bool(signed)] if f"{name}[" not in "".join(zeroth)],
    )
    sums = {name: own.in_c(name) for name, own in SUMS.items()} | {"square": SQUARE}
    parts += [text for name, text in sums.items() if re.search(rf"\b{name}\(T,", operations)]
    parts += [MOVED, COUNTING, _given(rows), operations]
    if not rows.count:
        return "\n".join([*parts, SERIES, SMOOTH])
    texts = enumerate(rows.at(limit, 0) for limit in rows.limits)
    chosen = "".join(f"j == {j} ? {text} : " for j, text in texts)
    parts.append(
        "static double limit(const double *T, const double *p, int j)\n{\n"
        f"    (void)(T), (void)(p);\n    return {chosen}0.0;\n}}\n\n"
    )
    return "\n".join([*parts, WITH_FRICTION])


def _indented(lines: Sequence[str]) -> list[str]:
    return [f"    {line}" for line in lines]


def _function(head: str, lines: Sequence[str], unused: Sequence[str]) -> str:
    body = "\n".join(_indented([f"(void)({name});" for name in unused] + list(lines)))
    return f"static void {head}\n{{\n{body}\n}}\n"


def _given(rows: _Rows) -> str:
    """Write the function that puts the args, a time t after the step began, into T."""
    lines = []
    graph = rows.graph
    own = {s.operands[0]: s for s in rows.made if s.operation == "input"}
    for i, places in enumerate(graph.series):
        symbol = own[f"u[{i}]"]
        begin, degree = rows.rows[symbol.number] * rows.size, len(places) - 1
        lines += [f"T[{begin + m}] = u[{place}];" for m, place in enumerate(places)]
        if graph.time == i:
            lines += [f"T[{begin}] += t;", f"T[{begin + 1}] = 1.0;"]
            degree = 1
        elif degree:
            lines += [
                f"for (int n = 0; n < {degree}; n++)",
                f"    for (int m = {degree - 1}; m >= n; m--)",
                f"        T[{begin} + m] += t*T[{begin} + m + 1];",
            ]
        if symbol.number in rows.varies:
            lines += [f"for (int k = {degree + 1}; k < SIZE; k++)", f"    T[{begin} + k] = 0.0;"]
    for rate in rows.rates:
        if not (rows.unrolled or rows.varying(rate)):  # no operation writes its later terms
            lines += ["for (int k = 1; k < SIZE; k++)", f"    T[{rows.begin(rate)} + k] = 0.0;"]
    moving = any(len(places) > 1 for places in graph.series) or graph.time is not None
    text = "".join(lines)
    unused = [name for name in ("T", "u") if f"{name}[" not in text] + ([] if moving else ["t"])
    return _function("given(double *T, const double *u, double t)", lines, unused)


def _written_out(rows: _Rows) -> str:
    """Write ``series`` without loops: each coefficient a variable."""
    graph, lines = rows.graph, []
    inputs = [s for s in rows.made if s.operation == "input" and s.number in rows.rows]
    z = inputs[: rows.width]
    for s in inputs:
        last = Options.order - 1 if s.number in rows.varies and s not in z else 0
        at = [(k, rows.rows[s.number] * rows.size + k) for k in range(last + 1)]
        lines += [f"const double {rows.at(s, k)} = T[{place}];" for k, place in at]
    lines += [
        f"const double size{i} = ROUNDING*(fabs({rows.at(s, 0)}) + {literal(graph.scale[i])});"
        for i, s in enumerate(z)
    ]
    lines.append(f"const double square = h*h;\ndouble power = {'*'.join('h' * Options.first)};")
    for k in range(Options.order):
        lines += rows.written(k)
        for i, (s, rate) in enumerate(zip(z, rows.rates, strict=True)):
            still = k > 0 and not rows.varying(rate)
            later = "0.0" if still else f"{literal(1 / (k + 1))}*{rows.at(rate, k)}"
            place = i * rows.size + k + 1
            lines.append(f"const double {rows.at(s, k + 1)} = {later};")
            lines.append(f"T[{place}] = {rows.at(s, k + 1)};")
        if k > Options.first and (k - Options.first) % 2 == 0:
            lines.append("power *= square;")
            last = [(n, w) for n, w in ((k, "power"), (k + 1, "power*h"))]
            small = [
                f"fabs({rows.at(s, n)}*{w}) <= size{i}" for i, s in enumerate(z) for n, w in last
            ]
            lines += [f"if ({' && '.join(small)})", f"    return {k + 1};"]
    lines.append("return ORDER;")
    body = "\n".join(_indented(["(void)(p);", *_needed(lines)]))
    return f"static int series(double *T, double h, const double *p)\n{{\n{body}\n}}\n"


def _needed(lines: Sequence[str]) -> list[str]:
    """The lines without variables that nothing reads."""
    kept, read = [], set[str]()
    for line in reversed(lines):
        name = re.match(r"const double (t\d+_\d+) = ", line)
        if name is None or name[1] in read:
            kept.append(line)
            read |= {*re.findall(r"t\d+_\d+", line[name.end() if name else 0 :])}
    return kept[::-1]
