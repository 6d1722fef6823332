"""Spike counts of every window of a trial: kept beside the labels, the detection reads them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy.typing as npt

from sliplab.analysis.networks import model_file, training
from sliplab.analysis.windows import dataset
from sliplab.flows.running.parallel_map import TrialWork, keep_trials, stale_trials
from sliplab.protocols.settings import Windows
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import Store

if TYPE_CHECKING:
    from sliplab.flows.running.cluster import Cluster

COUNTS = "counts"
VERSION = 1


@dataclass(frozen=True)
class _Counting:
    """What spike counts depend on besides the trial.

    Attributes:
        threads: of the network; None for as many as there are cores.
    """

    model: bytes
    windows: Windows
    threads: int | None


def count_spikes(
    store: Store,
    model: Path,
    windows: Windows,
    trials: Sequence[tuple[str, Recording, str]],
    cluster: Cluster | None = None,
) -> int:
    """Run a network over all consecutive windows of every trial that needs it. Stands in a flow.

    In this process, where the network uses all cores; or on a cluster.

    Args:
        trials: campaign, recording and the key that its counts must have.

    Returns:
        how many trials were counted.
    """
    counting = _Counting(model.read_bytes(), windows, None if cluster is None else 1)
    wanted = [TrialWork(recording, name, key, counting) for name, recording, key in trials]
    work = stale_trials(store, COUNTS, wanted)
    if work:
        keep_trials(store, COUNTS, "evaluate", work, _count, cluster, processes=False)
    return len(work)


def _count(
    recording: Recording, counting: _Counting
) -> tuple[dict[str, Any], dict[str, npt.NDArray[Any]]]:
    """Spike counts of all windows of a trial."""
    if counting.threads is not None:
        training.limit_threads(counting.threads)
    x, end_ns = dataset.trial_windows(recording, counting.windows)
    counts = training.predict_counts(_fitted(counting.model), x)
    return {}, {"counts": counts, "end_ns": end_ns}


@lru_cache(maxsize=2)
def _fitted(model: bytes) -> training.Fitted:
    return model_file.parse(model, "the model")
