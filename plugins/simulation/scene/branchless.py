"""Exponential and logarithm without branches, for parallel lanes of tips or pixels.

A call of the mathematics library inside a loop keeps it from being computed several lanes at a
time. These two are plain arithmetic, right to a few units in the last place, and give the same
bits on every processor.
"""

from __future__ import annotations

from math import factorial

import numpy as np

from sliplab.storage.kernels import njit

# ln 2 in two parts, the first of which times a small whole number is exact
_LN2_HIGH, _LN2_LOW = 6.93147180369123816490e-01, 1.90821492927058770002e-10
_PER_LN2 = 1.0 / np.log(2.0)
# added to a number below 2^51 it leaves the nearest whole number in the lowest bits
_WHOLE = 1.5 * 2.0**52
_WHOLE_BITS = int(np.float64(_WHOLE).view(np.int64))
_LARGEST = 700.0
_E3, _E4, _E5, _E6, _E7, _E8, _E9, _E10, _E11, _E12, _E13 = (
    float(1.0 / factorial(k)) for k in range(3, 14)
)
# bits of a double: one half of the square root of two marks where the exponent changes
_ROOT_HALF = int(np.float64(np.sqrt(0.5)).view(np.int64))
_ONE = int(np.float64(1.0).view(np.int64))
_FRACTION = (1 << 52) - 1
# minimax coefficients of (log(1 + f) - f + f^2 / 2) in s = f / (2 + f) (FreeBSD's e_log.c)
_L1, _L2, _L3, _L4, _L5, _L6, _L7 = (
    6.666666666666735130e-01,
    3.999999999940941908e-01,
    2.857142874366239149e-01,
    2.222219843214978396e-01,
    1.818357216161805012e-01,
    1.531383769920937332e-01,
    1.479819860511658591e-01,
)


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def exp_minus(exponent: float) -> float:
    """Return exp(-exponent) for an `exponent` >= 0; above 700 it counts as 700."""
    x = exponent if exponent < _LARGEST else _LARGEST
    marked = x * _PER_LN2 + _WHOLE
    whole = marked - _WHOLE
    r = (whole * _LN2_HIGH - x) + whole * _LN2_LOW
    # the series to the 13th power, in pairs: a chain of products would be slower
    r2 = r * r
    r4 = r2 * r2
    low = (1.0 + r) + r2 * (0.5 + r * _E3) + r4 * ((_E4 + r * _E5) + r2 * (_E6 + r * _E7))
    high = (_E8 + r * _E9) + r2 * (_E10 + r * _E11) + r4 * (_E12 + r * _E13)
    power = low + r4 * r4 * high
    biased = 1023 - (np.float64(marked).view(np.int64) - _WHOLE_BITS)
    return power * np.int64(biased << 52).view(np.float64)


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def logarithm(x: float) -> float:
    """Natural logarithm of a normal number above 0."""
    bits = np.float64(x).view(np.int64) + (_ONE - _ROOT_HALF)
    # the exponent as a float, from its bits: wide registers have no other conversion
    exponent = np.int64((bits >> 52) + _WHOLE_BITS).view(np.float64) - (_WHOLE + 1023.0)
    f = np.int64((bits & _FRACTION) + _ROOT_HALF).view(np.float64) - 1.0
    s = f / (2.0 + f)
    z = s * s
    w = z * z
    even = w * (_L2 + w * (_L4 + w * _L6))
    odd = z * (_L1 + w * (_L3 + w * (_L5 + w * _L7)))
    half = 0.5 * f * f
    return exponent * _LN2_HIGH - ((half - (s * (half + (even + odd)) + exponent * _LN2_LOW)) - f)
