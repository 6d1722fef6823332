"""What detectors hear of a trial: spikes and events of windows at any stride, kept once made.

Consecutive windows of the trials that are scored are counted by `flows.learning.counting`; this is
for windows that overlap, and for the trials that detectors learn from and are set by.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from sliplab.analysis.detect.carried import carried_spikes, trailing_sums
from sliplab.analysis.nets import dataset, model_file, training
from sliplab.analysis.nets.samples import strided_windows
from sliplab.flows.running.trial_work import TrialWork, keep_trials, stale_trials
from sliplab.protocols.settings import Windows
from sliplab.storage.derived import Derived, make_key
from sliplab.storage.recording import Recording
from sliplab.storage.store import Store

if TYPE_CHECKING:
    from sliplab.flows.running.cluster import Cluster

HEARD = "heard"
VERSION = 1


def heard_step(stride_ms: int, carried: bool = False) -> str:
    """Where results of a stride stand: those of different strides do not displace each other."""
    return f"{HEARD}_{'carried_' if carried else ''}{stride_ms}ms"


@dataclass(frozen=True)
class Wanted:
    """Windows of one trial at one stride.

    Attributes:
        carried: neurons keep their states from each window to the next.
        key: what the result must have been made with.
    """

    campaign: str
    recording: Recording
    stride_ms: int
    carried: bool
    key: str

    @property
    def step(self) -> str:
        """Where the result stands."""
        return heard_step(self.stride_ms, self.carried)


def want(
    campaign: str,
    recording: Recording,
    model_key: str,
    windows: Windows,
    stride_ms: int,
    carried: bool = False,
) -> Wanted:
    """Windows at a stride, with the key of the model that counts them."""
    inputs = [model_key, recording.checksum, stride_ms, carried]
    key = make_key(HEARD, VERSION, inputs, windows.model_dump(mode="json"))
    return Wanted(campaign, recording, stride_ms, carried, key)


@dataclass(frozen=True)
class _Hearing:
    """What it depends on besides the trial; `threads` of the network, None for all."""

    model: bytes
    windows: Windows
    stride_ms: int
    carried: bool
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
                    _Hearing(content, windows, item.stride_ms, item.carried, threads),
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
    return {}, _carried(recording, hearing, fitted) if hearing.carried else _reset(
        recording, hearing, fitted
    )


def _reset(
    recording: Recording, hearing: _Hearing, fitted: training.Fitted
) -> dict[str, npt.NDArray[Any]]:
    """Every window a sample of its own."""
    length_ns = hearing.windows.length_ms * 1_000_000
    starts = strided_windows(
        *dataset.recorded_span(recording), length_ns, hearing.stride_ms * 1_000_000
    )
    x = dataset.cut_windows(recording, starts, hearing.windows)
    return {
        "counts": training.predict_counts(fitted, x),
        "events": x.totals,
        "end_ns": starts + length_ns,
    }


def _carried(
    recording: Recording, hearing: _Hearing, fitted: training.Fitted
) -> dict[str, npt.NDArray[Any]]:
    """One run through the trial; windows are where one looks back."""
    windows = hearing.windows
    x, ends = dataset.trial_windows(recording, windows)
    spikes = carried_spikes(training.engine(fitted), x)
    running = np.concatenate([[0], x.count.cumsum(dtype=np.int64)])
    events = np.diff(running[x.offsets])
    length, stride = windows.steps, hearing.stride_ms // windows.step_ms
    counts = trailing_sums(spikes, length, stride)
    first = int(ends[0]) if len(ends) else 0
    return {
        "counts": counts,
        "events": trailing_sums(events[:, None], length, stride)[:, 0],
        "end_ns": first + np.arange(len(counts), dtype=np.int64) * hearing.stride_ms * 1_000_000,
    }


@lru_cache(maxsize=2)
def _fitted(model: bytes) -> training.Fitted:
    return model_file.parse(model, "the model")
