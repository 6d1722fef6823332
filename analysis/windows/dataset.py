"""Samples of labelled recordings: windows selected by the 50/50/50 rule and binned."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from sliplab.analysis.windows.samples import choose_windows, consecutive_windows, strided_windows
from sliplab.analysis.windows.sparse import SparseWindows
from sliplab.analysis.windows.windows import list_events
from sliplab.protocols.windows import SampleSettings, Windows
from sliplab.storage.schema.label import TrialLabel
from sliplab.storage.trials.array_file import Arrays, map_arrays, write_arrays
from sliplab.storage.trials.hdf5_writer import STREAM_GROUP
from sliplab.storage.trials.recording import Recording

VERSION = 1


class TrialId(NamedTuple):
    """A trial of a store; campaigns may have trials of the same id."""

    campaign: str
    trial: str


@dataclass(frozen=True)
class SampleSet:
    """Samples of some trials.

    Attributes:
        windows: event counts (n, steps, channels, cells, cells), sparse.
        y: int64 (n,), classes 0 no slip, 1 incipient, 2 gross; or those of `span_starts`.
        trial: int64 (n,), each sample's trial by its index in `trials`.
        start_ns: int64 (n,), start of each window on its trial's time line.
        trials: the trials, each once; one may have no samples.
    """

    windows: SparseWindows
    y: npt.NDArray[np.int64]
    trial: npt.NDArray[np.int64]
    start_ns: npt.NDArray[np.int64]
    trials: tuple[TrialId, ...]

    def __len__(self) -> int:
        return len(self.y)

    @property
    def x(self) -> npt.NDArray[np.uint8]:
        """The counts, dense: 12 kB a sample of the paper's, rebuilt at each call."""
        return self.windows.dense()

    @staticmethod
    def join(parts: list[SampleSet], windows: Windows) -> SampleSet:
        """The samples of all parts in order; works for none."""
        shape = (windows.steps, windows.channels, windows.cells, windows.cells)
        none = np.empty(0, np.int64)
        index: dict[TrialId, int] = {}
        trial = [none]
        for part in parts:
            there = [index.setdefault(name, len(index)) for name in part.trials]
            trial.append(np.array(there, np.int64)[part.trial])
        return SampleSet(
            SparseWindows.join([part.windows for part in parts], shape),
            np.concatenate([none, *(part.y for part in parts)]),
            np.concatenate(trial),
            np.concatenate([none, *(part.start_ns for part in parts)]),
            tuple(index),
        )

    def save(self, path: Path) -> None:
        """Into one file, whole or not at all; `load` maps it into memory."""
        windows = self.windows
        arrays: Arrays = {
            "shape": np.array(windows.shape, np.int64),
            "offsets": windows.offsets,
            "cell": windows.cell,
            "count": windows.count,
            "y": self.y,
            "trial": self.trial,
            "start_ns": self.start_ns,
            "trials": np.array(self.trials, np.str_).reshape(-1, 2),
        }
        write_arrays(path, arrays)

    @staticmethod
    def load(path: Path) -> SampleSet:
        """Open the file that `save` wrote; pages are read when they are used.

        Raises:
            OSError: it does not exist, or it cannot be read.
            ValueError: it is no such file, or truncated.
        """
        arrays = map_arrays(path)
        try:
            shape = tuple(arrays["shape"].tolist())
            windows = SparseWindows(shape, arrays["offsets"], arrays["cell"], arrays["count"])
            trials = tuple(TrialId(*names) for names in arrays["trials"].tolist())
            return SampleSet(windows, arrays["y"], arrays["trial"], arrays["start_ns"], trials)
        except KeyError as error:
            raise ValueError(f"{path}: holds no samples: {error} is missing") from error


def cut_windows(
    recording: Recording, starts_ns: npt.NDArray[np.int64], windows: Windows
) -> SparseWindows:
    """Windows that begin at times of the trial's time line.

    The starts are mapped to the camera's microseconds; the events stay as they were recorded.
    """
    events = recording.events()
    starts_us = np.asarray(recording.clock("events").to_device(starts_ns)) // 1000
    width, height = recording.event_px
    return list_events(events, starts_us, windows, width, height, crop_centre_px(recording))


def crop_centre_px(recording: Recording) -> tuple[float, float] | None:
    """Column and row at which the event camera saw the skin's centre; None where not calibrated."""
    return recording.record.geometry.event_centre_px


def recorded_span(recording: Recording) -> tuple[int, int]:
    """Start and end of the recording on its time line, ns."""
    origin = recording.record.imported
    if origin is not None and origin.span_ns is not None:
        return origin.span_ns
    recorded = [step for step in recording.record.steps if step.recorded]
    if origin is not None and not recorded:
        return _span_of_rows(recording)
    clock = recording.clock("arm")
    return clock.to_reference(recorded[0].start_ns), clock.to_reference(recorded[-1].end_ns)


def _span_of_rows(recording: Recording) -> tuple[int, int]:
    """Return first and last time of what an imported trial holds, of its events if it has any."""
    record = recording.record
    if record.counts.events:
        with recording.open() as reader:
            first, last = (int(t) * 1000 for t in reader.event_times()[[0, -1]])
        line = recording.clock("events").to_reference
        return int(line(first)), int(line(last))
    ends: list[int] = []
    if record.counts.frames:
        times = recording.frame_times()
        ends += [int(times[0]), int(times[-1])]
    if record.counts.poses:
        with recording.open() as reader:
            poses = reader.poses().t_ns[[0, -1]]
        ends += map(int, recording.clock("arm").to_reference(poses))
    for name, about in record.streams.items():
        if about.rows and not about.of_camera:
            with recording.open() as reader:
                rows = reader.column(f"{STREAM_GROUP}/{name}/t")[[0, -1]]
            ends += map(int, recording.clock(name).to_reference(rows))
    return (min(ends), max(ends)) if ends else (0, 0)


def sample_starts(
    recording: Recording,
    label: TrialLabel,
    windows: Windows,
    samples: SampleSettings,
    seed: int,
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Start of each window that is a sample, ns, and its class, both (n,); see `trial_samples`."""
    chosen = choose_windows(
        *recorded_span(recording),
        label.incipient_ns,
        label.gross_ns,
        windows.length_ms * 1_000_000,
        samples.per_class,
        seed,
        samples.no_slip,
    )
    starts = np.concatenate([chosen[key] for key in sorted(chosen)])
    classes = np.concatenate([np.full(len(chosen[key]), key, np.int64) for key in sorted(chosen)])
    return starts, classes


def span_starts(
    label: TrialLabel, windows: Windows, most: int, classes: tuple[str, ...], seed: int
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Start of each window that is a sample, ns, and its class, of a label with classes of parts.

    Windows lie one after the other in each part. Of a class that has more than `most` of them so
    many are drawn.

    Args:
        classes: names of the classes, whose places are the samples' classes.
        seed: of the draw (PCG64).
    """
    length_ns = windows.length_ms * 1_000_000
    starts: list[npt.NDArray[np.int64]] = [np.empty(0, np.int64)]
    rng = np.random.Generator(np.random.PCG64(seed))
    for name in classes:
        there = [
            consecutive_windows(span.start_ns, span.end_ns, length_ns)
            for span in label.spans
            if span.name == name
        ]
        found = np.concatenate([starts[0], *there])
        if len(found) > most:
            found = np.sort(rng.choice(found, most, replace=False))
        starts.append(found)
    return np.concatenate(starts), np.repeat(np.arange(len(classes)), [*map(len, starts[1:])])


def trial_samples(
    recording: Recording,
    label: TrialLabel,
    trial: TrialId,
    windows: Windows,
    samples: SampleSettings,
    seed: int,
    classes: tuple[str, ...] = (),
) -> SampleSet:
    """The samples of one trial by the paper's rule, or those of classes.

    Args:
        label: the trial's, for its onsets or the classes of its parts.
        trial: what the samples carry.
        seed: of the random windows within incipient slip, or of a class.
        classes: names of the classes where these are not slip's; see `span_starts`.
    """
    if classes:
        starts, y = span_starts(label, windows, samples.per_class, classes, seed)
    else:
        starts, y = sample_starts(recording, label, windows, samples, seed)
    trials = np.zeros(len(starts), np.int64)
    return SampleSet(cut_windows(recording, starts, windows), y, trials, starts, (trial,))


def run_starts(
    recording: Recording, windows: Windows, stride_ms: int | None
) -> npt.NDArray[np.int64]:
    """Start of each window in which slip is detected, ns, (n,).

    Args:
        stride_ms: from one to the next; None for a window's length.
    """
    length_ns = windows.length_ms * 1_000_000
    stride_ns = (stride_ms or windows.length_ms) * 1_000_000
    return strided_windows(*recorded_span(recording), length_ns, stride_ns)


def trial_windows(
    recording: Recording, windows: Windows, stride_ms: int | None = None
) -> tuple[SparseWindows, npt.NDArray[np.int64]]:
    """Samples of the windows of `run_starts`, and the end of each on the time line, ns."""
    starts = run_starts(recording, windows, stride_ms)
    return cut_windows(recording, starts, windows), starts + windows.length_ms * 1_000_000
