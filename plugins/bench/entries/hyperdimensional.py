"""Hyperdimensional computing as an entry: three binary prototypes of 1024 bits, 384 bytes.

A window is a vector of bits: for each patch of cells the exclusive or of the patch's random vector
and its level's, whose majority is taken (Kanerva 2009). Levels are counts in steps of two; vectors
of neighbouring levels differ in few bits. Random vectors are drawn from a seed and take no memory
where they are drawn again. A prototype is the majority of its class's windows, and is corrected
by those that are nearer to another one (Imani et al. 2017).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from sliplab.analysis.detectors.detector import Cost, Scene
from sliplab.analysis.metrics.classification import CLASSES
from sliplab.analysis.networks.baselines import cell_sums
from sliplab.analysis.windows.sparse import SparseWindows
from sliplab.plugins.bench.windowed import Classifier, samples
from sliplab.protocols.windows import Windows

BITS = 1024
PATCHES, LEVELS = 5, 10
SEED = 20_260
ROUNDS = 10
SCALE = 32.0
"""Bits of distance for one unit of log odds."""
Bits = npt.NDArray[np.int8]
"""Bits as -1 and 1."""


class Hyperdimensional(Classifier):
    """Binary prototypes of the classes; the nearest by Hamming distance wins."""

    def __init__(self) -> None:
        super().__init__(Windows(), 10)
        rng = np.random.default_rng(SEED)
        places = rng.integers(0, 2, (PATCHES**2, BITS), np.int8) * 2 - 1
        levels = np.tile(rng.integers(0, 2, BITS, np.int8) * 2 - 1, (LEVELS, 1))
        order = rng.permutation(BITS)
        for level in range(1, LEVELS):
            levels[level:, order[(level - 1) * BITS // LEVELS : level * BITS // LEVELS]] *= -1
        # a majority of an odd number is never a tie
        self._bound: Bits = places[:, None] * levels[None]

    def train(self, scenes: Sequence[Scene], validation: Sequence[Scene]) -> None:
        """See `Detector`."""
        train = samples(scenes, self.windows)
        bits = self.encoded(train.windows).astype(np.int32)
        sums = np.stack([bits[train.y == k].sum(axis=0) for k in range(len(CLASSES))])
        rng = np.random.default_rng(SEED)
        for _ in range(ROUNDS):
            for rows in np.array_split(rng.permutation(len(bits)), max(len(bits) // 64, 1)):
                near = (bits[rows] @ _signs(sums).T.astype(np.int32)).argmax(axis=1)
                wrong = rows[near != train.y[rows]]
                np.add.at(sums, train.y[wrong], bits[wrong])
                np.subtract.at(sums, near[near != train.y[rows]], bits[wrong])
        self._prototypes = _signs(sums)

    def votes(self, x: SparseWindows) -> npt.NDArray[np.floating]:
        """See `Classifier`."""
        # the product of signs is the length less twice the Hamming distance
        return self.encoded(x).astype(np.float32) @ self._prototypes.T.astype(np.float32) / SCALE

    def encoded(self, x: SparseWindows) -> Bits:
        """Return the vector of each window, (n, bits)."""
        side = self.windows.cells // PATCHES
        counts = cell_sums(x).reshape(-1, PATCHES, side, PATCHES, side).sum(axis=(2, 4))
        level = np.minimum(np.log2(1 + counts).astype(np.int64), LEVELS - 1)
        level = level.reshape(len(x), PATCHES**2)
        total = np.zeros((len(x), BITS), np.int16)
        for patch in range(PATCHES**2):
            total += self._bound[patch][level[:, patch]]
        return _signs(total)

    def cost(self) -> Cost:
        """Return bit operations of a window, and the size of the prototypes."""
        return Cost((PATCHES**2 + len(CLASSES)) * BITS, len(CLASSES) * BITS // 8)


def _signs(sums: npt.NDArray[np.integer]) -> Bits:
    return np.where(sums > 0, 1, -1).astype(np.int8)
