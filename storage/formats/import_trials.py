"""Import of foreign trials into a new campaign: each one complete or not at all.

Formats are recognised by a file's first bytes, and otherwise by its extension, so that
a damaged file is rejected instead of skipped. Of a damaged file what stands whole before the damage
may be salvaged; the trial's record counts what is lost.

A trial is committed by the store's own rename after all of it was read and checked. Unknown
properties (relations of clocks, poses, conditions) are marked as unknown and never invented:
the time line is the event camera's own clock, or that of the frames where there are no events.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import partial
from importlib import util
from pathlib import Path

import numpy as np
from pydantic import ValidationError

from sliplab.protocols.errors import InputError
from sliplab.storage.clockmap import IDENTITY
from sliplab.storage.errors import DamagedFile, StoreError
from sliplab.storage.files import json_text, read_json, safe_name
from sliplab.storage.formats.aedat4 import LINE, read_aedat4, salvage_aedat4
from sliplab.storage.formats.dsec import (
    SIGNATURE,
    is_lab_hdf5,
    read_dsec,
    read_lab_hdf5,
    salvage_dsec,
    salvage_lab_hdf5,
)
from sliplab.storage.formats.foreign import (
    EXPORT_FORMAT,
    EXPORT_MANIFEST,
    RISING,
    Damage,
    ForeignTrial,
    FormatError,
    NoEvents,
    Skipped,
    as_damage,
    check_pixels,
    read_head,
)
from sliplab.storage.formats.lab_pickles import Pair, pairs, read_pair
from sliplab.storage.formats.lerobot_import import is_lerobot, read_lerobot
from sliplab.storage.formats.mcap_import import MAGIC, read_mcap, salvage_mcap
from sliplab.storage.formats.original import StoredTrial
from sliplab.storage.formats.prophesee import (
    check_faery,
    faery_type,
    read_by_faery,
    salvage_by_faery,
)
from sliplab.storage.formats.published_import import publication_at, read_publication
from sliplab.storage.process import now
from sliplab.storage.schema.document import first_fault
from sliplab.storage.schema.trial import (
    Clocks,
    Counts,
    DeviceRecord,
    Geometry,
    Lost,
    Provenance,
    Quality,
    StreamRecord,
    TrialRecord,
)
from sliplab.storage.streams import FRAMES_KIND, Json, PulseChunk, ScalarChunk
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
SALVAGE: dict[str, Reader] = {
    "aedat4": salvage_aedat4,
    "dsec": salvage_dsec,
    "lab-hdf5": salvage_lab_hdf5,
    "raw": salvage_by_faery,
    "es": salvage_by_faery,
    "mcap": salvage_mcap,
}
"""Readers of what stands whole before the damage in a file, by format."""
LAB_PICKLES = "lab-pickles"
DATA_SETS: dict[str, Callable[[Path], Iterator[ForeignTrial]]] = {
    "croissant": read_publication,
    "lerobot": read_lerobot,
}
"""Readers of folders that are one data set, by format."""
KINDS = (*READERS, LAB_PICKLES, *DATA_SETS)
MIXED = "mixed"
"""Files of several formats in one folder."""
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
    *,
    salvage: bool = False,
) -> Json:
    """Import trials that do not exist yet; the caller holds the store's lock.

    Args:
        name: the campaign's, which is made.
        origin: the file or folder that they come from, for messages and the campaign's description.
        kind: the format's name.
        salvage: of a damaged file, import what stands whole before the damage.

    Returns:
        ``imported`` and ``there`` (existing, skipped) with ids, ``events`` and ``frames`` imported,
        and where there are any, ``warnings`` and ``salvaged``: what is lost of each trial.

    Raises:
        InputError: a file is damaged (`DamagedFile`) or cannot be right. Trials before it stay
            committed; of this one nothing is left.
    """
    campaign = store.campaign(name)
    fresh = not campaign.begun
    existing = campaign.committed()
    imported: list[str] = []
    skipped: list[str] = []
    counts = {"events": 0, "frames": 0}
    warnings: list[str] = []
    salvaged: list[Json] = []
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
                trial, (taken, warned) = _take_whole(store, campaign, trial, kind, salvage)
            except FormatError as error:
                file = error.file or (origin if origin.is_file() else origin / trial.source)
                raise _refusal(file, error) from None
            imported.append(trial.name)
            if trial.lost is not None:
                about = {"trial": trial.name, "file": trial.source}
                salvaged.append({**about, **trial.lost.to_json()})
            warnings += [f"{trial.source}: {text}" for text in warned]
            counts = {key: counts[key] + taken[key] for key in counts}
    finally:
        if fresh and not imported and campaign.folder.exists():
            shutil.rmtree(campaign.folder)
    result = {"campaign": name, "imported": imported, "there": skipped, **counts}
    if salvaged:
        result["salvaged"] = salvaged
    return {**result, "warnings": warnings} if warnings else result


def _refusal(file: Path, error: FormatError) -> InputError:
    """Return the error of a file that is not imported: bad data, or else wrong input."""
    kind = DamagedFile if isinstance(error, Damage) else InputError
    return kind(file, "", None, str(error))


def _take_whole(
    store: Store, campaign: Campaign, trial: ForeignTrial, kind: str, salvage: bool
) -> tuple[ForeignTrial, tuple[dict[str, int], list[str]]]:
    """Commit one trial, or what stands whole of it; return it with its counts and warnings."""
    try:
        return trial, _take(store, campaign, trial, kind)
    except NoEvents:
        raise
    except FormatError as error:
        if trial.salvage is None:
            raise
        whole = _before_damage(trial.salvage, error, salvage)
    trial = replace(
        trial,
        events=whole.events,
        event_px=whole.event_px,
        triggers=whole.triggers,
        frames=whole.frames,
        frame_px=whole.frame_px,
        lost=whole.lost,
        packets=whole.packets,
        salvage=None,
    )
    with as_damage():
        return trial, _take(store, campaign, trial, kind)


def _before_damage(
    read: Callable[[], ForeignTrial], error: FormatError, salvage: bool
) -> ForeignTrial:
    """Return what stands whole in a file that could not be read.

    Args:
        error: the fault that was found.

    Raises:
        Damage: that is nothing, or it is not to be salvaged, and only offered.
        FormatError: the fault is no damage.
    """
    try:
        whole = read()
        if whole.lost is None:
            raise error
        if salvage:
            return whole
        count, last_us = 0, None
        for chunk in whole.events():
            count += len(chunk)
            last_us = int(chunk.t_us[-1]) if len(chunk) else last_us
    except FormatError as fault:
        if fault is error:
            raise
        raise Damage(str(fault if isinstance(fault, Damage) else error)) from None
    if last_us is None:
        raise Damage(f"{error}; no event stands before that")
    packets = "" if whole.packets is None else f", in {whole.packets:,} whole packets"
    raise Damage(f"{error}; --salvage imports {count:,} events up to {last_us} us{packets}")


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
        about = {"imported": now(), "from": trial.source}
        with as_damage():
            rows = trial.original.restore(store, campaign, safe_name(trial.name), about)
        return {"events": rows.events, "frames": rows.frames}, []
    writer = campaign.begin(safe_name(trial.name), trial.frame_px, _FRAME_RATE)
    try:
        (first_us, last_us), warnings = _fill(writer, trial)
        streams = _fill_further(writer, trial)
        warnings = [*_loss_warnings(trial.lost), *warnings]
        counts = writer.counts
        rows = Counts(
            events=counts["events/t"],
            frames=counts["frames/t"],
            poses=counts.get("poses/t", 0),
            pulses=0,
        )
        record = _record(campaign, trial, kind, rows, (last_us - first_us) / 1e6, warnings, streams)
        writer.commit(record, Provenance.model_validate({"imported": now(), "from": trial.source}))
    except BaseException:
        writer.discard()
        raise
    return {"events": rows.events, "frames": rows.frames}, warnings


def _fill(writer: TrialWriter, trial: ForeignTrial) -> tuple[tuple[int, int], list[str]]:
    """Write all streams; return the times of the first and last event, us, and warnings.

    Of a recording without events the times are those of its frames.

    Raises:
        FormatError: there is neither event nor frame, an event lies outside of the camera's pixels,
            or times run backwards.
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
        check_pixels(chunk, trial.event_px())
        writer.add_events(chunk)
    if first_us is None and trial.lost is not None:
        raise Damage(f"{trial.lost.reason}; no event stands before that")
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
        if not writer.counts["events/t"]:
            first_us = int(frames.t_ns[0]) // 1000 if first_us is None else first_us
            last_us = int(frames.t_ns[-1]) // 1000
    if first_us is None or last_us is None:
        raise NoEvents("contains no events; nothing to import")
    return (first_us, last_us), _gap_warnings(gap_us, gap_end_us)


def _fill_further(writer: TrialWriter, trial: ForeignTrial) -> dict[str, StreamRecord]:
    """Write poses, named streams and further cameras; return what the record says of them."""
    if trial.poses is not None:
        writer.add_poses(trial.poses)
    found: dict[str, StreamRecord] = {}
    for name, chunk in trial.streams.items():
        writer.add_stream(name, chunk)
        said = StreamRecord(kind=chunk.KIND, rows=len(chunk))
        if isinstance(chunk, ScalarChunk) and chunk.unit:
            said = StreamRecord(kind=chunk.KIND, rows=len(chunk), unit=chunk.unit)
        found[name] = said
    for name, read in trial.cameras.items():
        size, rows = None, 0
        for frames in read():
            height, width = frames.images.shape[1:]
            if (size := size or (width, height)) != (width, height):
                raise FormatError(f"holds a frame of {width} x {height} among others of {size}")
            writer.add_stream(name, frames)
            rows += len(frames)
        found[name] = StreamRecord(kind=FRAMES_KIND, rows=rows, size_px=size)
    return found


def _loss_warnings(lost: Lost | None) -> list[str]:
    if lost is None:
        return []
    counts = {"events": lost.events, "frames": lost.frames}
    missing = [f"{count:,} {what}" for what, count in counts.items() if count]
    of = f", {' and '.join(missing)} are missing" if missing else ""
    return [
        f"is not whole: it {lost.reason} (byte {lost.at_byte:,}); {lost.unread_bytes:,} bytes were "
        f"not read{of}"
    ]


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
    streams: dict[str, StreamRecord],
) -> TrialRecord:
    clock = DeviceRecord(grade="unknown", map=IDENTITY, uncertainty_ns=None)
    event_px = trial.event_px()
    there = {
        "events": counts.events > 0,
        "frames": trial.frames is not None,
        "arm": trial.poses is not None,
    }
    clocks: Json = {
        "reference": "event camera" if counts.events else "frame camera",
        **{device: clock for device, known in there.items() if known},
    }
    if streams:
        clocks["streams"] = dict.fromkeys(streams, clock)
    missing = ("sensor size",) if counts.events else ("events",)
    origin: Json = {
        "format": trial.kind or kind,
        "from": trial.source,
        "epoch": trial.epoch,
        "unknown": [*trial.unknown, *(() if event_px else missing)],
        **trial.about,
    }
    if warnings:
        origin["warnings"] = warnings
    if trial.lost is not None:
        origin["lost"] = trial.lost
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
    if streams:
        fields["streams"] = streams
    try:
        return TrialRecord.model_validate(fields)
    except ValidationError as error:
        key, value, expected = first_fault(error)
        raise FormatError(f"holds {key} = {value!r:.60}, which {expected}") from None


def kind_of(path: Path) -> str:
    """Return the format of a file, or of the files in a folder; `MIXED` for several.

    Raises:
        InputError: none of them is known, or one is damaged.
    """
    if (whole := _data_set(path)) is not None:
        return whole
    found = _sort(path)
    if not found:
        raise InputError(
            path, "", None, f"contains no known file format; name one of {', '.join(KINDS)}"
        )
    kinds = {kind for _, kind, _ in found}
    return kinds.pop() if len(kinds) == 1 else MIXED


def _data_set(path: Path) -> str | None:
    """Return the format of a folder that is one data set; None for any other path."""
    if publication_at(path) is not None:
        return "croissant"
    return "lerobot" if is_lerobot(path) else None


def trials_in(path: Path, kind: str, *, salvage: bool = False) -> Iterator[ForeignTrial]:
    """Yield the trials of a file or folder, in the order of their names.

    Args:
        kind: the format, or `MIXED`: that of each file.
        salvage: of a file that is damaged already where it begins to be read, yield what stands
            whole.

    Raises:
        InputError: it does not exist, a file is damaged, two have one name, or faery is missing.
        ModuleNotFoundError: the extra `publish` is missing, for MCAP files.
    """
    if kind in DATA_SETS:
        if not path.is_dir():
            raise InputError(path, "", None, f"is no folder; {kind} is a folder of files")
        yield from DATA_SETS[kind](path)
        return
    manifest = None
    if kind != LAB_PICKLES and path.is_dir():
        manifest = _read_manifest(path)
    if manifest is not None:
        for item in manifest["trials"]:
            file = path / item["file"]
            if file.is_symlink() or not file.is_file():
                raise InputError(file, "", None, "is missing or not a regular file")
            of = (_kind(file) or "") if kind == MIXED else kind
            if of not in READERS:
                raise InputError(file, "", None, f"is of no known format ({', '.join(READERS)})")
            found = _read(of, file, item["trial"], salvage)
            yield _as_exported(found, item, manifest["simulated"])
        return
    wanted = _sort(path) if kind == MIXED else _of_kind(path, kind)
    _check_names(path, wanted)
    for name, of, file in wanted:
        yield (
            replace(read_pair(file, name), kind=of)
            if isinstance(file, Pair)
            else _read(of, file, name, salvage)
        )


def skipped_in(path: Path, kind: str) -> list[Skipped]:
    """Return what `trials_in` leaves out of a folder, by name.

    Raises:
        InputError: as `trials_in`.
    """
    if not path.is_dir() or kind in DATA_SETS:
        return []
    manifest = _read_manifest(path) if kind != LAB_PICKLES else None
    taken: set[str | None] = {EXPORT_MANIFEST}
    if manifest is not None:
        taken |= {item["file"] for item in manifest["trials"]}
        other = f"is not in {EXPORT_MANIFEST}"
    else:
        for _, _, file in _sort(path) if kind == MIXED else _of_kind(path, kind):
            taken |= file.names() if isinstance(file, Pair) else {file.name}
        known = ", ".join(KINDS)
        other = f"is of no known format ({known})" if kind == MIXED else f"is no {kind} file"
    return [
        Skipped(entry.name, _reason(entry, other))
        for entry in sorted(path.iterdir())
        if entry.name not in taken
    ]


def _reason(entry: Path, other: str) -> str:
    if entry.is_symlink():
        return "is a link"
    if entry.is_dir():
        return "is a folder; import it by itself"
    return other if entry.is_file() else "is no regular file"


Wanted = tuple[str, str, "Path | Pair"]
"""Name of a trial, its format, and its file or files."""


def _sort(path: Path) -> list[Wanted]:
    """Return what is known in a file or folder, each with its own format, by name."""
    kinds = {file: _kind(file) for file in _files(path)}
    found: list[Wanted] = [
        (name_of(_stem(file)), kind, file) for file, kind in kinds.items() if kind is not None
    ]
    left = [file for file, kind in kinds.items() if kind is None]
    found += [(name_of(pair.stem), LAB_PICKLES, pair) for pair in pairs(left)]
    return sorted(found, key=lambda item: item[0])


def _of_kind(path: Path, kind: str) -> list[Wanted]:
    """Return what a file or folder holds of one format.

    Raises:
        InputError: that is nothing.
    """
    files = _files(path)
    if kind == LAB_PICKLES:
        found = pairs(files)
        if not found:
            raise InputError(path, "", None, "holds no NAME_events_on or NAME_events_off")
        return [(name_of(pair.stem), kind, pair) for pair in found]
    wanted = [file for file in files if kind in _possible(file)] if path.is_dir() else files
    if not wanted:
        endings = " or ".join(READERS[kind][0])
        raise InputError(path, "", None, f"holds no {kind} file; such files end in {endings}")
    return [(name_of(_stem(file)), kind, file) for file in wanted]


def _check_names(path: Path, wanted: list[Wanted]) -> None:
    """Check that no two files have the name of one trial, and that their libraries are there.

    Two files of one name are mostly one recording in two formats, which must not count twice.
    """
    seen: dict[str, Path | Pair] = {}
    for name, kind, file in wanted:
        if (other := seen.setdefault(name, file)) is not file:
            one, two = (
                item.name if isinstance(item, Path) else ", ".join(sorted(item.names()))
                for item in (other, file)
            )
            raise InputError(
                path, "", None,
                f"holds two files for the trial {name}: {one} and {two}; keep one of them, rename "
                "one, or import one format alone: sliplab import KIND PATH",
            )  # fmt: skip
        if kind in {"raw", "es"} and isinstance(file, Path):
            check_faery(file)
        if kind == "mcap" and util.find_spec("mcap") is None:
            raise ModuleNotFoundError("No module named 'mcap'", name="mcap")


def name_of(stem: str) -> str:
    """Make the name of a trial from a file's name: other characters become ``_``."""
    plain = re.sub(r"\.{2,}", "_", _UNSAFE.sub("_", stem)).lstrip("=,._+-")[:200]
    return plain or "trial"


def _read(kind: str, file: Path, name: str, salvage: bool) -> ForeignTrial:
    """Return the trial in a file, or what stands whole of it.

    Raises:
        InputError: it is damaged, or of another format.
    """
    _, reader = READERS[kind]
    again = partial(SALVAGE[kind], file, name) if kind in SALVAGE else None
    try:
        try:
            return replace(reader(file, name), kind=kind, salvage=again)
        except Damage as error:
            if again is None:
                raise
            return replace(_before_damage(again, error, salvage), kind=kind)
    except FormatError as error:
        raise _refusal(file, error) from None


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
    if head.startswith(SIGNATURE):
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
            raise _refusal(file, error) from None
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
