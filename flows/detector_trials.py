"""What detectors hear of a trial: spikes and events of windows at any stride, kept once made.

Consecutive windows of the trials that are scored are counted by `flows.counting`; this is for
windows that overlap, and for the trials that detectors learn from and are set by.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from analysis import dataset, model_file, training
from analysis.samples import strided_windows
from flows.trial_work import TrialWork, keep_trials, stale_trials
from protocols.settings import Windows
from storage.derived import Derived, make_key
from storage.recording import Recording
from storage.store import Store

if TYPE_CHECKING:
    from flows.cluster import Cluster

HEARD = "heard"
VERSION = 1

AT_ONCE = 1024
"""Windows that are binned at a time, so that a fine stride does not fill the memory."""


def heard_step(stride_ms: int) -> str:
    """Where results of a stride stand: those of different strides do not displace each other."""
    return f"{HEARD}_{stride_ms}ms"


@dataclass(frozen=True)
class Wanted:
    """Windows of one trial at one stride.

    Attributes:
        key: what the result must have been made with.
    """

    campaign: str
    recording: Recording
    stride_ms: int
    key: str

    @property
    def step(self) -> str:
        """Where the result stands."""
        return heard_step(self.stride_ms)


def want(
    campaign: str, recording: Recording, model_key: str, windows: Windows, stride_ms: int
) -> Wanted:
    """Windows at a stride, with the key of the model that counts them."""
    inputs = [model_key, recording.checksum, stride_ms]
    key = make_key(HEARD, VERSION, inputs, windows.model_dump(mode="json"))
    return Wanted(campaign, recording, stride_ms, key)


@dataclass(frozen=True)
class _Hearing:
    """What it depends on besides the trial; `threads` of the network, None for all."""

    model: bytes
    windows: Windows
    stride_ms: int
    threads: int | None


def hear_trials(
    store: Store,
    model: Path,
    windows: Windows,
    wanted: Sequence[Wanted],
    cluster: Cluster | None = None,
) -> int:
    """Make what is stale; stands in a flow. Returns how many trials that were."""
    content, threads = model.read_bytes(), None if cluster is None else 1
    made = 0
    for step in sorted({item.step for item in wanted}):
        work = stale_trials(
            store,
            step,
            [
                TrialWork(
                    item.recording, item.campaign, item.key,
                    _Hearing(content, windows, item.stride_ms, threads),
                )
                for item in wanted
                if item.step == step
            ],
        )  # fmt: skip
        if work:
            keep_trials(store, step, "evaluate", work, _hear, cluster, processes=False)
        made += len(work)
    return made


def heard(store: Store, wanted: Wanted) -> dict[str, npt.NDArray[Any]]:
    """``counts`` int64 (n, 3), ``events`` int64 (n,) and ``end_ns`` int64 (n,) of a trial."""
    return Derived.of(store, wanted.step, wanted.campaign).arrays(wanted.recording.folder.name)


def _hear(
    recording: Recording, hearing: _Hearing
) -> tuple[dict[str, Any], dict[str, npt.NDArray[Any]]]:
    if hearing.threads is not None:
        training.limit_threads(hearing.threads)
    fitted = _fitted(hearing.model)
    length_ns = hearing.windows.length_ms * 1_000_000
    starts = strided_windows(
        *dataset.recorded_span(recording), length_ns, hearing.stride_ms * 1_000_000
    )
    counts, events = [np.empty((0, 3), np.int64)], [np.empty(0, np.int64)]
    for first in range(0, len(starts), AT_ONCE):
        x = dataset.bin_recording(recording, starts[first : first + AT_ONCE], hearing.windows)
        counts.append(training.predict_counts(fitted, x))
        events.append(x.reshape(len(x), -1).sum(axis=1, dtype=np.int64))
    return {}, {
        "counts": np.concatenate(counts),
        "events": np.concatenate(events),
        "end_ns": starts + length_ns,
    }


@lru_cache(maxsize=2)
def _fitted(model: bytes) -> training.Fitted:
    return model_file.parse(model, "the model")
