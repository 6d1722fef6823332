"""Gradient boosting on counts: what a strong method without any idea of space or time reaches.

Histogram-based gradient boosted trees (scikit-learn) take each cell's events and each step's events
as columns of a table. Where the network is no better than that, its convolutions and spikes add
nothing to accuracy.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from threadpoolctl import threadpool_limits

from sliplab.analysis.metrics.classification import CLASSES
from sliplab.analysis.networks.baselines import cell_sums, step_sums
from sliplab.analysis.windows.dataset import SampleSet
from sliplab.analysis.windows.sparse import SparseWindows

ROUNDS = 100
"""Of boosting, at most; each grows a tree a class."""

PATIENCE = 10
"""Rounds without a better validation loss before it ends."""

_SEED = 0


def features(x: SparseWindows) -> npt.NDArray[np.float32]:
    """Events of each cell and of each step, float32 (n, cells + steps)."""
    return np.concatenate([cell_sums(x), step_sums(x)], axis=1).astype(np.float32)


def boosted(
    train: SampleSet, validation: SampleSet, test: SparseWindows, rounds: int = ROUNDS
) -> tuple[npt.NDArray[np.float64], dict[str, Any]]:
    """Fit on training samples, stop by validation samples, vote on test samples.

    Returns:
        probabilities (n, 3), and what was fitted in words and numbers.

    Raises:
        ValueError: a class is missing among the training samples.
    """
    from sklearn.ensemble import HistGradientBoostingClassifier  # takes a second

    if set(np.unique(train.y).tolist()) != set(range(len(CLASSES))):
        raise ValueError("gradient boosting needs training samples of every class")
    model = HistGradientBoostingClassifier(
        max_iter=rounds,
        early_stopping=True,
        n_iter_no_change=PATIENCE,
        random_state=_SEED,
    )
    # in one thread: its threads wait for each other busily, 30 times slower beside other work
    with threadpool_limits(1):
        model.fit(
            features(train.windows),
            train.y,
            X_val=features(validation.windows),
            y_val=validation.y,
        )
        votes = model.predict_proba(features(test)) if len(test) else np.empty((0, len(CLASSES)))
    return votes, {"rounds": int(model.n_iter_), "most_rounds": rounds, "patience": PATIENCE}
