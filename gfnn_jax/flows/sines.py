"""Sines and cosines in compiled loops, of several numbers at once."""

import math

import numpy as np

from gfnn_jax.flows.translated import function


@function
def two_sum(a, b):
    """The sum of two numbers, and what rounding takes from it (D. E. Knuth)."""
    total = a + b
    rest = total - a
    return total, (a - (total - rest)) + (b - rest)


@function
def sines(x, sine, cosine, columns):
    """Sines and cosines of x, to 0.8 of their last digit: by their power series at y, what a
    multiple of π/2 leaves of x, in arithmetic that processors do on several columns at once."""
    far = 0
    for k in range(columns):
        far += abs(x[k]) > 1e6  # where the product of the multiple and 33 digits would be rounded
    if far > 0:
        for k in range(columns):
            sine[k], cosine[k] = math.sin(x[k]), math.cos(x[k])
        return
    for k in range(columns):
        quarters = np.rint(x[k] * 0.6366197723675814)
        # π/2 is the sum of three numbers, the first two of 33 digits (Cody & Waite).
        part, by = x[k] - quarters * 1.5707963267341256, quarters * 6.077100506303966e-11
        near, lost = two_sum(part, -by)
        lost -= quarters * 2.0222662487959506e-21
        y, rest = two_sum(near, lost)
        z, zz = y * y, y * y * (y * y)
        of_sine = (1 / 6227020800 - z * (1 / 1307674368000)) + zz * (1 / 355687428096000)
        of_sine = (1 / 362880 - z * (1 / 39916800)) + zz * of_sine
        of_sine = (1 / 120 - z * (1 / 5040)) + zz * of_sine
        of_cosine = (1 / 20922789888000 - z * (1 / 6402373705728000)) * zz
        of_cosine = (1 / 479001600 - z * (1 / 87178291200)) + of_cosine
        of_cosine = (1 / 40320 - z * (1 / 3628800)) + zz * of_cosine
        of_cosine = (1 / 24 - z * (1 / 720)) + zz * of_cosine
        cube, begun, lost = z * y, 1.0 - 0.5 * z, (1.0 - (1.0 - 0.5 * z)) - 0.5 * z
        sin = y - ((z * (0.5 * rest - cube * of_sine) - rest) + cube * (1 / 6))
        cos = begun + (lost + (zz * of_cosine - y * rest))
        turned = quarters - 4.0 * np.rint(0.25 * quarters)
        odd, behind = abs(turned) == 1.0, abs(turned) == 2.0
        first, second = cos if odd else sin, sin if odd else cos
        sine[k] = -first if behind or turned == -1.0 else first
        cosine[k] = -second if behind or turned == 1.0 else second
