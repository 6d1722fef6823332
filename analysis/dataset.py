"""From labelled recordings to samples: windows chosen by the 50/50/50 rule and binned."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from analysis.samples import choose_windows, consecutive_windows
from analysis.windows import bin_events
from protocols.settings import Samples, Windows
from storage.recording import Recording

VERSION = 1


@dataclass(frozen=True)
class SampleSet:
    """Samples of some trials.

    Attributes:
        x: uint8 (n, steps, channels, cells, cells), event counts.
        y: int64 (n,), classes 0 no slip, 1 incipient, 2 gross.
        trial: int64 (n,), index of the trial each sample came from.
        start_ns: int64 (n,), start of each window on its trial's time line.
    """

    x: npt.NDArray[np.uint8]
    y: npt.NDArray[np.int64]
    trial: npt.NDArray[np.int64]
    start_ns: npt.NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.y)

    @staticmethod
    def join(parts: list[SampleSet], windows: Windows) -> SampleSet:
        """The samples of all parts in order; works for none."""
        if not parts:
            shape = (0, windows.steps, windows.channels, windows.cells, windows.cells)
            none = np.empty(0, np.int64)
            return SampleSet(np.empty(shape, np.uint8), none, none, none)
        return SampleSet(
            np.concatenate([part.x for part in parts]),
            np.concatenate([part.y for part in parts]),
            np.concatenate([part.trial for part in parts]),
            np.concatenate([part.start_ns for part in parts]),
        )


def bin_recording(
    recording: Recording, starts_ns: npt.NDArray[np.int64], windows: Windows
) -> npt.NDArray[np.uint8]:
    """Windows that begin at times of the trial's time line, binned.

    The starts are mapped to the camera's microseconds; the events stay as they were recorded.
    """
    events = recording.events()
    starts_us = np.asarray(recording.clock("events").to_device(starts_ns)) // 1000
    width, height = recording.record["geometry"]["event_px"]
    return bin_events(
        events.x, events.y, events.p, events.t_us, starts_us, windows, width, height,
        crop_centre_px(recording),
    )  # fmt: skip


def crop_centre_px(recording: Recording) -> tuple[float, float] | None:
    """Where the event camera saw the skin's centre, column and row; None where nobody looked."""
    centre = recording.record["geometry"].get("event_centre_px")
    return None if centre is None else (float(centre[0]), float(centre[1]))


def recorded_span(recording: Recording) -> tuple[int, int]:
    """Start and end of the recording on its time line, ns."""
    recorded = [step for step in recording.record["steps"] if step["recorded"]]
    clock = recording.clock("arm")
    return (
        int(clock.to_reference(int(recorded[0]["start_ns"]))),
        int(clock.to_reference(int(recorded[-1]["end_ns"]))),
    )


def trial_samples(
    recording: Recording,
    label: dict[str, Any],
    number: int,
    windows: Windows,
    samples: Samples,
    seed: int,
) -> SampleSet:
    """The samples of one trial by the paper's rule.

    Args:
        label: the trial's label (`incipient_ns`, `gross_ns`).
        number: what `SampleSet.trial` says for them.
        seed: of the random windows within incipient slip.
    """
    start, end = recorded_span(recording)
    chosen = choose_windows(
        start,
        end,
        label["incipient_ns"],
        label["gross_ns"],
        windows.length_ms * 1_000_000,
        samples.per_class,
        seed,
    )
    starts = np.concatenate([chosen[key] for key in sorted(chosen)])
    classes = np.concatenate([np.full(len(chosen[key]), key, np.int64) for key in sorted(chosen)])
    return SampleSet(
        bin_recording(recording, starts, windows),
        classes,
        np.full(len(starts), number, np.int64),
        starts,
    )


def trial_windows(
    recording: Recording, windows: Windows
) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.int64]]:
    """All consecutive windows of a recording: samples, and the end of each on the time line, ns."""
    length_ns = windows.length_ms * 1_000_000
    starts = consecutive_windows(*recorded_span(recording), length_ns)
    return bin_recording(recording, starts, windows), starts + length_ns
