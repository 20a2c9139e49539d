"""Sine, cosine and hyperbolic tangent with bit-identical results on every machine.

The functions of the C library differ in the last bit between platforms, so a run repeated from
its log on another machine would differ too. The functions of this module give the same bits
everywhere.

- The angle is reduced by multiples of pi/2, which is stored in three parts (Cody and Waite,
  "Software Manual for the Elementary Functions", 1980).
- The polynomials for sine and cosine, valid up to an eighth of a turn in either direction, and
  the rational functions for the hyperbolic tangent are those of S. Moshier's Cephes library.

Invariant:
    - All results are sums, products and quotients in a fixed order. The platform's mathematics
      library is not used. An arm therefore moves identically on all machines with IEEE doubles.
"""

import math

from ..step.jit import leaf
from ..step.vectors import choose, round_down, whole

_QUARTERS_PER_RAD = 2.0 / math.pi
# pi/2 in three parts: products of the first two with small integers are exact.
_PART_1 = 1.5707963267341256
_PART_2 = 6.077100506303966e-11
_PART_3 = 2.0222662487959506e-21
LARGEST_RAD = 2.0**30
"""Largest supported angle, rad. Beyond it, a double resolves angles only to a tenth of a
microradian.
"""


@leaf
def sincos(x: float) -> tuple[float, float]:
    """Computes the sine and cosine of an angle in rad, bit-identical on every machine.

    The absolute error is at most 2^-52 for angles up to 1e5 rad in magnitude. For larger
    angles, it can be about as large as the rounding error of the angle itself. Both results are
    NaN if the angle is not finite or its magnitude exceeds `LARGEST_RAD`.
    """
    # The nearest quarter turn, and the angle y from there. `round_down` returns a float, so
    # that computing y need not wait for conversions to an integer and back.
    quarter = round_down(x * _QUARTERS_PER_RAD + 0.5)
    y = ((x - quarter * _PART_1) - quarter * _PART_2) - quarter * _PART_3
    z = y * y
    # Horner's scheme for sin(y) and cos(y), with y from -pi/4 to pi/4.
    s = 1.58962301576546568060e-10
    s = s * z - 2.50507477628578072866e-8
    s = s * z + 2.75573136213857245213e-6
    s = s * z - 1.98412698295895385996e-4
    s = s * z + 8.33333333332211858878e-3
    s = s * z - 1.66666666666666307295e-1
    s = y + y * z * s
    c = -1.13585365213876817300e-11
    c = c * z + 2.08757008419747316778e-9
    c = c * z - 2.75573141792967388112e-7
    c = c * z + 2.48015872888517045348e-5
    c = c * z - 1.38888888888730564116e-3
    c = c * z + 4.16666666666665929218e-2
    c = 1.0 - 0.5 * z + z * z * c
    # After n quarter turns: (s, c), (c, -s), (-s, -c) or (-c, s) for n modulo 4. `choose` in
    # place of branches lets a loop over several angles use vector instructions.
    is_in_range = abs(x) <= LARGEST_RAD
    turn = whole(choose(is_in_range, quarter, 0.0))
    is_odd = turn & 1 != 0
    sine = choose(is_odd, c, s)
    cosine = choose(is_odd, s, c)
    sine = choose(turn & 2 != 0, -sine, sine)
    cosine = choose((turn + 1) & 2 != 0, -cosine, cosine)
    return choose(is_in_range, sine, math.nan), choose(is_in_range, cosine, math.nan)


_LOG_2_HIGH = 6.93145751953125e-1
_LOG_2_LOW = 1.42860682030941723212e-6
"""The natural logarithm of 2, split into two parts. The first part has few bits."""
_LOG_2_OF_E = 1.4426950408889634
_SMALL = 0.625
_LARGE = 20.0
"""Argument above which the hyperbolic tangent is 1 to the last bit."""


@leaf
def tanh(x: float) -> float:
    """Returns the hyperbolic tangent, bit-identical on every machine (NaN for NaN).

    The error is at most two units in the last place. The method and the coefficients of all
    polynomials are those of Cephes (`tanh` and `exp`). Arguments with |x| < 0.625 use a
    rational function of x^2, where P and Q are polynomials:

        tanh(x) = x + x^3 P(x^2) / Q(x^2)

    Larger arguments use 1 - 2 / (exp(2 |x|) + 1) with the sign of x. The exponential is

        exp(2 |x|) = 2^n exp(y),    y = 2 |x| - n log 2
        exp(y) = 1 + 2 y P(y^2) / (Q(y^2) - y P(y^2))

    where n is the integer nearest to 2 |x| / log 2, and P and Q are other polynomials.
    """
    square = x * x
    magnitude = abs(x)
    if magnitude < _SMALL:
        # Horner's scheme.
        P = -9.64399179425052238628e-1 * square - 9.92877231001918586564e1
        P = P * square - 1.61468768441708447952e3
        Q = square + 1.12811678491632931402e2
        Q = Q * square + 2.23548839060100448583e3
        Q = Q * square + 4.84406305325125486048e3
        return x + x * square * (P / Q)
    if magnitude >= _LARGE:
        return 1.0 if x > 0.0 else -1.0
    # NaN fails both this comparison and the previous comparison.
    is_nan = not magnitude < _LARGE
    if is_nan:
        return math.nan

    n = math.floor(2.0 * magnitude * _LOG_2_OF_E + 0.5)
    # log 2 has two parts, so that the first product is exact.
    y = (2.0 * magnitude - n * _LOG_2_HIGH) - n * _LOG_2_LOW
    square = y * y
    # Horner's scheme for y P and Q.
    P = 1.26177193074810590878e-4 * square + 3.02994407707441961300e-2
    P = y * (P * square + 9.99999999999999999910e-1)
    Q = 3.00198505138664455042e-6 * square + 2.52448340349684104192e-3
    Q = Q * square + 2.27265548208155028766e-1
    Q = Q * square + 2.0
    exponential = (1.0 + 2.0 * P / (Q - P)) * float(1 << int(n))
    tangent = 1.0 - 2.0 / (exponential + 1.0)
    return tangent if x > 0.0 else -tangent
