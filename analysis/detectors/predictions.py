"""Predictions that detectors read: spikes of all windows of a trial, at any stride, cached.

Spike counts are of consecutive windows of the trials that are scored, by every trained network;
predictions, which count events too, of windows that overlap and of the trials that detectors learn
from and are set by.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import numpy.typing as npt

from sliplab.analysis.detectors.stateful import stateful_spikes, trailing_sums
from sliplab.analysis.networks import model_file, training
from sliplab.analysis.networks.baselines import step_sums
from sliplab.analysis.trial_work import KeepTrials, TrialWork, stale_trials
from sliplab.analysis.windows import dataset
from sliplab.protocols.detection import Detection
from sliplab.protocols.windows import Windows
from sliplab.storage.streams import Json
from sliplab.storage.trials.derived import Arrays, Derived, make_key
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import TrialStore

COUNTS = "counts"
COUNTS_VERSION = 1


def seed_step(seed: int) -> str:
    """Name of the step that keeps spike counts of a trained network that was not chosen."""
    return f"{COUNTS}_seed{seed}"


@dataclass(frozen=True)
class _Inference:
    """Inputs of a trial's spikes besides the trial.

    Attributes:
        threads: of the network; None for as many as there are cores.
        stride_ms: of the windows; None for consecutive ones.
        stateful: neurons keep their states from each window to the next.
    """

    model: bytes
    threads: int | None
    stride_ms: int | None
    stateful: bool = False

    def network(self) -> training.Fitted:
        """Return the network, in so many threads of this process."""
        if self.threads is not None:
            training.limit_threads(self.threads)
        return _fitted(self.model)


def count_spikes(
    store: TrialStore,
    model: Path,
    trials: Sequence[tuple[str, Recording, str]],
    keep: KeepTrials,
    threads: int | None = None,
    step: str = COUNTS,
    stride_ms: int | None = None,
) -> int:
    """Run a network over all windows of every trial that needs it.

    Args:
        trials: campaign, recording and the key that its counts must have.
        keep: makes the stale ones and keeps each.
        threads: of the network; None for as many as there are cores.
        step: that keeps the counts.
        stride_ms: of the windows; None for consecutive ones.

    Returns:
        how many trials were counted.
    """
    inference = _Inference(model.read_bytes(), threads, stride_ms)
    required = [TrialWork(recording, name, key, inference) for name, recording, key in trials]
    work = stale_trials(store, step, required)
    if work:
        keep(step, work, _count)
    return len(work)


def _count(recording: Recording, inference: _Inference) -> tuple[Json, Arrays]:
    """Spike counts of all windows of a trial."""
    counts, end_ns = window_counts(recording, inference.network(), inference.stride_ms)
    return {}, {"counts": counts, "end_ns": end_ns}


def window_counts(
    recording: Recording, fitted: training.Fitted, stride_ms: int | None
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Return spikes of a trial's windows (n, 3), and where they end (n,), ns.

    Args:
        stride_ms: of the windows; None for consecutive ones.
    """
    x, end_ns = dataset.trial_windows(recording, fitted.windows, stride_ms)
    return training.predict_counts(fitted, x), end_ns


PREDICTIONS = "heard"
"""The step's name in stores and keys."""
PREDICTIONS_VERSION = 1


def predictions_step(stride_ms: int, stateful: bool = False) -> str:
    """Name of a stride's step: results of different strides do not displace each other."""
    return f"{PREDICTIONS}_{'carried_' if stateful else ''}{stride_ms}ms"


@dataclass(frozen=True)
class PredictionRequest:
    """Inference on the windows of one trial at one stride.

    Attributes:
        stateful: neurons keep their states from each window to the next.
        key: of the inputs; a stored result with another key is stale.
    """

    campaign: str
    recording: Recording
    stride_ms: int
    stateful: bool
    key: str

    @property
    def step(self) -> str:
        """Name of the step that keeps the result."""
        return predictions_step(self.stride_ms, self.stateful)


def prediction_request(
    campaign: str,
    recording: Recording,
    model_key: str,
    windows: Windows,
    stride_ms: int,
    stateful: bool = False,
) -> PredictionRequest:
    """Windows at a stride, with the key of the model that counts them."""
    inputs = [model_key, recording.checksum, stride_ms, stateful]
    key = make_key(PREDICTIONS, PREDICTIONS_VERSION, inputs, windows.model_dump(mode="json"))
    return PredictionRequest(campaign, recording, stride_ms, stateful, key)


def predict_trials(
    store: TrialStore,
    model: Path,
    requests: Sequence[PredictionRequest],
    keep: KeepTrials,
    threads: int | None = None,
) -> int:
    """Run inference for stale trials; return the number of them.

    Args:
        keep, threads: as for `count_spikes`.
    """
    content, made = model.read_bytes(), 0
    for step in sorted({item.step for item in requests}):
        work = stale_trials(
            store,
            step,
            [
                TrialWork(
                    item.recording,
                    item.campaign,
                    item.key,
                    _Inference(content, threads, item.stride_ms, item.stateful),
                )
                for item in requests
                if item.step == step
            ],
        )
        if work:
            keep(step, work, _infer)
        made += len(work)
    return made


def predictions(store: TrialStore, request: PredictionRequest) -> Arrays:
    """Return ``counts`` int64 (n, 3), ``events`` int64 (n,) and ``end_ns`` int64 (n,)."""
    return Derived.of(store, request.step, request.campaign).arrays(request.recording.folder.name)


def _infer(recording: Recording, inference: _Inference) -> tuple[Json, Arrays]:
    """Spikes and events of all windows of a trial."""
    fitted, stride_ms = inference.network(), inference.stride_ms
    if inference.stateful and stride_ms is not None:
        return {}, _stateful(recording, fitted, stride_ms)
    x, end_ns = dataset.trial_windows(recording, fitted.windows, stride_ms)
    return {}, {
        "counts": training.predict_counts(fitted, x),
        "events": x.totals,
        "end_ns": end_ns,
    }


def _stateful(recording: Recording, fitted: training.Fitted, stride_ms: int) -> Arrays:
    """Run inference once through the trial; windows are trailing sums of its spikes."""
    windows = fitted.windows
    x, ends = dataset.trial_windows(recording, windows)
    spikes = stateful_spikes(fitted.engine, x)
    length, stride = windows.steps, stride_ms // windows.step_ms
    counts = trailing_sums(spikes, length, stride)
    first = int(ends[0]) if len(ends) else 0
    return {
        "counts": counts,
        "events": trailing_sums(step_sums(x).reshape(-1, 1), length, stride)[:, 0],
        "end_ns": first + np.arange(len(counts), dtype=np.int64) * stride_ms * 1_000_000,
    }


@lru_cache(maxsize=2)
def _fitted(model: bytes) -> training.Fitted:
    fitted = model_file.parse(model, "the model")
    fitted.check_slip("the model", "detection")
    return fitted


def trial_counts(store: TrialStore, campaign: str, trial_id: str, settings: Detection) -> Arrays:
    """``counts`` int64 (n, 3) and ``end_ns`` int64 (n,) of a scored trial, at its stride."""
    step = COUNTS if settings.stride_ms is None else predictions_step(settings.stride_ms)
    return Derived.of(store, step, campaign).arrays(trial_id)
