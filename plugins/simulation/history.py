"""A growing table of simulated states and their times, whose oldest rows can be dropped."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from sliplab.storage.kernels import njit

F64 = npt.NDArray[np.float64]
I64 = npt.NDArray[np.int64]


_ROOM = 1 << 15
"""Initial capacity: few trials need more, and growing copies all rows. Unwritten rows take no
memory."""
_FEW = 512


class GrowingTable:
    """A growing table of rows at increasing times; add a row before reading."""

    def __init__(self, width: int) -> None:
        self._length = 0
        self._rows = np.empty((_ROOM, width))
        self._t_ns = np.empty(_ROOM, np.int64)

    @property
    def begin_ns(self) -> int:
        """Time of the first stored row."""
        return int(self._t_ns[0])

    @property
    def end_ns(self) -> int:
        """Time of the last row."""
        return int(self._t_ns[self._length - 1])

    def grow(self, t_ns: I64) -> F64:
        """Append rows at later times and return them for the caller to fill, (k, width)."""
        n = len(t_ns)
        if self._length + n > len(self._rows):
            size = max(2 * len(self._rows), self._length + n)
            rows, times = np.empty((size, self._rows.shape[1])), np.empty(size, np.int64)
            rows[: self._length] = self._rows[: self._length]
            times[: self._length] = self._t_ns[: self._length]
            self._rows, self._t_ns = rows, times
        self._t_ns[self._length : self._length + n] = t_ns
        self._length += n
        return self._rows[self._length - n : self._length]

    def shrink(self, n: int, end_ns: int) -> None:
        """Remove the last `n` rows, and set the time of the row before them to `end_ns`."""
        self._length -= n
        self._t_ns[self._length - 1] = end_ns

    def between(self, first_ns: int, last_ns: int) -> tuple[I64, F64]:
        """Return times and rows from the last row at or before `first_ns` to the first at or after
        `last_ns`, or to the end; views, (k,) and (k, width).

        Raises:
            IndexError: `first_ns` lies before the first row.
        """
        times = self._t_ns[: self._length]
        if not self._length or first_ns < times[0]:
            raise IndexError(f"the time {first_ns} ns lies before the stored history")
        first = int(np.searchsorted(times, first_ns, side="right")) - 1
        last = int(np.searchsorted(times, last_ns, side="left")) + 1
        return times[first:last], self._rows[first : min(last, self._length)]

    def at(self, t_ns: I64) -> F64:
        """Interpolate rows linearly at times; after the end the last row, (k, width).

        Args:
            t_ns: (k,), increasing.

        Raises:
            IndexError: a time lies before the first row.
        """
        if not len(t_ns):
            return np.empty((0, self._rows.shape[1]))
        times, rows = self.between(int(t_ns[0]), int(t_ns[-1]))
        if len(rows) == 1:
            return np.repeat(rows, len(t_ns), axis=0)
        result = np.empty((len(t_ns), rows.shape[1]))
        _join(times, rows, np.searchsorted(times, t_ns, side="left"), t_ns, result)
        return result

    def forget(self, before_ns: int) -> None:
        """Drop the rows that are not needed for times from `before_ns` on."""
        times = self._t_ns[: self._length]
        drop = max(int(np.searchsorted(times, before_ns, side="right")) - 1, 0)
        retained = self._length - drop
        # compact while that is cheap, so that the next reads hit the cache
        if drop > max(_FEW, retained):
            self._rows[:retained] = self._rows[drop : self._length].copy()
            self._t_ns[:retained] = times[drop:].copy()
            self._length = retained


@njit(cache=True, nogil=True, error_model="numpy")
def _join(times: I64, rows: F64, after: I64, t_ns: I64, result: F64) -> None:
    """Interpolate rows linearly at `t_ns` into `result`; `after` is the first row not before."""
    last = len(times) - 1
    for k in range(len(t_ns)):
        i = min(max(after[k], 1), last)
        share = (t_ns[k] - times[i - 1]) / float(times[i] - times[i - 1])
        share = min(max(share, 0.0), 1.0)
        for j in range(rows.shape[1]):
            result[k, j] = rows[i - 1, j] + share * (rows[i, j] - rows[i - 1, j])
