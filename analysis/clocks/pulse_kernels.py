"""Loops over pulses that a fit goes through many times, compiled.

A train is a thousand pulses, for which numpy takes longer to begin than to compute. Sums are made
in the order in which numpy makes them, so that compiled or not a map is the same to the bit.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sliplab.storage.kernels import njit
from sliplab.storage.streams import F64, I64


@njit(cache=True, nogil=True, error_model="numpy")
def median(values: F64) -> float:
    """Return the same as np.median for at least one float and no NaN."""
    half = values.size // 2
    parted = np.partition(values, half)
    middle = parted[half]
    return middle if values.size % 2 else 0.5 * (parted[:half].max() + middle)


def quantile(values: NDArray[np.float64 | np.int64], share: float) -> float:
    """Return the same as np.quantile for at least one number and no NaN."""
    place = (values.size - 1) * share
    below = int(place)
    above = min(below + 1, values.size - 1)
    parted = np.partition(values, above)
    high = parted[above]
    low = parted[:above].max() if below < above else high
    part = place - below
    between = high - low
    return float(high - between * (1 - part) if part >= 0.5 else low + between * part)


@njit(cache=True, nogil=True, error_model="numpy")
def pair(predicted: F64, y: F64, gate: float) -> tuple[I64, I64]:
    """Pulses that are each other's nearest and closer than `gate`.

    Args:
        predicted, y: (m,) and (n,) times, ascending, ns; neither empty. Of two that are equally
            near the earlier one counts.

    Returns:
        their indices in both, ascending.
    """
    m, n = predicted.size, y.size
    i, j = np.empty(m, np.int64), np.empty(m, np.int64)
    found = after = 0
    for k in range(m):
        p = predicted[k]
        while after < n and y[after] < p:
            after += 1
        right = min(max(after, 1), n - 1)
        near = right - 1 if n > 1 and p - y[right - 1] <= y[right] - p else right
        q = y[near]
        if p < q:
            mutual = k == m - 1 or q - p <= predicted[k + 1] - q
        else:
            mutual = k == 0 or q - predicted[k - 1] > p - q
        if mutual and abs(q - p) <= gate:
            i[found], j[found] = k, near
            found += 1
    return i[:found], j[:found]


@njit(cache=True, nogil=True, error_model="numpy")
def partners(predicted: F64, y: F64, reach: float) -> tuple[I64, I64]:
    """Indices of all pairs of pulses less than `reach` ns apart (as far, if y is the earlier)."""
    low = high = count = 0
    for k in range(predicted.size):
        while low < y.size and y[low] < predicted[k] - reach:
            low += 1
        while high < y.size and y[high] < predicted[k] + reach:
            high += 1
        count += high - low
    which, partner = np.empty(count, np.int64), np.empty(count, np.int64)
    low = high = count = 0
    for k in range(predicted.size):
        while low < y.size and y[low] < predicted[k] - reach:
            low += 1
        while high < y.size and y[high] < predicted[k] + reach:
            high += 1
        for j in range(low, high):
            which[count], partner[count] = k, j
            count += 1
    return which, partner


@njit(cache=True, nogil=True, error_model="numpy")
def fullest(ordered: F64, window: float) -> float:
    """Return the first ascending number from which the most lie within `window`; 0 of none."""
    best, start, end = 0, 0.0, 0
    for k in range(ordered.size):
        while end < ordered.size and ordered[end] <= ordered[k] + window:
            end += 1
        if end - k > best:
            best, start = end - k, ordered[k]
    return start


@njit(cache=True, nogil=True, error_model="numpy")
def places_of(x: F64, knots: F64) -> tuple[I64, F64]:
    """Return the piece between two knots for each rising x, and its place on it, from 0 to 1."""
    piece, share = np.empty(x.size, np.int64), np.empty(x.size)
    k = 0
    for j in range(x.size):
        while k < knots.size - 2 and x[j] >= knots[k + 1]:
            k += 1
        piece[j], share[j] = k, (x[j] - knots[k]) / (knots[k + 1] - knots[k])
    return piece, share


@njit(cache=True, nogil=True, error_model="numpy")
def normal_equations(
    piece: I64, share: F64, y: F64, residuals: F64, gate: float, limit: float, n: int
) -> tuple[F64, F64]:
    """Normal equations of the values at n knots: matrix (n, n) and right side (n,).

    Args:
        piece, share: (m,) see `places_of`.
        residuals: (m,) those beyond `gate` have no weight, those beyond `limit` less than 1.
    """
    before, after, both = np.zeros(n - 1), np.zeros(n - 1), np.zeros(n - 1)
    left, right = np.zeros(n), np.zeros(n)
    for j in range(y.size):
        size = abs(residuals[j])
        weight = min(1.0, limit / max(size, 1e-9)) if size <= gate else 0.0
        k, s = piece[j], share[j]
        u = 1.0 - s
        before[k] += weight * (u * u)
        after[k] += weight * (s * s)
        both[k] += weight * s * u
        left[k] += weight * u * y[j]
        right[k + 1] += weight * s * y[j]
    matrix = np.zeros((n, n))
    for k in range(n - 1):
        matrix[k, k] += before[k]
        matrix[k + 1, k + 1] = after[k]
        matrix[k, k + 1] = matrix[k + 1, k] = both[k]
    return matrix, left + right


@njit(cache=True, nogil=True, error_model="numpy")
def residuals_at(piece: I64, share: F64, y: F64, values: F64) -> F64:
    """y less the line at every pulse."""
    result = np.empty(y.size)
    for j in range(y.size):
        low, high = values[piece[j]], values[piece[j] + 1]
        result[j] = y[j] - (low + share[j] * (high - low))
    return result


@njit(cache=True, nogil=True, error_model="numpy")
def robust_values(
    piece: I64,
    share: F64,
    y: F64,
    line: F64,
    values: F64,
    floor: float,
    gate: float,
    huber: float,
    until: float,
) -> tuple[F64, F64, NDArray[np.bool_]]:
    """Huber's M-estimate of the values at knots, by weights again and again, 20 times at the most.

    Args:
        piece, share: (m,) see `places_of`.
        line, values: (m,) and (k,) the line to begin with, at the pulses and at the knots.
        floor: the least robust sigma, 1.4826 times the median of the sizes of the residuals.
        gate, huber: pulses beyond so many sigma have no weight, beyond so many less than 1.
        until: the estimate is there once it moves by less, in sigma.

    Returns:
        the values; the residuals; and which of them lay within the gate.
    """
    k = values.size
    residuals = y - line
    inside = np.ones(y.size, np.bool_)
    diagonal, right = np.empty(k), np.empty(k)
    off_diagonal = np.empty(k - 1)
    for _ in range(20):
        sizes = np.abs(residuals)
        sigma = max(1.4826 * median(sizes), floor)
        diagonal[:], right[:], off_diagonal[:] = 0.0, 0.0, 0.0
        for j in range(y.size):
            inside[j] = sizes[j] <= gate * sigma
            if inside[j]:
                weight = min(1.0, huber * sigma / max(sizes[j], 1e-9))
                p, after = piece[j], weight * share[j]
                before = weight - after
                diagonal[p] += before * (1.0 - share[j])
                diagonal[p + 1] += after * share[j]
                off_diagonal[p] += before * share[j]
                right[p] += before * y[j]
                right[p + 1] += after * y[j]
        # a piece with a single pulse in it hangs on its neighbours
        held = 1e-12 * diagonal.sum() / k
        for a in range(k):
            diagonal[a] += held
        # the matrix is symmetric and tridiagonal
        for a in range(1, k):
            share_of = off_diagonal[a - 1] / diagonal[a - 1]
            diagonal[a] -= share_of * off_diagonal[a - 1]
            right[a] -= share_of * right[a - 1]
        new = np.empty(k)
        new[k - 1] = right[k - 1] / diagonal[k - 1]
        for a in range(k - 2, -1, -1):
            new[a] = (right[a] - off_diagonal[a] * new[a + 1]) / diagonal[a]
        moved = np.abs(new - values).max()
        values = new
        residuals = residuals_at(piece, share, y, values)
        if moved < until * sigma:
            break
    return values, residuals, inside


@njit(cache=True, nogil=True, error_model="numpy")
def changes(
    x: F64,
    piece: I64,
    share: F64,
    residuals: F64,
    gate: float,
    limit: float,
    clip: float,
    inverse: F64,
    every: int,
    apart: int,
) -> tuple[float, int, float, float, float, float, float, float, int]:
    """Test the residuals of a line with knots for a change of its slope, and for a step.

    Each is tried at pulse after pulse, in addition to the line's own freedom: what is left of
    it then, times the residuals, has a standard deviation that chance explains.

    Args:
        x: (n,) from 0 to 1, rising.
        piece, share: (n,) see `places_of`.
        residuals: (n,) those beyond `gate` have no weight, those beyond `limit` less than 1.
        clip: at the ends residuals count as they are up to this, for there each says much.
        inverse: (k, k) of the matrix of `normal_equations`, with the same weights.
        every: pulses from one that is tried to the next, but near the ends.
        apart: pulses between a change of slope and the next knot at the least.

    Returns:
        the largest change of slope over its standard deviation for residuals of size 1, and its
        pulse; the same of a step, and its size; the same of steps among the first and the last
        32 pulses, which leave out 3 pulses or more; and of the mean of 3 to 8 pulses at an end,
        with the first pulse behind that step.
    """
    n, k = x.size, inverse.shape[0]
    used = total = 0
    all_weights = all_clipped = clipped = 0.0
    in_piece = np.zeros(k - 1, np.int64)
    # what the line would take away of the residuals with these weights
    taken = np.zeros(k)
    for j in range(n):
        size = abs(residuals[j])
        if size <= gate:
            total += 1
            in_piece[piece[j]] += 1
            weight = min(1.0, limit / max(size, 1e-9))
            weighted = weight * residuals[j]
            all_weights += weight
            all_clipped += min(max(residuals[j], -clip), clip)
            taken[piece[j]] += weighted * (1.0 - share[j])
            taken[piece[j] + 1] += weighted * share[j]
    taken = inverse @ taken
    flat, rising = np.zeros(k), np.zeros(k)
    sum_0 = sum_1 = sum_2 = rest_0 = rest_1 = 0.0
    knot = step = step_size = end = end_size = 0.0
    tail = tail_size = 0.0
    at = tail_at = used_in_piece = 0
    for j in range(n - 1, -1, -1):
        size = abs(residuals[j])
        if size > gate:
            continue
        weight, t, p = min(1.0, limit / max(size, 1e-9)), x[j], piece[j]
        before, after = weight * (1.0 - share[j]), weight * share[j]
        flat[p] += before
        flat[p + 1] += after
        rising[p] += before * t
        rising[p + 1] += after * t
        sum_0 += weight
        sum_1 += weight * t
        sum_2 += weight * t * t
        rest_0 += weight * residuals[j]
        rest_1 += weight * residuals[j] * t
        clipped += min(max(residuals[j], -clip), clip)
        used += 1
        used_in_piece = used_in_piece + 1 if j < n - 1 and piece[j + 1] == p else 1
        edge = min(used, total - used)
        whole = j % every == 0
        if edge < 3 or (not whole and edge > 32):
            continue
        left, rest = sum_0, rest_0
        for a in range(p, k):
            rest -= flat[a] * taken[a]
            for b in range(p, k):
                left -= flat[a] * inverse[a, b] * flat[b]
        if left > 0.5:
            high = abs(rest) / np.sqrt(left)
            if high > step:
                step, step_size = high, rest / left
            if edge <= 32 and high > end:
                end, end_size = high, rest / left
            if edge <= 8:
                at_end = used == edge
                # the line has taken the rest of a step at an end
                retained = edge * left / (sum_0 if at_end else all_weights - sum_0)
                mean = clipped if at_end else clipped - all_clipped
                high = abs(mean) / np.sqrt(retained)
                if high > tail:
                    tail, tail_size, tail_at = high, mean / retained, j
        if not whole or used_in_piece < apart or in_piece[p] - used_in_piece < apart:
            continue
        left, rest = sum_2 - 2.0 * t * sum_1 + t * t * sum_0, rest_1 - t * rest_0
        for a in range(p, k):
            one = rising[a] - t * flat[a]
            rest -= one * taken[a]
            for b in range(p, k):
                left -= one * inverse[a, b] * (rising[b] - t * flat[b])
        if left > 1e-9:
            high = abs(rest) / np.sqrt(left)
            if high > knot:
                knot, at = high, j
    return knot, at, step, step_size, end, end_size, tail, tail_size, tail_at


@njit(cache=True, nogil=True, error_model="numpy")
def largest_sizes(draws: F64, root: F64) -> F64:
    """Return the largest absolute element of each of (m, k) draws times a lower triangle.

    Draws that are stored column by column are the quickest.
    """
    result, value = np.zeros(draws.shape[0]), np.empty(draws.shape[0])
    for a in range(root.shape[0]):
        value[:] = 0.0
        for b in range(a + 1):
            by = root[a, b]
            for j in range(value.size):
                value[j] += by * draws[j, b]
        for j in range(value.size):
            result[j] = max(result[j], abs(value[j]))
    return result


@njit(cache=True, nogil=True, error_model="numpy")
def most_off(width: int, fits: I64, low: I64, high: I64, at_ends: bool) -> int:
    """Of windows of `width` reference pulses: how many are off the line while the device has some.

    Args:
        fits: (n + 1,) pulses on the line before each.
        low, high: (n,) the device's first pulse near each, and the one behind the last.
        at_ends: only the first window and the last one.
    """
    most = 0
    final = low.size - width
    for first in range(0, final + 1, max(final, 1) if at_ends else 1):
        there = high[first + width - 1] - low[first]
        # a device that reports few pulses lost some: no doubt about its clock. Where it reports
        # far too many, noise hides what the clock does
        if there <= 1.5 * width:
            most = max(most, min(width, there) - (fits[first + width] - fits[first]))
    return most


@njit(cache=True, nogil=True, error_model="numpy")
def best_shift(there: NDArray[np.int8], at: I64, most: int) -> tuple[int, int]:
    """Of pulses up to one, or behind one: how many more have a partner some ticks away, at most.

    Args:
        there: (n,) whether the other train has a pulse on each tick.
        at: (m,) ticks of the pulses, rising, from `most` to n - 1 - `most`.
        most: the largest shift that is tried, either way, ticks.

    Returns:
        the shift, and by how many more pulses it explains that part than none does; of equally good
        ones the first, from -`most` on.
    """
    best, found = 0, 0
    for shift in range(-most, most + 1):
        if shift == 0:
            continue
        more = least = 0
        high = 0
        for j in range(at.size):
            more += int(there[at[j] + shift]) - int(there[at[j]])
            high = max(high, more)
            least = min(least, more)
        high = max(high, more - least)
        if high > best:
            best, found = high, shift
    return found, best
