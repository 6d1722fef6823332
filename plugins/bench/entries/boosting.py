"""Gradient boosting on the events of each cell and of each step of a window, as an entry."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from threadpoolctl import threadpool_limits

from sliplab.analysis.detectors.detector import Cost, Scene
from sliplab.analysis.networks.baselines import features, fitted_trees
from sliplab.analysis.windows.sparse import SparseWindows
from sliplab.plugins.bench.windowed import Classifier, samples
from sliplab.protocols.windows import Windows

LEAST = 1e-9
"""Least probability, whose logarithm is finite."""
ROUNDS = 40


class Boosting(Classifier):
    """scikit-learn's gradient boosting, trained on the first tip's sliding."""

    def __init__(self) -> None:
        super().__init__(Windows(), 10)

    def train(self, scenes: Sequence[Scene], validation: Sequence[Scene]) -> None:
        """See `Detector`."""
        train, val = (samples(part, self.windows) for part in (scenes, validation))
        self._model = fitted_trees(train, val, ROUNDS)

    def votes(self, x: SparseWindows) -> npt.NDArray[np.floating]:
        """See `Classifier`."""
        with threadpool_limits(1):
            return np.log(self._model.predict_proba(features(x)) + LEAST)

    def cost(self) -> Cost:
        """Return comparisons of a window, and the size of the trees' nodes."""
        trees = [tree for row in self._model._predictors for tree in row]
        deepest = sum(tree.get_max_depth() for tree in trees)
        return Cost(deepest, sum(tree.nodes.nbytes for tree in trees))
