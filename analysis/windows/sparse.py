"""Windows as lists of their non-empty cells: two hundred numbers instead of twelve thousand.

A millisecond holds few events, so a sample of (30, 1, 20, 20) counts is 98 % zeros. Samples for
training and for live detection are therefore stored and read as the cells that are not empty, in
the order of steps; a campaign's training set is 20 times smaller, and the event-driven network
(`analysis.networks.spiking`) never looks at a zero.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from sliplab.storage.kernels import njit

U8 = npt.NDArray[np.uint8]
I64 = npt.NDArray[np.int64]


@dataclass(frozen=True)
class SparseWindows:
    """Samples of one shape.

    Attributes:
        shape: steps, channels, rows, columns of a sample.
        offsets: int64 (n * steps + 1,); step t of sample i holds the entries from
            ``offsets[i * steps + t]`` to ``offsets[i * steps + t + 1]``.
        cell: uint32, place of each entry in (channels, rows, columns), ascending within a step.
        count: uint8, its events, at least 1.
    """

    shape: tuple[int, int, int, int]
    offsets: I64
    cell: npt.NDArray[np.uint32]
    count: U8

    def __len__(self) -> int:
        return (len(self.offsets) - 1) // self.shape[0]

    @staticmethod
    def of(x: npt.NDArray[Any]) -> SparseWindows:
        """Make it of counts (n, steps, channels, rows, columns), uint8.

        Raises:
            ValueError: not five axes, or not uint8.
        """
        if x.ndim != 5 or x.dtype != np.uint8:
            raise ValueError(f"samples are {x.dtype} {x.shape}; expected uint8 (n, T, C, H, W)")
        n, steps = x.shape[:2]
        flat = np.ascontiguousarray(x).reshape(n * steps, math.prod(x.shape[2:]))
        offsets = np.zeros(n * steps + 1, np.int64)
        _count(flat, offsets)
        cell = np.empty(offsets[-1], np.uint32)
        count = np.empty(offsets[-1], np.uint8)
        _list(flat, offsets, cell, count)
        return SparseWindows((steps, *x.shape[2:]), offsets, cell, count)

    def dense(self) -> U8:
        """Counts uint8 (n, steps, channels, rows, columns)."""
        steps, *plane = self.shape
        flat = np.zeros((len(self) * steps, math.prod(plane)), np.uint8)
        where = np.repeat(np.arange(len(flat)), np.diff(self.offsets))
        flat[where, self.cell] = self.count
        return flat.reshape(len(self), *self.shape)

    def take(self, rows: npt.NDArray[np.integer[Any]]) -> SparseWindows:
        """Some of the samples, in this order."""
        return self._taken(np.asarray(rows, np.int64), self.shape[0])

    def first_steps(self, steps: int) -> SparseWindows:
        """The same samples, each cut off after its first steps.

        Raises:
            ValueError: they have fewer.
        """
        if not 1 <= steps <= self.shape[0]:
            raise ValueError(f"{steps} of {self.shape[0]} steps")
        return self._taken(np.arange(len(self)), steps)

    def _taken(self, rows: I64, retained: int) -> SparseWindows:
        steps = self.shape[0]
        sizes = np.diff(self.offsets).reshape(-1, steps)[rows, :retained].ravel()
        offsets = np.concatenate([[0], sizes.cumsum()]).astype(np.int64)
        begin = self.offsets[:-1].reshape(-1, steps)[rows, :retained].ravel()
        entries = np.arange(offsets[-1]) + np.repeat(begin - offsets[:-1], sizes)
        shape = (retained, *self.shape[1:])
        return SparseWindows(shape, offsets, self.cell[entries], self.count[entries])

    def mirrored(self, how: npt.NDArray[np.integer[Any]]) -> SparseWindows:
        """Each sample as it is (0), its columns (1), its rows (2) or both (3) in reverse order.

        Args:
            how: (n,), 0 to 3.

        Raises:
            ValueError: another number of samples, or no such mirror.
        """
        if how.shape != (len(self),) or (len(how) and not 0 <= how.min() <= how.max() <= 3):
            raise ValueError(f"{how.shape} mirrors of 0 to 3 for {len(self)} samples")
        steps, *plane = self.shape
        cells = np.arange(math.prod(plane), dtype=np.uint32).reshape(plane)
        places = np.stack([cells, cells[:, :, ::-1], cells[:, ::-1], cells[:, ::-1, ::-1]]).reshape(
            4, -1
        )
        cell, count = self.cell.copy(), self.count.copy()
        _mirror(how.astype(np.uint8), places, self.offsets, steps, cell, count)
        return SparseWindows(self.shape, self.offsets, cell, count)

    @staticmethod
    def join(parts: list[SparseWindows], shape: tuple[int, int, int, int]) -> SparseWindows:
        """All parts' samples in order; works for none."""
        ends = np.cumsum([0] + [len(part.cell) for part in parts])
        offsets = [part.offsets[1:] + end for part, end in zip(parts, ends[:-1], strict=True)]
        return SparseWindows(
            shape,
            np.concatenate([np.zeros(1, np.int64), *offsets]),
            np.concatenate([np.empty(0, np.uint32), *(part.cell for part in parts)]),
            np.concatenate([np.empty(0, np.uint8), *(part.count for part in parts)]),
        )

    @property
    def totals(self) -> I64:
        """Events of each sample, int64 (n,)."""
        running = np.concatenate([[0], self.count.cumsum(dtype=np.int64)])
        return np.diff(running[self.offsets[:: self.shape[0]]])


@njit(cache=True, nogil=True)
def _count(flat: Any, offsets: Any) -> None:
    for i in range(flat.shape[0]):
        n = 0
        for j in range(flat.shape[1]):
            n += flat[i, j] != 0
        offsets[i + 1] = offsets[i] + n


@njit(cache=True, nogil=True)
def _list(flat: Any, offsets: Any, cell: Any, count: Any) -> None:
    for i in range(flat.shape[0]):
        at = offsets[i]
        if offsets[i + 1] == at:
            continue
        for j in range(flat.shape[1]):
            if flat[i, j] != 0:
                cell[at] = j
                count[at] = flat[i, j]
                at += 1


@njit(cache=True, nogil=True)
def _mirror(how: Any, places: Any, offsets: Any, steps: Any, cell: Any, count: Any) -> None:
    """Entries of a step are put in order again by insertion: there are some ten of them."""
    for i in range(how.size):
        if how[i] == 0:
            continue
        place = places[how[i]]
        for t in range(i * steps, (i + 1) * steps):
            low = offsets[t]
            for k in range(low, offsets[t + 1]):
                new, many = place[cell[k]], count[k]
                j = k
                while j > low and cell[j - 1] > new:
                    cell[j], count[j] = cell[j - 1], count[j - 1]
                    j -= 1
                cell[j], count[j] = new, many
