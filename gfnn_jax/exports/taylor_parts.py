"""C code of Taylor series that is the same for every law: sums of the recurrences, and the way
through a step, with or without events of friction. `exports.taylor` writes what differs."""

from __future__ import annotations

# Of series that begin in rows a and b of T, the sums that their k-th coefficients take.
SUMS = {
    "product": """\
static double product(const double *T, int a, int b, int k)
{
    double sum = 0.0;
    for (int j = 0; j <= k; j++)
        sum += T[a + j]*T[b + k - j];
    return sum;
}
""",
    "square": """\
static double square(const double *T, int a, int k)
{
    double sum = 0.0;
    for (int j = 0; 2*j < k; j++)
        sum += T[a + j]*T[a + k - j];
    sum *= 2.0;
    return k % 2 == 0 ? sum + T[a + k/2]*T[a + k/2] : sum;
}
""",
    "rest": """\
static double rest(const double *T, int a, int b, int k)
{
    double sum = 0.0;
    for (int j = 1; j <= k; j++)
        sum += T[a + j]*T[b + k - j];
    return sum;
}
""",
    "derived": """\
static double derived(const double *T, int a, int b, int k)
{
    double sum = 0.0;
    for (int j = 1; j <= k; j++)
        sum += j*T[a + j]*T[b + k - j];
    return sum/k;
}
""",
    "inner": """\
static double inner(const double *T, int a, int b, int k)
{
    double sum = 0.0;
    for (int j = 1; j < k; j++)
        sum += j*T[a + j]*T[b + k - j];
    return sum/k;
}
""",
    "powered": """\
static double powered(const double *T, int a, int b, double exponent, int k)
{
    double sum = 0.0;
    for (int j = 1; j <= k; j++)
        sum += (exponent*j - (k - j))*T[a + j]*T[b + k - j];
    return sum/(k*T[a]);
}
""",
}

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

/* The time that terms of these orders reach: the last ones are rounding there. */
static double reach(const double *T)
{
    double most = INFINITY;
    for (int k = ORDER - 1; k <= ORDER; k++) {
        double large = 0.0;
        for (int i = 0; i < WIDTH; i++)
            large = fmax(large, fabs(T[i*SIZE + k])/(fabs(T[i*SIZE]) + scale[i]));
        most = fmin(most, pow(ROUNDING/large, 1.0/k));
    }
    return most;
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
        double step = left;
        if (order == ORDER) {
            const double most = reach(T);
            step = fabs(left) <= most ? left : left < 0.0 ? -most : most;
        }
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
        int counts = 0;
        operations(T, k, p);
        power *= h;
        for (int i = 0; i < WIDTH; i++) {
            T[i*SIZE + k + 1] = T[rates[i] + k]/(k + 1);
            const double size = fabs(T[i*SIZE]) + scale[i];
            if (!(fabs(T[i*SIZE + k + 1]*power) <= ROUNDING*size))
                counts = 1;
        }
        small = counts ? 0 : small + 1;
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
        int counts = 0;
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
        for (int i = 0; i < WIDTH; i++) {
            const double size = fabs(T[i*SIZE]) + scale[i];
            if (!(fabs(T[i*SIZE + k + 1]*power) <= ROUNDING*size))
                counts = 1;
        }
        small = counts ? 0 : small + 1;
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
        double step = left;
        if (order == ORDER) {
            const double most = reach(T);
            step = fabs(left) <= most ? left : left < 0.0 ? -most : most;
        }
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
