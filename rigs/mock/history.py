"""Rows of a simulated state, one a step of the global grid, kept as long as somebody needs them."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

F64 = npt.NDArray[np.float64]


class History:
    """A growing table whose first row belongs to step `base`."""

    def __init__(self, width: int, base: int) -> None:
        self.base = base
        self._length = 0
        self._rows = np.empty((1024, width))

    @property
    def end(self) -> int:
        """The step after the last row."""
        return self.base + self._length

    def grow(self, n: int) -> F64:
        """Room for `n` more rows, to be filled at once by the caller, shape (n, width)."""
        if self._length + n > len(self._rows):
            larger = np.empty((max(2 * len(self._rows), self._length + n), self._rows.shape[1]))
            larger[: self._length] = self._rows[: self._length]
            self._rows = larger
        self._length += n
        return self._rows[self._length - n : self._length]

    def shrink(self, n: int) -> None:
        """Take back the last `n` rows of room."""
        self._length -= n

    def rows(self, first: int, last: int) -> F64:
        """Rows of the steps from `first` up to and without `last`, a view.

        Raises:
            IndexError: a row is not there.
        """
        if not self.base <= first <= last <= self.end:
            raise IndexError(f"steps {first} to {last} of a history from {self.base} to {self.end}")
        return self._rows[first - self.base : last - self.base]

    def forget(self, before: int) -> None:
        """Drop the rows of steps before `before`."""
        drop = min(max(before - self.base, 0), self._length)
        if drop > len(self._rows) // 2 or drop == self._length:
            kept = self._length - drop
            self._rows[:kept] = self._rows[drop : self._length].copy()
            self._length, self.base = kept, self.base + drop
