"""Verification that everything in a store is as committed.

Nothing is changed but a file that another program left open for writing: it is closed.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sliplab.protocols.errors import InputError
from sliplab.protocols.shown import plural
from sliplab.protocols.yaml_file import parse_yaml
from sliplab.storage.errors import StoreError, own_fault
from sliplab.storage.files import is_temporary, read_json, temporary_files
from sliplab.storage.process import named
from sliplab.storage.schema.document import NewerFormat
from sliplab.storage.schema.trial import Provenance, TrialRecord
from sliplab.storage.streams import CLOCK, EVENTS_KIND
from sliplab.storage.trials.checksums import (
    CHECKSUMS,
    DATA,
    ELSEWHERE,
    FRAMES,
    PROVENANCE,
    RECORD,
    STREAM_FILE,
    Checksums,
    is_stream_file,
    read_sums,
    stream_file,
    to_fetch,
)
from sliplab.storage.trials.hdf5_reader import StreamReader
from sliplab.storage.trials.hdf5_writer import COLUMNS, INDEX, STREAM_GROUP, TIMING, TRACKS
from sliplab.storage.trials.lock import STORE_LOCK, current_holder
from sliplab.storage.trials.registration import registration_files, registration_problems
from sliplab.storage.trials.store import (
    CAUSE,
    IMPORTED,
    INFO,
    PROTOCOL,
    REGISTRATIONS,
    RIG,
    Campaign,
    TrialStore,
    known_cause,
)
from sliplab.storage.trials.superblock import left_open
from sliplab.storage.trials.video import count_frames

_KNOWN = {DATA, FRAMES, RECORD, CHECKSUMS, PROVENANCE, ELSEWHERE}
_FOLDERS = ("trials", "incoming", "quarantine", "bench")
DAMAGED, UNFINISHED, RECORDING = "damaged", "unfinished", "recording"


@dataclass(frozen=True)
class StoreProblem:
    """One thing that is wrong, or not finished.

    Attributes:
        path: the file or folder.
        what: its fault.
        kind: ``damaged``; ``unfinished`` for what a killed program left, which the next collection
            clears up; or ``recording`` for a trial that a running program writes. Only the first
            is a fault.
        campaign: its campaign; empty for the store's own files.
        trial: the committed trial that it belongs to; empty for any other file.
    """

    path: str
    what: str
    kind: str = DAMAGED
    campaign: str = ""
    trial: str = ""


def verify(
    store: TrialStore,
    on_trial: Callable[[str], None] | None = None,
    on_mended: Callable[[Path], None] | None = None,
) -> list[StoreProblem]:
    """Check every trial of every campaign; all is well where no problem is ``damaged``.

    A collection may run meanwhile.

    Args:
        on_trial: called with each trial's id before it is checked.
        on_mended: called with each data file that another program had left open for writing, and
            that is as it was committed again.
    """
    problems = _temporary(store.folder, "")
    derived = store.folder / "derived"
    for folder in (derived, *(store.folder / name for name in ("models", "report", "control"))):
        problems += _temporary(folder, "")
    folder = store.folder / "campaigns"
    for path in sorted(folder.iterdir()) if folder.is_dir() else []:
        if path.is_symlink() or not path.is_dir():
            problems.append(StoreProblem(str(path), "is not a campaign folder"))
        else:
            problems += _campaign(store, Campaign(path), on_trial, on_mended)
    return problems


def _campaign(
    store: TrialStore,
    campaign: Campaign,
    on_trial: Callable[[str], None] | None,
    on_mended: Callable[[Path], None] | None,
) -> list[StoreProblem]:
    problems = _description(store, campaign)
    if problems and current_holder(store.folder / STORE_LOCK) is not None:
        problems = _description(store, campaign)  # it may have been written meanwhile
    for trial in trial_folders(campaign):
        if on_trial is not None:
            on_trial(trial.name)
        were_open = [path for path in trial.glob("*.h5") if left_open(path)]
        problems += verify_trial(trial) + _temporary(trial, campaign.name, _next(campaign))
        if on_mended is not None:
            for path in were_open:
                if not left_open(path):
                    on_mended(path)
    return problems + _leftovers(store, campaign)


def trial_folders(campaign: Campaign) -> list[Path]:
    """Return everything that is among the committed trials, complete or not."""
    folder = campaign.folder / "trials"
    return sorted(folder.iterdir()) if folder.is_dir() else []


def imported_trials(store: TrialStore) -> Iterator[tuple[str, TrialRecord]]:
    """Yield the records of imported and recorded trials, with ``campaign/trial``.

    They may be intact, but not all that was recorded, or be used by no later step. Trials that
    cannot be read are left out.
    """
    for campaign in store.campaigns():
        names: list[str] = []
        with suppress(StoreError, ValueError):
            names = sorted(campaign.committed()) if IMPORTED in campaign.info else []
        for name in names:
            with suppress(StoreError):
                yield f"{campaign.name}/{name}", campaign.recording(name).record


def verify_trial(folder: Path) -> list[StoreProblem]:
    """Check checksums, sizes, counts and clocks of one committed trial."""
    name, found = folder.parent.parent.name, _trial(folder)
    if not os.path.lexists(folder):
        return []  # a running program moved it to quarantine meanwhile
    if known_cause(folder) is not None:
        what = "is to be moved to quarantine; the next `sliplab collect` does it"
        return [StoreProblem(str(folder), what, UNFINISHED, name)]
    return [StoreProblem(str(path), what, DAMAGED, name, folder.name) for path, what in found]


Found = list[tuple[Path, str]]


def _trial(folder: Path) -> Found:
    if folder.is_symlink() or not folder.is_dir():
        return [(folder, "is not a trial folder")]
    try:
        sums = read_sums(folder)
    except ValueError as error:
        return [(folder / CHECKSUMS, f"cannot be used: {error}")]
    found = [
        (folder / name, problem)
        for name in sorted(sums)
        if not to_fetch(folder / name)
        and (problem := sums[name].problem(folder / name)) is not None
    ]
    found += [
        (path, "does not belong here")
        for path in sorted(folder.iterdir())
        if not _belongs(path.name, sums) and not is_temporary(path.name)
    ]
    try:
        Provenance.load(folder / PROVENANCE)
    except (OSError, ValueError) as error:
        if own_fault(error):
            raise
        found.append((folder / PROVENANCE, f"cannot be read: {error}"))
    if found or any(to_fetch(folder / name) for name in sums):
        return found
    try:
        return _contents(folder)
    except (OSError, ValueError, KeyError, TypeError, RuntimeError) as error:
        if own_fault(error):
            raise
        return [(folder, f"cannot be read: {error}")]


def _belongs(name: str, sums: Checksums) -> bool:
    """Return whether a file of this name may be in a trial's folder."""
    if name == FRAMES or is_stream_file(name):
        return name in sums
    return name in _KNOWN


def _description(store: TrialStore, campaign: Campaign) -> list[StoreProblem]:
    """Check the campaign's own files."""

    def problem(path: Path, what: str, kind: str = DAMAGED) -> StoreProblem:
        return StoreProblem(str(path), what, kind, campaign.name)

    folder, found = campaign.folder, []
    if not campaign.begun:
        if registration_files(campaign):  # before its first trial
            return _registered(campaign)
        return [problem(folder, "is a campaign without any trial yet", UNFINISHED)]
    for name in _FOLDERS:
        if (folder / name).is_symlink() or not (folder / name).is_dir():
            found.append(problem(folder / name, "is missing or not a folder"))
    names = (PROTOCOL, RIG, INFO)
    sums: Checksums = {}
    if store.format > 1 and not (folder / CHECKSUMS).exists():
        what = f"is missing; {_next(campaign)} writes it"
        found.append(problem(folder / CHECKSUMS, what, UNFINISHED))
    elif store.format > 1:
        try:
            sums = read_sums(folder, names)
        except ValueError as error:
            found.append(problem(folder / CHECKSUMS, f"cannot be used: {error}"))
    for name in names:
        path = folder / name
        try:
            if name == INFO:
                _ = campaign.info
            else:
                parse_yaml(path.read_text("utf-8"), path)
        except (OSError, ValueError, StoreError, InputError) as error:
            found.append(problem(path, f"cannot be read: {error}"))
            continue
        if name in sums and (wrong := sums[name].problem(path)) is not None:
            found.append(problem(path, f"{wrong}; `sliplab collect` writes it again"))
    found += _registered(campaign)
    return found + [
        StoreProblem(item.path, item.what, item.kind, campaign.name)
        for place in (folder, folder / "bench")
        for item in _temporary(place, campaign.name, _next(campaign))
    ]


def _registered(campaign: Campaign) -> list[StoreProblem]:
    """Check a campaign's registrations."""
    found = [
        StoreProblem(str(path), what, DAMAGED, campaign.name)
        for path, what in registration_problems(campaign)
    ]
    return found + _temporary(campaign.folder / REGISTRATIONS, campaign.name)


def _temporary(
    folder: Path, campaign: str, by: str = "the next `sliplab collect`"
) -> list[StoreProblem]:
    """Find temporary files of ended programs.

    Args:
        by: what deletes them.
    """
    what = f"was left by a killed program; {by} deletes it"
    return [
        StoreProblem(str(path), what, UNFINISHED, campaign)
        for path, runs in temporary_files(folder)
        if not runs
    ]


def _contents(folder: Path) -> Found:
    try:
        record = TrialRecord.load(folder / RECORD)
    except NewerFormat as error:
        return [(folder / RECORD, f"was written by a newer version (format {error.format})")]
    if record.trial != folder.name:
        return [(folder / RECORD, f"is of trial {record.trial}")]
    return content_problems(folder, record)


def content_problems(folder: Path, record: TrialRecord) -> Found:
    """Return what does not fit a trial's record in its files, or runs backwards, by file."""
    problems: Found = []
    with StreamReader(folder / DATA) as reader:
        counts = reader.counts()
        made = [name for name in TIMING if reader.has(name)]
        tracks = [name for name in TRACKS if reader.has(name)]
        for name in ("events/t", "event_pulses/t", "sync_pulses/t", "poses/t", "frames/t", *made):
            if runs_backwards(reader, name):
                problems.append((folder / DATA, f"{name} runs backwards"))
        problems += _data_problems(folder / DATA, reader, counts, record.geometry.event_px)
        problems += _stream_problems(folder, reader, record)
    problems += _camera_problems(folder, record)
    found = {
        "events": counts["events/t"],
        "frames": counts["frames/t"],
        "poses": counts["poses/t"],
        "pulses": counts["sync_pulses/t"],
    }
    for name, count in found.items():
        given = getattr(record.counts, name)
        if count != given:
            problems.append((folder / DATA, f"{count} {name}, the record says {given}"))
    problems += _frame_problems(folder / DATA, folder / FRAMES, tracks, counts)
    if not record.quality.passed and record.imported is None:
        problems.append((folder / RECORD, "was committed although a gate failed"))
    return problems


def _data_problems(
    path: Path, reader: StreamReader, counts: dict[str, int], size_px: tuple[int, int] | None
) -> Found:
    """Check that columns of a group have equal lengths, that events are in the camera, and that the
    index leads to the first event at or after each millisecond."""
    problems: Found = []
    groups: dict[str, dict[str, int]] = {}
    for name in {*COLUMNS, *TIMING}:
        group, _, part = name.partition("/")
        groups.setdefault(group, {})[part] = counts[name]
    for group, lengths in sorted(groups.items()):
        if len(set(lengths.values())) > 1:
            problems.append((path, f"{group} has columns of different lengths: {lengths}"))
    for name, most in zip("xy", size_px or (), strict=False):
        parts = reader.column_parts(f"events/{name}")
        last = max((int(part.max()) for part in parts), default=0)
        if counts["events/t"] and last >= most:
            problems.append((path, f"events/{name} has {last}, the camera has {most} px"))
    if not leads_to_events(reader):
        problems.append((path, f"{INDEX} does not lead to the events"))
    return problems


def runs_backwards(reader: StreamReader, name: str) -> bool:
    """Return whether a column of times falls anywhere."""
    return next(falls(reader, name), None) is not None


def falls(reader: StreamReader, name: str) -> Iterator[int]:
    """Yield the rows at which a column of times falls; one part at a time is in memory."""
    last, begin = None, 0
    for part in reader.column_parts(name):
        before = np.concatenate([part[:1] if last is None else last, part[:-1]])
        yield from (begin + np.flatnonzero(part < before)).tolist()
        last, begin = part[-1:], begin + len(part)


def leads_to_events(reader: StreamReader) -> bool:
    """Return whether the index has the first event at or after each millisecond."""
    marks = reader.column(INDEX)
    after = np.arange(len(marks)) * 1000
    done = before = 0  # milliseconds that were looked at; events of earlier parts
    for times in reader.column_parts("events/t"):
        end = done + int(np.searchsorted(after[done:], times[-1], "right"))
        if not np.array_equal(marks[done:end], before + np.searchsorted(times, after[done:end])):
            return False
        done, before = end, before + len(times)
    return bool(np.all(marks[done:] == before))


def _stream_problems(folder: Path, reader: StreamReader, record: TrialRecord) -> Found:
    """Check the named streams: those that the record counts, whole, and in order of time."""
    kinds, counts = reader.streams(), reader.stream_counts()
    stated = {name: given for name, given in record.streams.items() if not given.of_camera}
    problems: Found = []
    for name in sorted(kinds.keys() | stated.keys()):
        path = f"{STREAM_GROUP}/{name}"
        given = stated.get(name)
        if given is not None and given.rows == 0 and name not in kinds:
            continue  # nothing came, and nothing is stored
        if given is None or name not in kinds:
            where = "the record" if given is None else "the file"
            problems.append((folder / DATA, f"{path} is not in {where}"))
            continue
        if kinds[name] != given.kind:
            what = f"{path} is of kind '{kinds[name]}', the record says '{given.kind}'"
            problems.append((folder / DATA, what))
            continue
        problems += [
            (
                folder / DATA,
                f"{plural(count, 'row')} of {path}/{part}, the record says {given.rows}",
            )
            for part, count in counts[name].items()
            if count != given.rows
        ]
        # readings of a clock, and rows without a map, have the times that the device gave
        as_given = given.kind == CLOCK.name or name in record.clocks.refused
        if not as_given and runs_backwards(reader, f"{path}/t"):
            problems.append((folder / DATA, f"{path}/t runs backwards"))
    return problems


def _camera_problems(folder: Path, record: TrialRecord) -> Found:
    """Check the streams of further cameras: those that the record counts, in order of time."""
    stated = {name for name, given in record.streams.items() if given.of_camera}
    found = {
        match["stream"] for path in folder.iterdir() if (match := STREAM_FILE.fullmatch(path.name))
    }
    problems: Found = [
        (folder / stream_file(name), "is of a stream that is not in the record")
        for name in sorted(found - stated)
    ]
    for name in sorted(stated):
        data, video = folder / stream_file(name), folder / stream_file(name, "mkv")
        given = record.streams[name]
        if not data.is_file():
            problems.append((data, "is missing, the record has its stream"))
            continue
        with StreamReader(data) as reader:
            counts = reader.counts()
            tracks = [track for track in TRACKS if reader.has(track)]
            problems += [
                (data, f"{column} runs backwards")
                for column in ("events/t", "event_pulses/t", "frames/t")
                if runs_backwards(reader, column)
            ]
            pixels = given.size_px if given.kind == EVENTS_KIND else None
            problems += _data_problems(data, reader, counts, pixels)
        stated_rows = {f"{given.kind}/t": given.rows, "event_pulses/t": given.pulses or 0}
        problems += [
            (data, f"{plural(counts[column], 'row')} of {column}, the record says {rows}")
            for column, rows in stated_rows.items()
            if counts[column] != rows
        ]
        problems += _frame_problems(data, video, tracks, counts)
    return problems


def _frame_problems(data: Path, video: Path, tracks: list[str], counts: dict[str, int]) -> Found:
    """Check for a row of tracks, or a picture in the video, for every frame."""
    frames, encoded = counts["frames/t"], video.exists()
    problems: Found = [
        (data, f"{plural(counts[name], 'row')} of {name}, not {frames}")
        for name in tracks
        if counts[name] != frames
    ]
    if frames and not encoded and "tracks/markers" not in tracks:
        problems.append((data, "has frames, but neither video nor tracks"))
    if encoded and count_frames(video) != frames:
        problems.append((video, f"does not hold {frames} frames"))
    return problems


def _next(campaign: Campaign) -> str:
    """Return the program that clears up what a killed one left in a campaign."""
    with suppress(StoreError):
        if IMPORTED in campaign.info:
            return "the same import, or the next recording,"
    return "the next `sliplab collect`"


def _leftovers(store: TrialStore, campaign: Campaign) -> list[StoreProblem]:
    """Find unfinished trials, and quarantined ones without a cause."""
    found = []
    folder = campaign.folder / "incoming"
    unfinished = sorted(folder.iterdir()) if folder.is_dir() else []
    holder = current_holder(store.folder / STORE_LOCK)
    writes = holder is not None and holder.get("collects") in {None, campaign.name}
    for path in unfinished:
        if writes and holder is not None:
            verb = "recorded" if holder.get("collects") else "written"
            what, kind = f"is being {verb} by {named(holder)}", RECORDING
        elif not path.exists():
            continue  # it was committed meanwhile
        elif (path / RECORD).exists():
            what, kind = f"is not committed yet; {_next(campaign)} does it", UNFINISHED
        else:
            what = f"is an unfinished trial; {_next(campaign)} quarantines it"
            kind = UNFINISHED
        found.append(StoreProblem(str(path), what, kind, campaign.name))
    folder = campaign.folder / "quarantine"
    for path in sorted(folder.iterdir()) if folder.is_dir() else []:
        try:
            read_json(path / CAUSE)["cause"]
        except (OSError, ValueError, KeyError) as error:
            what = f"gives no cause: {error}"
            found.append(StoreProblem(str(path / CAUSE), what, DAMAGED, campaign.name))
    return found


def quarantine_damaged(store: TrialStore, problems: list[StoreProblem]) -> list[str]:
    """Quarantine every committed trial that has a problem; the caller holds the store's lock.

    Returns:
        The ids, which the next collection retakes.
    """
    causes: dict[tuple[str, str], list[str]] = {}
    for problem in problems:
        if problem.trial:
            what = f"{Path(problem.path).name}: {problem.what}"
            causes.setdefault((problem.campaign, problem.trial), []).append(what)
    moved = []
    for (name, trial), given in causes.items():
        folder = store.campaign(name).folder / "trials" / trial
        if folder.is_dir() and not folder.is_symlink():
            store.campaign(name).quarantine(folder, f"damaged: {'; '.join(given)}")
            moved.append(trial)
    return moved
