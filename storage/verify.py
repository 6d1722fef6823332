"""Is everything in a store what it was when it was committed? Looks, and changes nothing."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from storage.columns import TIMING, TRACKS
from storage.files import read_json, sha256
from storage.hdf5 import StreamReader
from storage.recording import Recording
from storage.store import Campaign, Store
from storage.video import count_frames
from storage.writer import CHECKSUMS, DATA, FRAMES, PROVENANCE, RECORD

_KNOWN = {DATA, FRAMES, RECORD, CHECKSUMS, PROVENANCE}


@dataclass(frozen=True)
class Problem:
    """One thing that is wrong."""

    path: str
    what: str


def verify(store: Store, on_trial: Callable[[str], None] | None = None) -> list[Problem]:
    """Check every trial of every campaign; an empty list means all is well.

    Args:
        on_trial: called with each trial's id before it is checked.
    """
    problems: list[Problem] = []
    for campaign in store.campaigns():
        for recording in campaign.recordings():
            if on_trial is not None:
                on_trial(recording.folder.name)
            problems += verify_trial(recording.folder)
        problems += _leftovers(campaign)
    return problems


def verify_trial(folder: Path) -> list[Problem]:
    """Checksums, sizes, counts and clocks of one committed trial."""
    try:
        sums = read_json(folder / CHECKSUMS)
    except (OSError, ValueError) as error:
        return [Problem(str(folder / CHECKSUMS), f"cannot be read: {error}")]
    problems = []
    for name in sorted(sums):
        path = folder / name
        if not path.exists():
            problems.append(Problem(str(path), "is missing"))
        elif path.stat().st_size != sums[name]["bytes"]:
            problems.append(
                Problem(str(path), f"has {path.stat().st_size} bytes, not {sums[name]['bytes']}")
            )
        elif sha256(path) != sums[name]["sha256"]:
            problems.append(Problem(str(path), "does not match its checksum"))
    for name in (DATA, RECORD):
        if name not in sums:
            problems.append(Problem(str(folder / name), "is not among the checksums"))
    for path in sorted(folder.iterdir()):
        if path.name not in _KNOWN:
            problems.append(Problem(str(path), "does not belong here"))
    if problems:
        return problems
    try:
        return _contents(folder)
    except (OSError, ValueError, KeyError) as error:
        return [Problem(str(folder), f"cannot be read: {error}")]


def _contents(folder: Path) -> list[Problem]:
    problems = []
    recording = Recording(folder)
    record = recording.record
    if record["trial"] != folder.name:
        problems.append(Problem(str(folder / RECORD), f"is of trial {record['trial']}"))
    with StreamReader(folder / DATA) as reader:
        counts = reader.counts()
        made = [name for name in TIMING if reader.has(name)]
        for name in ("events/t", "event_pulses/t", "sync_pulses/t", "poses/t", "frames/t", *made):
            if np.any(np.diff(reader.column(name)) < 0):
                problems.append(Problem(str(folder / DATA), f"{name} runs backwards"))
    found = {
        "events": counts["events/t"],
        "frames": counts["frames/t"],
        "poses": counts["poses/t"],
        "pulses": counts["sync_pulses/t"],
    }
    for name, count in found.items():
        if count != record["counts"][name]:
            problems.append(
                Problem(
                    str(folder / DATA), f"{count} {name}, the record says {record['counts'][name]}"
                )
            )
    problems += _frame_problems(folder, recording, counts)
    if not record["quality"]["passed"]:
        problems.append(Problem(str(folder / RECORD), "was committed although a gate failed"))
    return problems


def _frame_problems(folder: Path, recording: Recording, counts: dict[str, int]) -> list[Problem]:
    """A row of tracks, or a picture in the video, for every frame."""
    frames, problems = counts["frames/t"], []
    if recording.has_tracks:
        with recording.open() as reader:
            there = [name for name in TRACKS if reader.has(name)]
        problems += [
            Problem(str(folder / DATA), f"{counts[name]} rows of {name}, not {frames}")
            for name in there
            if counts[name] != frames
        ]
    elif frames and not recording.has_video:
        problems.append(Problem(str(folder / DATA), "has frames, but neither video nor tracks"))
    if recording.has_video and count_frames(folder / FRAMES) != frames:
        problems.append(Problem(str(folder / FRAMES), f"does not hold {frames} frames"))
    return problems


def _leftovers(campaign: Campaign) -> list[Problem]:
    folder = campaign.folder / "incoming"
    return [
        Problem(str(path), "is an unfinished trial; the next `sliplab collect` quarantines it")
        for path in (sorted(folder.iterdir()) if folder.is_dir() else [])
    ]
