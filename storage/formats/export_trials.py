"""Export of committed trials to files of other formats, and of tables; the store is only read."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pandas as pd

from sliplab.protocols.errors import InputError
from sliplab.storage.errors import StoreError
from sliplab.storage.files import make_folder, replacing, sync_folder, write_json
from sliplab.storage.formats.aedat4 import EVENTS, FRAMES, SIMULATED, TRIGGERS, Aedat4Writer, Stream
from sliplab.storage.formats.dsec import write_dsec
from sliplab.storage.formats.foreign import EXPORT_FORMAT, EXPORT_MANIFEST, RISING, Triggers
from sliplab.storage.schema.label import LABELS
from sliplab.storage.streams import EVENTS_KIND, I64, EventChunk, Json
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import Store

SUFFIXES = {"aedat4": ".aedat4", "dsec": ".h5"}
"""Suffix of the files of each format."""
_PIECE = 1 << 20


def export_trials(
    recordings: list[Recording],
    folder: Path,
    kind: str,
    campaign: str,
    on_trial: Callable[[str], None] = lambda name: None,
    stream: str = EVENTS_KIND,
) -> Json:
    """Export trials to `folder`, each file complete or not at all, and a manifest last.

    Args:
        stream: name of a further event camera's stream, whose events, pulses and clock are
            exported in place of the first one's.

    Returns:
        ``trials``, ``events``, ``frames`` and ``triggers`` written, and ``files``.

    Raises:
        InputError: a trial does not fit the format.
        StoreError: a trial is damaged.
    """
    make_folder(folder)
    listed: list[Json] = []
    for recording in recordings:
        on_trial(recording.trial_id)
        path = folder / f"{recording.trial_id}{SUFFIXES[kind]}"
        try:
            with replacing(path) as temporary:
                counts = _WRITERS[kind](recording, temporary, stream)
        except StoreError:  # a damaged trial, some of which are ValueErrors, too
            raise
        except ValueError as error:
            raise InputError("--format", "", kind, f"trial {recording.trial_id} {error}") from None
        listed.append(_listed(recording, path.name, counts))
    sync_folder(folder)
    simulated = any(recording.simulated for recording in recordings)
    about: Json = {"campaign": campaign, "format": kind, "simulated": simulated, "trials": listed}
    if stream != EVENTS_KIND:
        about["stream"] = stream
    write_json(folder / EXPORT_MANIFEST, {"sliplab_export": EXPORT_FORMAT, **about})
    totals = {name: sum(item[name] for item in listed) for name in ("events", "frames", "triggers")}
    return {"trials": len(listed), **totals, "files": [item["file"] for item in listed]}


def _listed(recording: Recording, name: str, counts: dict[str, int]) -> Json:
    record = recording.record
    kept = record.model_dump(
        mode="json", include={"experiment", "role", "clocks", "steps"}, exclude_unset=True
    )
    return {
        "trial": recording.trial_id,
        "file": name,
        "condition": record.condition,
        "repetition": record.repetition,
        "record": kept,
        **counts,
    }


def _source(recording: Recording) -> str:
    return f"sliplab {SIMULATED}" if recording.simulated else "sliplab"


def _aedat4(recording: Recording, path: Path, stream: str) -> dict[str, int]:
    """Write everything on the event camera's clock, us; frames at the middle of their exposure."""
    if not (_has_events(recording, stream) or recording.has_video):
        raise ValueError("has neither events nor a video, and AEDAT4 holds those alone")
    triggers = _triggers(recording, stream)
    streams = {0: Stream(EVENTS, "events", _size(recording, stream), _source(recording))}
    frame_us = np.empty(0, np.int64)
    if recording.has_video:
        frame_us = recording.frame_times() // 1000
        if _has_events(recording, stream):
            frame_us = recording.clock(stream).to_device(recording.frame_times()) // 1000
        first = recording.frame(0) if len(frame_us) else np.empty((1, 1))
        height, width = first.shape
        streams[1] = Stream(FRAMES, "frames", (width, height), _source(recording))
    streams[2] = Stream(TRIGGERS, "triggers", None, _source(recording))
    if len(frame_us) and int(frame_us.min()) < 0:
        raise ValueError("has frames before the event camera's clock started")
    with Aedat4Writer(path, streams) as file:
        count = 0
        for chunk in _pieces(recording, stream):
            file.events(0, chunk)
            count += len(chunk)
        file.triggers(2, triggers)
        if recording.has_video:
            for image, t_us in zip(recording.frames(), frame_us.tolist(), strict=True):
                file.picture(1, image, t_us)
    return {"events": count, "frames": len(frame_us), "triggers": len(triggers.t_us)}


def _dsec(recording: Recording, path: Path, stream: str) -> dict[str, int]:
    """Write events and triggers; DSEC's event file holds no frames."""
    if not _has_events(recording, stream):
        raise ValueError("has no events, and DSEC's file holds those alone")
    triggers = _triggers(recording, stream)
    with recording.open(stream) as reader:
        events = reader.events()
    write_dsec(path, events, triggers, simulated=recording.simulated)
    return {"events": len(events), "frames": 0, "triggers": len(triggers.t_us)}


_WRITERS: dict[str, Callable[[Recording, Path, str], dict[str, int]]] = {
    "aedat4": _aedat4,
    "dsec": _dsec,
}


def _has_events(recording: Recording, stream: str) -> bool:
    return stream != EVENTS_KIND or recording.record.counts.events > 0


def _pieces(recording: Recording, stream: str) -> Iterator[EventChunk]:
    """Yield all events, about `_PIECE` at a time."""
    with recording.open(stream) as reader:
        cuts = np.unique(reader.event_times()[::_PIECE]).tolist()
        if not cuts:
            return
        for start, end in zip(cuts, [*cuts[1:], None], strict=True):
            yield reader.events(start, end)


def _triggers(recording: Recording, stream: str) -> Triggers:
    """Return triggers as they were imported, or else the sync pulses as rising edges."""
    with recording.open(stream) as reader:
        if reader.has("triggers/t"):
            t_ns: I64 = reader.column("triggers/t")
            kinds = reader.column("triggers/kind").astype(np.uint8)
        else:
            t_ns = reader.pulses("event_pulses")
            kinds = np.full(len(t_ns), RISING, np.uint8)
    return Triggers(t_ns // 1000, kinds)


def _size(recording: Recording, stream: str) -> tuple[int, int]:
    """Return columns and rows of an event camera, or the least that its events need."""
    about = recording.record.streams.get(stream)
    known = recording.record.geometry.event_px if about is None else about.size_px
    if known is not None:
        return known
    with recording.open(stream) as reader:
        events = reader.events()
    return (
        int(events.x.max(initial=0)) + 1,
        int(events.y.max(initial=0)) + 1,
    )


def label_table(store: Store, campaign: str, trials: list[str]) -> pd.DataFrame:
    """Return one row a labelled trial: the single values of its label, times in integer ns.

    Nested values become columns with a dot in their names; lists are left out. Values that are not
    in every label are missing, and integers stay integers.
    """
    kept = Derived.of(store, LABELS, campaign)
    rows: list[Json] = []
    for trial in trials:
        try:
            found = kept.read(trial)
        except FileNotFoundError:
            continue
        rows.append({"campaign": campaign, "trial": trial, **_flat(found, "")})
    return pd.DataFrame(rows).convert_dtypes()


def _flat(data: Json, before: str) -> Json:
    flat: Json = {}
    for key, value in data.items():
        if isinstance(value, dict):
            flat |= _flat(value, f"{before}{key}.")
        elif not isinstance(value, list):
            flat[f"{before}{key}"] = value
    return flat
