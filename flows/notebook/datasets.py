"""A store's windows as data sets of other libraries."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from sliplab.analysis.metrics.classification import CLASSES
from sliplab.analysis.windows.dataset import cut_windows, recorded_span
from sliplab.analysis.windows.sparse import SparseWindows
from sliplab.analysis.windows.window_table import whole_ns
from sliplab.protocols.errors import InputError
from sliplab.protocols.shown import one_of, plural
from sliplab.protocols.windows import Windows
from sliplab.storage.errors import NoTrial
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import TrialStore

if TYPE_CHECKING:
    import pandas as pd

I64 = npt.NDArray[np.int64]


def labelled(windows: pd.DataFrame) -> pd.DataFrame:
    """Return the windows that have a class, numbered anew."""
    return windows[windows["label"].notna()].reset_index(drop=True)


def classes_of(windows: pd.DataFrame) -> I64:
    """Return the class of each window, (n,); -1 where it has none."""
    number = {name: k for k, name in enumerate(CLASSES)}
    return windows["label"].map(number).fillna(-1).to_numpy(np.int64)


def _by_trial(
    store: TrialStore, windows: pd.DataFrame, length_ns: int
) -> dict[tuple[str, str], tuple[Recording, I64]]:
    """Return each trial's recording, and its rows in `windows`.

    Raises:
        InputError: with all faults: a column that is missing, a time or a label that is none, an
            end that is of another length, a trial that the store lacks, a window outside of the
            recording.
    """
    faults = [
        InputError("windows", name, None, "is missing; `Store.windows` makes the table")
        for name in ("campaign", "trial", "start_ns", "label")
        if name not in windows.columns
    ]
    if faults:
        raise InputError.joined(faults)
    label, (starts, whole) = windows["label"], whole_ns(windows["start_ns"])
    for name, good, right in (
        ("start_ns", whole, "must be whole nanoseconds"),
        ("label", (label.isna() | label.isin(CLASSES)).to_numpy(), one_of("", (*CLASSES, "None"))),
    ):
        if not good.all():
            row = int(np.flatnonzero(~good)[0])
            text = f"{right}; not so in {plural(int((~good).sum()), 'row')}"
            faults.append(InputError("windows", f"{name}[{row}]", windows[name].iloc[row], text))
    if "end_ns" in windows.columns:
        ends, whole_ends = whole_ns(windows["end_ns"])
        wrong = whole & ~(whole_ends & (ends == starts + length_ns))
        if wrong.any():
            row = int(np.flatnonzero(wrong)[0])
            text = (
                f"must be {starts[row] + length_ns}: windows of the store have "
                f"{length_ns / 1e6:g} ms; not so in {plural(int(wrong.sum()), 'row')}"
            )
            faults.append(
                InputError("windows", f"end_ns[{row}]", windows["end_ns"].iloc[row], text)
            )
    found = {}
    for (campaign, trial), rows in windows.groupby(
        ["campaign", "trial"], sort=False, dropna=False
    ).indices.items():
        try:
            recording = store.holder(trial, campaign).recording(trial)
        except NoTrial as error:
            faults.append(InputError("windows", f"trial[{rows[0]}]", trial, error.expected))
            continue
        found[campaign, trial] = recording, np.asarray(rows)
        begin, end = recorded_span(recording)
        outside = (starts[rows] <= begin - length_ns) | (starts[rows] >= end)
        outside &= whole[rows]
        if outside.any():
            row = rows[outside.argmax()]
            text = f"lies outside of the recording of {trial}, from {begin} to {end} ns"
            faults.append(InputError("windows", f"start_ns[{row}]", int(starts[row]), text))
    if faults:
        raise InputError.joined(faults)
    return found


def event_counts(store: TrialStore, windows: pd.DataFrame, shape: Windows) -> SparseWindows:
    """Return the event counts of windows, in the table's order.

    Args:
        shape: crop, cells, steps and length of a window.
    """
    parts, places = [], [np.empty(0, np.int64)]
    for recording, rows in _by_trial(store, windows, shape.length_ms * 1_000_000).values():
        starts = whole_ns(windows["start_ns"])[0][rows]
        order = np.argsort(starts, kind="stable")
        parts.append(cut_windows(recording, starts[order], shape))
        places.append(rows[order])
    whole = SparseWindows.join(parts, (shape.steps, shape.channels, shape.cells, shape.cells))
    return whole.take(np.argsort(np.concatenate(places), kind="stable"))


class EventDataset:
    """The events of windows, as tonic's data sets give them: ``(events, class)``.

    Events are a structured array of ``x``, ``y``, ``t`` (microseconds from the window's start) and
    ``p``; the class is -1 where a window has none.

    Attributes:
        windows: the table, a row for each item.
        sensor_size: columns, rows, polarities. ordering: names of the fields of an event.
        classes: names of the classes.
    """

    dtype = np.dtype([("x", np.int16), ("y", np.int16), ("t", np.int64), ("p", np.int8)])
    ordering = ("x", "y", "t", "p")
    classes = CLASSES

    def __init__(
        self,
        store: TrialStore,
        windows: pd.DataFrame,
        length_ns: int,
        transform: Callable[[Any], Any] | None = None,
        target_transform: Callable[[Any], Any] | None = None,
    ) -> None:
        self.windows, self._length_ns = windows, length_ns
        self.transform, self.target_transform = transform, target_transform
        trials = _by_trial(store, windows, length_ns)
        self._recordings = {key: recording for key, (recording, _) in trials.items()}
        sizes = {recording.event_px for recording in self._recordings.values()}
        if len(sizes) > 1:
            text = "must be of one camera; theirs have " + ", ".join(map(str, sorted(sizes)))
            raise InputError("windows", "", None, text)
        self.sensor_size = (*(sizes.pop() if sizes else (0, 0)), 2)
        self._targets = classes_of(windows)

    def __len__(self) -> int:
        return len(self.windows)

    def __getitem__(self, index: int) -> tuple[Any, Any]:
        row = self.windows.iloc[index]
        recording = self._recordings[row["campaign"], row["trial"]]
        start = int(row["start_ns"])
        found = recording.events(start, start + self._length_ns)
        times = np.asarray(recording.clock("events").to_reference(found.t_us * 1000))
        events = np.empty(len(found.t_us), self.dtype)
        events["x"], events["y"], events["p"] = found.x, found.y, found.p
        events["t"] = (times - start) // 1000
        target: Any = int(self._targets[index])
        return (
            events if self.transform is None else self.transform(events),
            target if self.target_transform is None else self.target_transform(target),
        )
