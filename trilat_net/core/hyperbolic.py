"""The hyperbolic tangent by plain arithmetic: the same bits on every machine, as of `sincos`.

The fractions are those of S. Moshier's Cephes library.
"""

import math

from .jit import leaf

_LOG_2_HIGH = 6.93145751953125e-1
_LOG_2_LOW = 1.42860682030941723212e-6
"""The natural logarithm of 2 in two parts."""
_LOG_2_OF_E = 1.4426950408889634
_SMALL = 0.625
_LARGE = 20.0
"""From here on the tangent is 1 to the last bit."""


@leaf
def tanh(x: float) -> float:
    """Returns the hyperbolic tangent, to two units in the last place; NaN of NaN."""
    z = x * x
    size = abs(x)
    if size < _SMALL:
        above = (-9.64399179425052238628e-1 * z - 9.92877231001918586564e1) * z - 1.61468768441708447952e3
        below = ((z + 1.12811678491632931402e2) * z + 2.23548839060100448583e3) * z + 4.84406305325125486048e3
        return x + x * z * (above / below)
    if size >= _LARGE:
        return 1.0 if x > 0.0 else -1.0
    if not size < _LARGE:
        return math.nan
    halvings = math.floor(2.0 * size * _LOG_2_OF_E + 0.5)
    y = (2.0 * size - halvings * _LOG_2_HIGH) - halvings * _LOG_2_LOW
    z = y * y
    above = y * ((1.26177193074810590878e-4 * z + 3.02994407707441961300e-2) * z + 9.99999999999999999910e-1)
    below = (3.00198505138664455042e-6 * z + 2.52448340349684104192e-3) * z + 2.27265548208155028766e-1
    below = below * z + 2.0
    grown = (1.0 + 2.0 * above / (below - above)) * float(1 << int(halvings))
    tangent = 1.0 - 2.0 / (grown + 1.0)
    return tangent if x > 0.0 else -tangent
