"""Import of foreign trials into a campaign: each one complete or not at all.

A trial is committed by the store's own rename after all of it was read and checked. Unknown
properties (relations of clocks, poses, conditions) are marked as unknown and never invented:
the time line is the event camera's own clock, or that of the frames where there are no events. Of a
damaged file what stands whole before the damage may be salvaged; the trial's record counts what is
lost.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from pydantic import ValidationError

from sliplab.protocols.errors import InputError
from sliplab.storage.clockmap import IDENTITY
from sliplab.storage.files import json_text, safe_name
from sliplab.storage.formats.foreign import (
    RISING,
    Damage,
    ForeignCampaign,
    ForeignTrial,
    FormatError,
    NoEvents,
    Seen,
    Whole,
    as_damage,
    before_damage,
    check_pixels,
    refusal,
)
from sliplab.storage.formats.original import StoredTrial
from sliplab.storage.interrupts import interruptible, uninterrupted
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

_LONG_GAP_US = 3_600_000_000
_FRAME_RATE = 100
"""Time base of the video only; frames keep their own times."""
_UNKNOWN = DeviceRecord(grade="unknown", map=IDENTITY, uncertainty_ns=None)


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
        on_trial: called with each trial's id before it is read; what it raises ends the import
            between two trials.
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
    joined: ForeignCampaign | None = None
    imported: list[str] = []
    skipped: list[str] = []
    counts = {"events": 0, "frames": 0}
    warnings: list[str] = []
    salvaged: list[Json] = []
    try:
        for trial in trials:
            on_trial(trial.name)
            of = trial.campaign or _Imported(origin, kind, trial.simulated)
            if of != joined:
                of.join(campaign, trial.source)
                joined = of
            if trial.name in existing:
                skipped.append(trial.name)
                continue
            if trial.name in imported:
                raise InputError(
                    origin, "", None,
                    f"holds two files for the trial {trial.name}; import them one by one",
                )  # fmt: skip
            try:
                trial, (taken, warned) = _take_whole(store, campaign, trial, kind, salvage)
            except FormatError as error:
                file = error.file or (origin if origin.is_file() else origin / trial.source)
                raise refusal(file, error) from None
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


@dataclass(frozen=True)
class _Imported:
    """The campaign of recordings that belong to none: it has neither protocol nor rig."""

    origin: Path
    kind: str
    simulated: bool

    def join(self, campaign: Campaign, source: str) -> None:
        if campaign.begun:
            if IMPORTED not in campaign.info:
                raise InputError(
                    "--name", "", campaign.name, "is a collected campaign; choose another name"
                )
            return
        about = {"from": self.origin.name, "format": self.kind, "when": now()}
        info: CampaignInfo = {
            "name": campaign.name, "simulated": self.simulated, IMPORTED: about
        }  # fmt: skip
        text = f"# Imported: there is no protocol.\nimported: {json_text(self.kind).strip()}\n"
        campaign.update(info, text, text.replace("protocol", "rig file"))


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
        whole = before_damage(trial.salvage, error, salvage)
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


@uninterrupted
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
        seen, warnings = _fill(writer, trial)
        streams = _fill_further(writer, trial)
        warnings = [*_loss_warnings(trial.lost), *warnings]
        counts = writer.counts
        rows = Counts(
            events=counts["events/t"],
            frames=counts["frames/t"],
            poses=counts.get("poses/t", 0),
            pulses=0,
        )
        record = _record(campaign, trial, kind, rows, seen, warnings, streams)
        writer.commit(record, Provenance.model_validate({"imported": now(), "from": trial.source}))
    except BaseException:
        writer.discard()
        raise
    return {"events": rows.events, "frames": rows.frames}, warnings


@interruptible
def _fill(writer: TrialWriter, trial: ForeignTrial) -> tuple[Seen, list[str]]:
    """Write events and frames; return what was seen of both, and warnings.

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
    first_ns = last_ns = None
    for frames in trial.frames() if trial.frames is not None else ():
        height, width = frames.images.shape[1:]
        if (width, height) != trial.frame_px:
            raise FormatError(
                f"holds a frame of {width} x {height} among others of {trial.frame_px}"
            )
        writer.add_frames(frames)
        first_ns = int(frames.t_ns[0]) if first_ns is None else first_ns
        last_ns = int(frames.t_ns[-1])
    events = None if first_us is None or last_us is None else (first_us, last_us)
    times = None if first_ns is None or last_ns is None else (first_ns, last_ns)
    if events is None and times is None and trial.whole is None:
        raise NoEvents("contains no events; nothing to import")
    return Seen(events, times), _gap_warnings(gap_us, gap_end_us)


@interruptible
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


def _seconds(seen: Seen, whole: Whole | None) -> float:
    """Return the length of a recording: as it is stated, or from its first to its last event."""
    if whole is not None:
        return (whole.span_ns[1] - whole.span_ns[0]) / 1e9
    if seen.events_us is not None:
        return (seen.events_us[1] - seen.events_us[0]) / 1e6
    first, last = seen.frames_ns or (0, 0)
    return (last // 1000 - first // 1000) / 1e6


def _clocks(
    trial: ForeignTrial, counts: Counts, whole: Whole | None, streams: dict[str, StreamRecord]
) -> Clocks:
    there = {
        "events": counts.events > 0 or trial.event_px() is not None,
        "frames": trial.frames is not None,
        "arm": trial.poses is not None or (whole is not None and bool(whole.steps)),
    }
    found: Json = {
        "reference": "event camera" if there["events"] else "frame camera",
        **{name: trial.clocks.get(name, _UNKNOWN) for name, known in there.items() if known},
    }
    if streams:
        found["streams"] = {name: trial.clocks.get(name, _UNKNOWN) for name in streams}
    return Clocks(**found)


def _record(
    campaign: Campaign,
    trial: ForeignTrial,
    kind: str,
    counts: Counts,
    seen: Seen,
    warnings: list[str],
    streams: dict[str, StreamRecord],
) -> TrialRecord:
    event_px = trial.event_px()
    whole = None if trial.whole is None else trial.whole(seen)
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
    if whole is not None:
        origin |= {"span_ns": whole.span_ns, "given": whole.given}
    fields = {
        "format": TrialRecord.FORMAT,
        "trial": trial.name,
        "campaign": campaign.name,
        "experiment": trial.experiment,
        "role": "imported",
        "block": 0,
        "repetition": trial.repetition,
        "attempt": 0,
        "condition": trial.condition,
        "simulated": trial.simulated,
        "recorded_s": _seconds(seen, whole),
        "counts": counts,
        "clocks": _clocks(trial, counts, whole, streams),
        "quality": Quality(passed=True, gates={}),
        "steps": () if whole is None else whole.steps,
        "geometry": Geometry.model_validate(
            {"event_px": event_px, "frame_px": trial.frame_px, **trial.geometry}
        ),
        "imported": origin,
    }
    if streams:
        fields["streams"] = streams
    try:
        return TrialRecord.model_validate(fields)
    except ValidationError as error:
        key, value, expected = first_fault(error)
        raise FormatError(f"holds {key} = {value!r:.60}, which {expected}") from None
