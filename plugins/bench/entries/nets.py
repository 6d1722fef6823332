"""Conventional networks as entries: a convolutional one on the window's frame, and a GRU."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from sliplab.analysis.detectors.detector import Cost, Scene
from sliplab.analysis.networks.baseline_nets import fitted_net, net_votes
from sliplab.analysis.windows.sparse import SparseWindows
from sliplab.plugins.bench.windowed import Classifier, samples
from sliplab.protocols.windows import Windows

WEIGHT_BYTES = 4
EPOCHS = 6


class Net(Classifier):
    """A network of `networks.baseline_nets`.

    Args:
        kind: its name there.
        by_paper: trained on the 2-pixel onset and not on the first tip's sliding.
    """

    def __init__(self, kind: str, *, by_paper: bool = False) -> None:
        super().__init__(Windows(), 10)
        self._kind, self._by_paper = kind, by_paper

    def train(self, scenes: Sequence[Scene], validation: Sequence[Scene]) -> None:
        """See `Detector`."""
        train, val = (
            samples(part, self.windows, by_paper=self._by_paper) for part in (scenes, validation)
        )
        self._net, self._facts = fitted_net(self._kind, train, val, EPOCHS)

    def votes(self, x: SparseWindows) -> npt.NDArray[np.floating]:
        """See `Classifier`."""
        return net_votes(self._net, x)

    def cost(self) -> Cost:
        """Return multiply-adds of a window, and the size of float32 weights."""
        return Cost(self._facts["multiply_adds"], self._facts["weights"] * WEIGHT_BYTES)


class Cnn(Net):
    """Two convolutions on the events of each cell over the whole window."""

    def __init__(self) -> None:
        super().__init__("cnn_frame")


class CnnByPaperOnset(Net):
    """`Cnn`, trained on the 2-pixel onset."""

    def __init__(self) -> None:
        super().__init__("cnn_frame", by_paper=True)


class Gru(Net):
    """A gated recurrent unit over the window's steps."""

    def __init__(self) -> None:
        super().__init__("gru")
