"""The Pareto front: rows that no other row dominates.

The method is exact. Rows sorted by their first objective can be dominated only by earlier rows, and
a dominated row is always dominated by a row of the front; so each row is compared only with the
front so far.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt


def front(costs: npt.NDArray[Any]) -> npt.NDArray[np.bool_]:
    """Return which rows are on the Pareto front.

    A row is off it if another is nowhere higher and somewhere lower. Equal rows stand or fall
    together. Infinity is a cost like any other: the highest.

    Args:
        costs: (n, k) numbers, all to be low; give what is to be high with its sign turned.

    Returns:
        bool (n,).

    Raises:
        ValueError: not a table, or not a number in it.
    """
    costs = np.asarray(costs, np.float64)
    if costs.ndim != 2 or not costs.shape[1]:
        raise ValueError(f"costs have the shape {costs.shape}; expected (n, k), k at least 1")
    if np.isnan(costs).any():
        raise ValueError(f"costs of row {int(np.isnan(costs).any(axis=1).argmax())} hold a NaN")
    n, k = costs.shape
    on = np.zeros(n, np.bool_)
    retained = np.empty((n, k))
    count = 0
    # the last key sorts first: by the first objective, ties by the next ones
    for row in np.lexsort(costs.T[::-1]).tolist():
        cost, best = costs[row], retained[:count]
        beaten = (best <= cost).all(axis=1) & (best < cost).any(axis=1)
        if not beaten.any():
            on[row] = True
            retained[count] = cost
            count += 1
    return on
