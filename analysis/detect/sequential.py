"""A sequential test for a change: Page's CUSUM on log likelihood ratios.

Of all tests with a given mean time to a false alarm CUSUM has the shortest worst mean delay, if
the windows before and after the change are independent and their distributions known (Lorden 1971,
Moustakides 1986). It is Wald's sequential probability ratio test begun again whenever it decides
for "no change", so that test does not stand beside it.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]


def cusum(log_ratio: FloatArray) -> FloatArray:
    """Page's statistic after each window, float64 (n,), never negative.

    ``g(t) = max(0, g(t-1) + l(t))`` with ``g = 0`` before the first window.

    Args:
        log_ratio: float64 (n,), log likelihood after the change less before it, finite.

    Raises:
        ValueError: another shape, or a value that is not finite.
    """
    if log_ratio.ndim != 1 or not np.isfinite(log_ratio).all():
        raise ValueError(f"log ratios {log_ratio.shape}: must be finite and one a window")
    out = np.empty(len(log_ratio))
    level = 0.0
    for n, value in enumerate(log_ratio.tolist()):
        level = max(0.0, level + value)
        out[n] = level
    return out
