"""C code that is the same for every map: Newton's method of one lane, line by line that of
`solve.newton`, whose `iterate` explains it, with that module's constants.
"""

import numpy as np

from gfnn_jax.coordinates import TWO_PI
from gfnn_jax.exports.symbols import literal
from gfnn_jax.generating.generated import MOST_UPDATES
from gfnn_jax.maps.programs import parts_of_two_pi
from gfnn_jax.solve import newton
from gfnn_jax.solve.status import LEFT_DOMAIN, NON_FINITE, NOT_CONVERGED, OK, STATUS_NAMES

_EPS = float(np.finfo(np.float64).eps)

_STATUSES = {OK: "OK", LEFT_DOMAIN: "LEFT_DOMAIN", NOT_CONVERGED: "NOT_CONVERGED"}
_STATUSES[NON_FINITE] = "NON_FINITE"
STATUSES = "; ".join(f"{code} {STATUS_NAMES[code]}" for code in _STATUSES)

INCLUDES = f"""\
#include <math.h>
#include <string.h>

enum {{ {", ".join(f"{name} = {code}" for code, name in _STATUSES.items())} }};
"""

COMMON = """\
static int all_finite(int n, const double *a)
{
    for (int i = 0; i < n; i++)
        if (!isfinite(a[i]))
            return 0;
    return 1;
}

static int worse(int one, int other)
{
    return one > other ? one : other;
}
"""

_NEAR, _BEYOND = (literal(float(part)) for part in parts_of_two_pi(np.float64))

ANGLES = f"""\
/* y - 2 pi turns, next to the centre of the angle's interval; NaN where its last digit is more than
   a radian. */
static double reduced(double y, double centre, double *turns)
{{
    *turns = rint((y - centre)/{literal(TWO_PI)});
    const double near = y - *turns*{_NEAR};
    const double total = near - *turns*{_BEYOND};
    return fabs(*turns)*{literal(_EPS)} < 1.0 ? total : NAN;
}}

static double unreduced(double y, double turns)
{{
    return (y + turns*{_BEYOND}) + turns*{_NEAR};
}}
"""

POLAR = """\
static void to_inner(const double z[4], double y[4])
{
    const double r = hypot(z[0], z[1]);
    y[0] = r;
    y[1] = atan2(z[1], z[0]);
    y[2] = (z[0]*z[2] + z[1]*z[3])/r;
    y[3] = z[0]*z[3] - z[1]*z[2];
}

static void to_user(const double y[4], double z[4])
{
    const double c = cos(y[1]), s = sin(y[1]), t = y[3]/y[0];
    z[0] = y[0]*c;
    z[1] = y[0]*s;
    z[2] = y[2]*c - t*s;
    z[3] = y[2]*s + t*c;
}
"""


def logarithms(width: int) -> str:
    """Write the change of states (width,) to their logarithms in C, and back."""
    ways = (("inner", "y", "log(z[i])"), ("user", "z", "exp(y[i])"))
    return "\n".join(
        f"static void to_{way}(const double *{'z' if to == 'y' else 'y'}, double *{to})\n"
        f"{{\n    for (int i = 0; i < {width}; i++)\n        {to}[i] = {value};\n}}\n"
        for way, to, value in ways
    )


def newton_solver(unknowns: int, width: int) -> str:
    """Write Newton's method in C for at most ``unknowns`` unknowns of states (width,)."""
    rules, bend = newton.RULES, newton.RULES.bent
    least, most = (literal(part * bend) for part in (rules.least_bent, rules.most_bent))
    off, floors = literal(rules.off_path), literal(rules.rounding)
    return f"""\
enum {{ MOST = {MOST_UPDATES}, N = {unknowns}, WIDTH = {width} }};
static const double FLOOR = {literal(rules.floor * _EPS)};
static const double SETTLED = {literal(newton.settled_floors(np.float64))};

struct point {{
    double residual[N], size[N], gradient[WIDTH];
}};

/* r(z, x) = 0 with n unknowns x; solve: the solution, and the sign of the determinant. */
struct equation {{
    int n;
    void (*evaluate)(const double *z, const double *x, struct point *at);
    void (*linearise)(const double *z, const double *x, struct point *at, double *matrix);
    double (*solve)(const double *matrix, const double *rhs, double *x);
}};

static double clip(double x, double low, double high)
{{
    return x < low ? low : x > high ? high : x;
}}

/* The largest entry in magnitude; NaN where one is NaN. */
static double largest(int n, const double *a)
{{
    double most = 0.0;
    for (int i = 0; i < n; i++) {{
        const double size = fabs(a[i]);
        if (size > most || isnan(size))
            most = size;
        if (isnan(most))
            break;
    }}
    return most;
}}

static double sign_of(double a)
{{
    return isnan(a) ? a : (double)((a > 0.0) - (a < 0.0));
}}

static double floors(int n, const struct point *at)
{{
    double relative[N];
    for (int i = 0; i < n; i++)
        relative[i] = at->residual[i]/at->size[i];
    return largest(n, relative)/FLOOR;
}}

static int goes_on(double error, double merit, double before)
{{
    return error > SETTLED || (error > 1.0 && merit < {literal(rules.halves)}*before);
}}

/* The root x near the guess x, and the gradient of S there. */
static int newton(const struct equation *of, const double *z, double *x, double *gradient)
{{
    const int n = of->n;
    struct point here, there;
    double matrix[N*N], step[N], next[N], tried[N], slope[N], off[N];

    of->linearise(z, x, &here, matrix);
    const double sign = of->solve(matrix, here.residual, step);
    for (int i = 0; i < n; i++)
        tried[i] = x[i] - step[i];
    of->evaluate(z, tried, &there);
    double error = floors(n, &here), merit = largest(n, here.residual);
    const double error_there = floors(n, &there), after = largest(n, there.residual);
    const int smaller = after < merit;
    const int done = smaller && !goes_on(error_there, after, merit);
    int open = !done && (smaller || error > SETTLED);
    const int straight = error_there <= SETTLED || after <= {literal(rules.straight)}*merit;
    double factor = straight ? 1.0 : {literal(rules.begin)};
    if (smaller && !open) {{
        here = there;
        error = error_there;
        memcpy(x, tried, n*sizeof *x);
    }}
    for (int iterations = 0; open;) {{
        for (int i = 0; i < n; i++)
            tried[i] = x[i] - factor*step[i];
        of->linearise(z, tried, &there, matrix);
        const double sign_there = of->solve(matrix, there.residual, next);
        const double new_error = floors(n, &there), new_merit = largest(n, there.residual);
        for (int i = 0; i < n; i++) {{
            slope[i] = 0.0;
            for (int j = 0; j < n; j++)
                slope[i] -= matrix[i*n + j]*step[j];
            off[i] = slope[i] + here.residual[i];
        }}
        const double bent = largest(n, off)/fmax(largest(n, slope), merit);
        for (int i = 0; i < n; i++) {{
            const double expected = here.residual[i] + 0.5*factor*(slope[i] - here.residual[i]);
            off[i] = there.residual[i] - expected;
        }}
        const double floor = FLOOR*largest(n, there.size);
        const int near = largest(n, off) <= {off}*factor*merit + {floors}*floor;
        const int by_the_path = bent <= {literal(bend)} && near && sign_there == sign;
        const int settled = error <= SETTLED;
        if (by_the_path || (settled && new_merit < merit)) {{
            iterations++;
            open = goes_on(new_error, new_merit, merit) && iterations < MOST;
            const double bend = clip(bent, {least}, {most});
            factor = fmin({literal(rules.longer * bend)}/bend*factor, 1.0);
            here = there;
            error = new_error;
            merit = new_merit;
            memcpy(x, tried, n*sizeof *x);
            memcpy(step, next, n*sizeof *step);
        }} else {{
            open = factor > (settled ? 1.0 : {literal(0.5**rules.halvings)});
            factor *= 0.5;
        }}
    }}
    memcpy(gradient, here.gradient, sizeof here.gradient);
    return error <= SETTLED ? OK : isfinite(error) ? NOT_CONVERGED : NON_FINITE;
}}
"""


ELIMINATION = """\
/* Elimination with partial pivoting. */
static double eliminated(int n, const double *matrix, const double *rhs, double *x)
{
    double a[N*N], sign = 1.0;
    memcpy(a, matrix, n*n*sizeof *a);
    memcpy(x, rhs, n*sizeof *x);
    for (int k = 0; k < n; k++) {
        int pivot = k;
        for (int i = k + 1; i < n; i++)
            if (fabs(a[i*n + k]) > fabs(a[pivot*n + k]))
                pivot = i;
        if (pivot != k) {
            for (int j = k; j < n; j++) {
                const double kept = a[k*n + j];
                a[k*n + j] = a[pivot*n + j];
                a[pivot*n + j] = kept;
            }
            const double kept = x[k];
            x[k] = x[pivot];
            x[pivot] = kept;
            sign = -sign;
        }
        sign *= sign_of(a[k*n + k]);
        for (int i = k + 1; i < n; i++) {
            const double factor = a[i*n + k]/a[k*n + k];
            for (int j = k + 1; j < n; j++)
                a[i*n + j] -= factor*a[k*n + j];
            x[i] -= factor*x[k];
        }
    }
    for (int k = n - 1; k >= 0; k--) {
        for (int j = k + 1; j < n; j++)
            x[k] -= a[k*n + j]*x[j];
        x[k] /= a[k*n + k];
    }
    return sign;
}
"""
