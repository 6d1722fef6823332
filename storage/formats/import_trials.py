"""Import of foreign trials into a new campaign: each one complete or not at all.

Formats are recognised by a file's first bytes, and otherwise by its extension, so that
a damaged file is rejected instead of skipped.

A trial is committed by the store's own rename after all of it was read and checked. Unknown
properties (relations of clocks, poses, conditions) are marked as unknown and never invented:
the time line is the event camera's own clock.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from pydantic import ValidationError

from sliplab.protocols.errors import InputError
from sliplab.storage.clockmap import IDENTITY
from sliplab.storage.errors import StoreError
from sliplab.storage.files import json_text, read_json, safe_name
from sliplab.storage.formats.aedat4 import LINE, read_aedat4
from sliplab.storage.formats.dsec import is_lab_hdf5, read_dsec, read_lab_hdf5
from sliplab.storage.formats.foreign import (
    EXPORT_FORMAT,
    EXPORT_MANIFEST,
    RISING,
    ForeignTrial,
    FormatError,
    read_head,
)
from sliplab.storage.formats.lab_pickles import pairs, read_pair
from sliplab.storage.formats.mcap_import import MAGIC, read_mcap
from sliplab.storage.formats.original import Original, StoredTrial
from sliplab.storage.formats.prophesee import faery_type, read_by_faery
from sliplab.storage.process import now
from sliplab.storage.schema.document import first_fault
from sliplab.storage.schema.trial import (
    Clocks,
    Counts,
    DeviceRecord,
    Geometry,
    Provenance,
    Quality,
    TrialRecord,
)
from sliplab.storage.streams import EventChunk, Json, PulseChunk
from sliplab.storage.trials.store import IMPORTED, Campaign, CampaignInfo, Store
from sliplab.storage.trials.writer import TrialWriter

Reader = Callable[[Path, str], ForeignTrial]
READERS: dict[str, tuple[tuple[str, ...], Reader]] = {
    "aedat4": ((".aedat4",), read_aedat4),
    "dsec": ((".h5", ".hdf5"), read_dsec),
    "lab-hdf5": ((".h5", ".hdf5"), read_lab_hdf5),
    "raw": ((".raw", ".dat"), read_by_faery),
    "es": ((".es",), read_by_faery),
    "mcap": ((".mcap",), read_mcap),
}
LAB_PICKLES = "lab-pickles"
KINDS = (*READERS, LAB_PICKLES)
_HDF5 = b"\x89HDF\r\n\x1a\n"
_UNSAFE = re.compile(r"[^A-Za-z0-9=,._+-]+")
_LONG_GAP_US = 3_600_000_000
_FRAME_RATE = 100
"""Time base of the video only; frames keep their own times."""


def import_trials(
    store: Store,
    name: str,
    trials: Iterable[ForeignTrial],
    origin: Path,
    kind: str,
    on_trial: Callable[[str], None] = lambda name: None,
) -> Json:
    """Import trials that do not exist yet; the caller holds the store's lock.

    Args:
        name: the campaign's, which is made.
        origin: the file or folder that they come from, for messages and the campaign's description.
        kind: the format's name.

    Returns:
        ``imported`` and ``there`` (existing, skipped) with ids, ``events`` and ``frames`` imported,
        and ``warnings`` where there are any.

    Raises:
        InputError: a file is damaged or cannot be right. Trials before it stay committed; of this
            one nothing is left.
    """
    campaign = store.campaign(name)
    fresh = not campaign.begun
    existing = campaign.committed()
    imported: list[str] = []
    skipped: list[str] = []
    counts = {"events": 0, "frames": 0}
    warnings: list[str] = []
    try:
        for trial in trials:
            on_trial(trial.name)
            if not fresh:
                _check_campaign(campaign, trial)
            if trial.name in existing:
                skipped.append(trial.name)
                continue
            if trial.name in imported:
                raise InputError(
                    origin, "", None,
                    f"holds two files for the trial {trial.name}; import them one by one",
                )  # fmt: skip
            if imported:
                _check_campaign(campaign, trial)
            if not campaign.begun:
                _describe(campaign, trial, origin, kind)
            try:
                taken, warned = _take(store, campaign, trial, kind)
            except FormatError as error:
                file = error.file or (origin if origin.is_file() else origin / trial.source)
                raise InputError(file, "", None, str(error)) from None
            imported.append(trial.name)
            warnings += [f"{trial.source}: {text}" for text in warned]
            counts = {key: counts[key] + taken[key] for key in counts}
    finally:
        if fresh and not imported and campaign.folder.exists():
            shutil.rmtree(campaign.folder)
    result = {"campaign": name, "imported": imported, "there": skipped, **counts}
    return {**result, "warnings": warnings} if warnings else result


def _check_campaign(campaign: Campaign, trial: ForeignTrial) -> None:
    """Check that a trial belongs to a campaign that has begun."""
    if isinstance(trial, StoredTrial) and trial.original is not None:
        if not trial.original.campaign.is_of(campaign):
            raise InputError(
                "--name", "", campaign.name,
                f"has another protocol or rig than {trial.source}; choose another name, and "
                "import one campaign at a time",
            )  # fmt: skip
    elif IMPORTED not in campaign.info:
        raise InputError(
            "--name", "", campaign.name, "is a collected campaign; choose another name"
        )


def _describe(campaign: Campaign, trial: ForeignTrial, origin: Path, kind: str) -> None:
    if isinstance(trial, StoredTrial) and trial.original is not None:
        trial.original.campaign.begin(campaign)
        return
    about = {"from": origin.name, "format": kind, "when": now()}
    info: CampaignInfo = {
        "name": campaign.name, "simulated": trial.simulated, IMPORTED: about
    }  # fmt: skip
    text = f"# Imported: there is no protocol.\nimported: {json_text(kind).strip()}\n"
    campaign.update(info, text, text.replace("protocol", "rig file"))


def _take(
    store: Store, campaign: Campaign, trial: ForeignTrial, kind: str
) -> tuple[dict[str, int], list[str]]:
    """Commit one trial; return its counts and warnings."""
    if isinstance(trial, StoredTrial) and trial.original is not None:
        return _restore(store, campaign, trial, trial.original), []
    writer = campaign.begin(safe_name(trial.name), trial.frame_px, _FRAME_RATE)
    try:
        (first_us, last_us), warnings = _fill(writer, trial)
        counts = writer.counts
        rows = Counts(events=counts["events/t"], frames=counts["frames/t"], poses=0, pulses=0)
        record = _record(campaign, trial, kind, rows, (last_us - first_us) / 1e6, warnings)
        writer.commit(record, Provenance.model_validate({"imported": now(), "from": trial.source}))
    except BaseException:
        writer.discard()
        raise
    return {"events": rows.events, "frames": rows.frames}, warnings


def _restore(
    store: Store, campaign: Campaign, trial: StoredTrial, original: Original
) -> dict[str, int]:
    """Commit a trial of a store as it was, with its label and clocks; return its counts."""
    writer = campaign.begin(safe_name(trial.name), original.frame_px(), original.rate_hz)
    try:
        original.keep_label(store, campaign.name, trial.name)
        kept = {"imported": now(), "from": trial.source}
        original.commit(
            writer, Provenance.model_validate({**original.provenance.to_json(), **kept})
        )
    except BaseException:
        writer.discard()
        original.drop_label(store, campaign.name, trial.name)
        raise
    original.keep_sync(campaign, campaign.recording(trial.name))
    counts = original.record.counts
    return {"events": counts.events, "frames": counts.frames}


def _fill(writer: TrialWriter, trial: ForeignTrial) -> tuple[tuple[int, int], list[str]]:
    """Write all streams; return the times of the first and last event, us, and warnings.

    Raises:
        FormatError: there is no event, one lies outside of the camera's pixels, or times run
            backwards.
    """
    first_us = last_us = None
    gap_us = gap_end_us = 0
    for chunk in trial.events():
        if not len(chunk):
            continue
        if last_us is not None and int(chunk.t_us[0]) < last_us:
            raise FormatError("contains events with decreasing times")
        first_us = int(chunk.t_us[0]) if first_us is None else first_us
        steps = np.diff(chunk.t_us, prepend=first_us if last_us is None else last_us)
        widest = int(steps.argmax())
        if int(steps[widest]) > gap_us:
            gap_us, gap_end_us = int(steps[widest]), int(chunk.t_us[widest])
        last_us = int(chunk.t_us[-1])
        _check_pixels(chunk, trial.event_px())
        writer.add_events(chunk)
    if first_us is None or last_us is None:
        raise FormatError("contains no events; nothing to import")
    if trial.triggers is not None:
        t_ns = trial.triggers.t_us * 1000
        writer.add_triggers(t_ns, trial.triggers.kind)
        writer.add_event_pulses(PulseChunk(t_ns[trial.triggers.kind == RISING]))
    for frames in trial.frames() if trial.frames is not None else ():
        height, width = frames.images.shape[1:]
        if (width, height) != trial.frame_px:
            raise FormatError(
                f"holds a frame of {width} x {height} among others of {trial.frame_px}"
            )
        writer.add_frames(frames)
    return (first_us, last_us), _gap_warnings(gap_us, gap_end_us)


def _check_pixels(chunk: EventChunk, size: tuple[int, int] | None) -> None:
    if size is None:
        return
    x, y = int(chunk.x.max()), int(chunk.y.max())
    if x >= size[0] or y >= size[1]:
        raise FormatError(
            f"holds events up to column {x} and row {y}, outside of the {size[0]} x {size[1]} "
            "pixels that it gives its camera"
        )


def _gap_warnings(gap_us: int, end_us: int) -> list[str]:
    if gap_us < _LONG_GAP_US:
        return []
    return [
        f"{gap_us / 3.6e9:,.1f} hours without an event between {end_us - gap_us} and {end_us} us: "
        "the camera's clock was set there, or the times on one side are wrong; imported unchanged"
    ]


def _record(
    campaign: Campaign,
    trial: ForeignTrial,
    kind: str,
    counts: Counts,
    seconds: float,
    warnings: list[str],
) -> TrialRecord:
    clock = DeviceRecord(grade="unknown", map=IDENTITY, uncertainty_ns=None)
    event_px = trial.event_px()
    clocks: Json = {"reference": "event camera", "events": clock}
    if trial.frames is not None:
        clocks["frames"] = clock
    origin = {
        "format": kind,
        "from": trial.source,
        "epoch": trial.epoch,
        "unknown": [*trial.unknown, *([] if event_px else ["sensor size"])],
        **trial.about,
    }
    if warnings:
        origin["warnings"] = warnings
    fields = {
        "format": TrialRecord.FORMAT,
        "trial": trial.name,
        "campaign": campaign.name,
        "experiment": "imported",
        "role": "imported",
        "block": 0,
        "repetition": trial.repetition,
        "attempt": 0,
        "condition": trial.condition,
        "simulated": trial.simulated,
        "recorded_s": seconds,
        "counts": counts,
        "clocks": Clocks(**clocks),
        "quality": Quality(passed=True, gates={}),
        "steps": (),
        "geometry": Geometry(event_px=event_px, frame_px=trial.frame_px),
        "imported": origin,
    }
    try:
        return TrialRecord.model_validate(fields)
    except ValidationError as error:
        key, value, expected = first_fault(error)
        raise FormatError(f"holds {key} = {value!r:.60}, which {expected}") from None


def kind_of(path: Path) -> str:
    """Return the format of a file, or of the files in a folder.

    Raises:
        InputError: none of them is known, or they are of several.
    """
    files = _files(path)
    found = {_kind(file) for file in files} - {None}
    if pairs(files):
        found.add(LAB_PICKLES)
    if len(found) == 1:
        return str(found.pop())
    what = f"holds files of several formats ({', '.join(sorted(map(str, found)))})"
    raise InputError(
        path, "", None,
        f"{what if found else 'contains no known file format'}; name one of {', '.join(KINDS)}",
    )  # fmt: skip


def trials_in(path: Path, kind: str) -> Iterator[ForeignTrial]:
    """Yield the trials of a file or folder, in the order of their names.

    Raises:
        InputError: it does not exist, or a file is damaged.
    """
    files = _files(path)
    if kind == LAB_PICKLES:
        found = pairs(files)
        if not found:
            raise InputError(path, "", None, "holds no NAME_events_on or NAME_events_off")
        for pair in found:
            yield read_pair(pair, name_of(pair.stem))
        return
    suffixes, reader = READERS[kind]
    manifest = _read_manifest(path) if path.is_dir() else None
    if manifest is not None:
        for item in manifest["trials"]:
            file = path / item["file"]
            if file.is_symlink() or not file.is_file():
                raise InputError(file, "", None, "is missing or not a regular file")
            yield _as_exported(_read(reader, file, item["trial"]), item, manifest["simulated"])
        return
    wanted = [file for file in files if kind in _possible(file)] if path.is_dir() else files
    if not wanted:
        raise InputError(
            path, "", None, f"holds no {kind} file; such files end in {' or '.join(suffixes)}"
        )
    for file in wanted:
        yield _read(reader, file, name_of(_stem(file)))


def name_of(stem: str) -> str:
    """Make the name of a trial from a file's name: other characters become ``_``."""
    plain = re.sub(r"\.{2,}", "_", _UNSAFE.sub("_", stem)).lstrip("=,._+-")[:200]
    return plain or "trial"


def _read(reader: Reader, file: Path, name: str) -> ForeignTrial:
    try:
        return reader(file, name)
    except FormatError as error:
        raise InputError(file, "", None, str(error)) from None


def _stem(file: Path) -> str:
    """Return a file's name without its ending; a name without one may have dots in it."""
    known = {ending for endings, _ in READERS.values() for ending in endings}
    return file.stem if file.suffix.lower() in known else file.name


def _files(path: Path) -> list[Path]:
    """List plain files; links are left out, for they may lead anywhere."""
    if path.is_dir():
        found = sorted(file for file in path.iterdir() if file.is_file() and not file.is_symlink())
    elif path.is_file():
        found = [path]
    else:
        raise InputError(path, "", None, "no such file or folder")
    return found


def _possible(file: Path) -> tuple[str, ...]:
    """Return the formats that a file may have: by its first bytes, else by its name's ending."""
    head = read_head(file)
    if head.startswith(LINE):
        return ("aedat4",)
    if head.startswith(MAGIC):
        return ("mcap",)
    if head.startswith(_HDF5):
        return ("dsec", "lab-hdf5")
    if form := faery_type(head):
        return ("es",) if form == "es" else ("raw",)
    suffix = file.suffix.lower()
    return tuple(kind for kind, (endings, _) in READERS.items() if suffix in endings)


def _kind(file: Path) -> str | None:
    kinds = _possible(file)
    if "dsec" in kinds:
        try:
            return "lab-hdf5" if is_lab_hdf5(file) else "dsec"
        except FormatError as error:
            raise InputError(file, "", None, str(error)) from None
    return kinds[0] if kinds else None


def _read_manifest(folder: Path) -> Json | None:
    """Read and check the manifest of an exported campaign; None if there is none.

    Raises:
        InputError: it is damaged, or names a file outside of its folder.
    """
    path = folder / EXPORT_MANIFEST
    if not path.is_file() or path.is_symlink():
        return None
    try:
        found = read_json(path)
        if found.get("sliplab_export") != EXPORT_FORMAT:
            raise ValueError(f"{path}: sliplab_export must be {EXPORT_FORMAT}")
        if not isinstance(found.get("simulated"), bool):
            raise ValueError(f"{path}: simulated must be true or false")
        for item in found["trials"]:
            safe_name(item["trial"])
            safe_name(item["file"])
            _check_exported(item, path)
    except OSError as error:
        raise InputError(path, "", None, f"cannot be read: {error.strerror}") from None
    except (ValueError, KeyError, TypeError, StoreError) as error:
        text = str(error).removeprefix(f"{path}: ")
        raise InputError(path, "", None, f"is damaged: {text}") from None
    return found


def _check_exported(item: Json, path: Path) -> None:
    texts = item["condition"]
    if not isinstance(texts, dict) or not all(isinstance(t, str) for t in texts.values()):
        raise ValueError(f"{path}: a condition that is not text")
    for name in ("events", "frames", "triggers", "repetition"):
        if type(item[name]) is not int:
            raise ValueError(f"{path}: {name} must be an integer")


def _as_exported(trial: ForeignTrial, item: Json, simulated: bool) -> ForeignTrial:
    """Return a trial with what the manifest states of it."""
    about = {**trial.about, "exported": item.get("record", {})}
    return replace(
        trial,
        condition=dict(item["condition"]),
        repetition=item["repetition"],
        simulated=simulated or trial.simulated,
        about=about,
        unknown=tuple(what for what in trial.unknown if what != "condition"),
    )
