"""Events of markers that move in front of an event camera, without drawing a single frame.

A pixel of such a camera fires when its log intensity has changed by its threshold. For a disc
with a known edge that happens when the disc's rim is at a known distance, so the times are roots
of a quadratic: exact to well under a microsecond, where frames at 1 kHz give half a millisecond
(v2e, Hu, Liu and Delbruck 2021), and a hundred times cheaper. Only pixels near a rim are looked at.

Discs must not come so near to each other that their edges overlap.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rigs.scene.edges import reset_pixels, trace
from rigs.scene.randomness import generator

F64 = npt.NDArray[np.float64]
I64 = npt.NDArray[np.int64]
U16 = npt.NDArray[np.uint16]
U8 = npt.NDArray[np.uint8]
Events = tuple[I64, U16, U16, U8]
"""True time in ns, column, row, polarity; each of shape (n,)."""

NOISE_BIN_NS = 1_000_000_000


@dataclass(frozen=True)
class EventOptics:
    """The camera and what it sees; fields as in `rigs.mock.settings.EventCamera`."""

    width: int = 640
    height: int = 480
    px_per_mm: float = 14.0
    shift_mm_per_n: float = 4.5
    growth_mm_per_n: float = 0.4
    radius_mm: float = 1.2
    edge_px: float = 0.8
    contrast: float = 2.08
    threshold: float = 0.2
    threshold_sigma: float = 0.03
    refractory_us: float = 500.0
    noise_hz: float = 0.01
    leak_share: float = 0.5
    block_steps: int = 32
    chord_px: float = 0.005


class MarkerSensor:
    """The pixels' state, and the markers of n papillae in the image."""

    def __init__(self, optics: EventOptics, layout_mm: F64, seed: int) -> None:
        self.optics = optics
        self._layout_mm = layout_mm
        shape = (optics.height, optics.width)
        spread = np.clip(generator(seed, "thresholds").standard_normal(shape), -3.0, 3.0)
        threshold = optics.threshold + optics.threshold_sigma * spread
        self.threshold: F64 = np.maximum(threshold, 0.1 * optics.threshold)
        self._lowest = float(self.threshold.min())
        # rim distances (px, outwards positive) of the next event of either sign, and of the last
        self._next_on, self._next_off, self._last = np.empty((3, *shape))
        self._level = np.empty(shape)
        self._fired_ns = np.empty(shape)
        self._trial = 0
        self._bin: tuple[int, Events] | None = None

    def path(self, loads: F64) -> F64:
        """Markers in the image: column, row and radius in px, (m, n, 3).

        A papilla is dragged along by friction, which is opposite to its force on the plate.

        Args:
            loads: tangential force on the plate x, y and normal force, N, (m, 3 n).
        """
        optics, force = self.optics, loads.reshape(len(loads), -1, 3)
        moved = self._layout_mm - optics.shift_mm_per_n * force[:, :, :2]
        path = np.empty(force.shape)
        path[:, :, 0] = 0.5 * (optics.width - 1) + optics.px_per_mm * moved[:, :, 0]
        path[:, :, 1] = 0.5 * (optics.height - 1) - optics.px_per_mm * moved[:, :, 1]
        grown = optics.radius_mm + optics.growth_mm_per_n * force[:, :, 2]
        path[:, :, 2] = optics.px_per_mm * grown
        return path

    def reset(self, load: F64, seed: int) -> None:
        """Every pixel takes the image under `load`, (3 n,), as its reference; `seed`: noise."""
        optics = self.optics
        self._trial, self._bin = seed, None
        reset_pixels(
            self.path(load[None])[0], optics.contrast, optics.edge_px, self.threshold,
            self._next_on, self._next_off, self._last, self._level, self._fired_ns,
        )  # fmt: skip

    def sense(self, loads: F64, first_step: int, step_ns: int) -> Events:
        """Events between the first and the last row of `loads`, in order of time.

        Steps are joined to chords inside blocks of the global grid, so that the result does not
        depend on how a trial is cut into calls.

        Args:
            loads: as in `path`; row k belongs to the step `first_step + k`.
        """
        optics, last_step = self.optics, first_step + len(loads) - 1
        noise = self._noise(first_step * step_ns, last_step * step_ns)
        return trace(
            self.path(loads), first_step, step_ns, optics.block_steps, optics.chord_px,
            optics.contrast, optics.edge_px, optics.refractory_us * 1e3,
            self.threshold, self._lowest,
            self._next_on, self._next_off, self._last, self._level, self._fired_ns, *noise,
        )  # fmt: skip

    def _noise(self, begin_ns: int, end_ns: int) -> Events:
        """Noise of a span of true time, cut from whole bins that belong to the trial's seed."""
        parts = []
        for index in range(begin_ns // NOISE_BIN_NS, -(-end_ns // NOISE_BIN_NS)):
            if self._bin is None or self._bin[0] != index:
                self._bin = (index, self._noise_bin(index))
            events = self._bin[1]
            low, high = np.searchsorted(events[0], [begin_ns, end_ns])
            parts.append(tuple(column[low:high] for column in events))
        t_ns, x, y, p = (
            (np.concatenate(columns) for columns in zip(*parts, strict=True)) if parts else _none()
        )
        return t_ns, x, y, p

    def _noise_bin(self, index: int) -> Events:
        optics = self.optics
        rng = generator(self._trial, "event noise", index)
        mean = optics.noise_hz * optics.width * optics.height * (NOISE_BIN_NS * 1e-9)
        n = int(rng.poisson(mean))
        t_ns = np.sort(rng.integers(0, NOISE_BIN_NS, n)) + index * NOISE_BIN_NS
        x = rng.integers(0, optics.width, n, np.uint16)
        y = rng.integers(0, optics.height, n, np.uint16)
        positive = rng.random(n) < 0.5 * (1.0 + optics.leak_share)
        return t_ns, x, y, positive.astype(np.uint8)


def _none() -> Events:
    empty = np.empty(0, np.uint16)
    return np.empty(0, np.int64), empty, empty, np.empty(0, np.uint8)
