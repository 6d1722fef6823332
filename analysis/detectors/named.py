"""A detector by its name, trained and at its level, so that it can run on a stream."""

from __future__ import annotations

from pathlib import Path

from sliplab.analysis.detectors.at_level import AtLevel
from sliplab.analysis.detectors.detector import Detector
from sliplab.analysis.detectors.registry import make_detector
from sliplab.analysis.detectors.stored_scenes import fitted_to
from sliplab.storage.trials.store import TrialStore


def named_detector(
    name: str, level: float | None, store: Path | None, promise: float | None = None
) -> AtLevel:
    """Return a detector.

    Args:
        level: that its evidence must exceed; None: validation trials of `store` set it.
        store: whose trials train it; None where it needs no training, and the level is given.
        promise: false alarms an hour, at most, at which they set the level.

    Raises:
        InputError: there is none of the name.
        StoreError: see `fitted_to`.
        DetectorError: it cannot be trained.
    """
    made = make_detector(name)
    try:
        if level is not None and not needs_training(made):
            return AtLevel(made, level)
        assert store is not None, "the request was checked"
        fitted = fitted_to(TrialStore(store), made, promise if level is None else None)
        return fitted if level is None else AtLevel(made, level)
    except BaseException:
        made.close()
        raise


def needs_training(detector: Detector) -> bool:
    """Return whether a detector's class trains it."""
    return type(detector).train is not Detector.train
