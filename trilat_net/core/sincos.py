"""Sine and cosine by plain arithmetic: the same bits on every machine, and both for the price of one.

Invariant: additions and products in a fixed order, nothing of the platform's mathematics library, so an arm
moves alike on every machine with IEEE doubles. The platform's own functions differ in the last bit from one
C library to the next, and a replay must not.

The angle is reduced by pi/2 in three parts (Cody and Waite, "Software Manual for the Elementary Functions",
1980); the polynomials are those of S. Moshier's Cephes library, for an eighth of a turn on either side.
"""

import math

from .jit import leaf

_TURNS = 2.0 / math.pi
_PART_1 = 1.5707963267341256
_PART_2 = 6.077100506303966e-11
_PART_3 = 2.0222662487959506e-21
LARGEST_RAD = 2.0**30
"""Beyond this the angle itself is known to no better than a tenth of a microradian."""


@leaf
def sincos(x: float) -> tuple[float, float]:
    """Returns sine and cosine of an angle, rad, to one unit in the last place of 1.

    NaN where the angle is not finite or beyond `LARGEST_RAD`. Beyond 1e5 rad the reduction rounds as the
    angle itself does.
    """
    if not abs(x) <= LARGEST_RAD:
        return math.nan, math.nan
    quarter = math.floor(x * _TURNS + 0.5)
    y = ((x - quarter * _PART_1) - quarter * _PART_2) - quarter * _PART_3
    z = y * y
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
    turn = int(quarter) & 3
    if turn == 0:
        return s, c
    if turn == 1:
        return c, -s
    if turn == 2:
        return -s, -c
    return -c, s
