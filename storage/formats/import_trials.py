"""Import of foreign trials into a campaign of their own: each one whole or not at all.

A trial is committed by the store's own rename after all of it was read and found right. What nobody
knows of it (clocks against one another, poses, what was asked for) is said to be unknown and not
made up: its time line is the event camera's own clock.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
from pydantic import ValidationError

from sliplab.protocols.errors import InputError
from sliplab.storage.clockmap import IDENTITY
from sliplab.storage.files import json_text, safe_name
from sliplab.storage.formats.foreign import ForeignTrial, FormatError
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
from sliplab.storage.trials.store import IMPORTED, Campaign, Store
from sliplab.storage.trials.writer import TrialWriter

RISING = 1
"""A rising edge of the external input, as AEDAT4 numbers triggers."""
_LONG_GAP_US = 3_600_000_000
_FRAME_RATE = 100
"""Of the video's own time base only; when frames were taken stands in their times."""


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
        and ``warnings`` for people where there are any.

    Raises:
        InputError: a file is damaged or cannot be right. Trials before it stay committed; of this
            one nothing is left.
    """
    campaign = store.campaign(name)
    fresh = not campaign.begun
    if not fresh and IMPORTED not in campaign.info:
        raise InputError("--name", "", name, "is a campaign that was collected; give another name")
    existing = campaign.committed()
    imported: list[str] = []
    skipped: list[str] = []
    counts = {"events": 0, "frames": 0}
    warnings: list[str] = []
    try:
        for trial in trials:
            on_trial(trial.name)
            if trial.name in existing:
                skipped.append(trial.name)
                continue
            if trial.name in imported:
                raise InputError(
                    origin, "", None,
                    f"holds two files for the trial {trial.name}; import them one by one",
                )  # fmt: skip
            if not campaign.begun:
                _describe(campaign, trial, origin, kind)
            try:
                taken, warned = _take(campaign, trial, kind)
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


def _describe(campaign: Campaign, trial: ForeignTrial, origin: Path, kind: str) -> None:
    about = {"from": origin.name, "format": kind, "when": now()}
    info = {"name": campaign.name, "simulated": trial.simulated, IMPORTED: about}
    text = f"# Imported: there is no protocol.\nimported: {json_text(kind).strip()}\n"
    campaign.update(info, text, text.replace("protocol", "rig file"))


def _take(campaign: Campaign, trial: ForeignTrial, kind: str) -> tuple[dict[str, int], list[str]]:
    """Commit one trial; its counts and warnings."""
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


def _fill(writer: TrialWriter, trial: ForeignTrial) -> tuple[tuple[int, int], list[str]]:
    """All streams into the trial; the times of the first and the last event, us, and warnings.

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
            raise FormatError("holds events whose times run backwards")
        first_us = int(chunk.t_us[0]) if first_us is None else first_us
        steps = np.diff(chunk.t_us, prepend=first_us if last_us is None else last_us)
        widest = int(steps.argmax())
        if int(steps[widest]) > gap_us:
            gap_us, gap_end_us = int(steps[widest]), int(chunk.t_us[widest])
        last_us = int(chunk.t_us[-1])
        _check_pixels(chunk, trial.event_px())
        writer.add_events(chunk)
    if first_us is None or last_us is None:
        raise FormatError("holds no events, so there is nothing to import; leave it out")
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
        "the camera's clock was set there, or the times on one side are wrong; kept as they are"
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
