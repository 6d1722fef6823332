"""The record of a recorded trial: from what is in its files, whether it ended well or was cut."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import BaseModel, Field

from sliplab.plugins.record.clocks import Clocks, fit_clocks
from sliplab.plugins.record.sources import FIRST_CAMERAS, SourceAbout
from sliplab.plugins.record.tapped import TAP
from sliplab.storage.schema.trial import (
    Gate,
    Geometry,
    Given,
    Imported,
    Lost,
    Mark,
    StreamCounts,
    StreamRecord,
    TrialClockMaps,
    TrialQuality,
    TrialRecord,
)
from sliplab.storage.streams import EVENTS_KIND, FRAMES_KIND
from sliplab.storage.trials.checksums import DATA, stream_file
from sliplab.storage.trials.hdf5_reader import StreamReader

FORMAT = "record"
INCIPIENT, GROSS = ("slip", "incipient"), ("gross",)
"""Names of marks that are onsets; only the first of each counts."""


class BegunTrial(BaseModel):
    """A trial that was begun, as it is kept beside its files until it is committed.

    Attributes:
        begin_ns: on the host's clock. started: UTC, ISO 8601.
        dropped: rows that were left out so far, by reason.
        tap: two sensors that felt the same taps. pulses: see `plugins.record.pulsed`.
    """

    trial: str
    campaign: str
    experiment: str
    repetition: int
    condition: dict[str, str]
    simulated: bool
    begin_ns: int
    started: str
    operator: str = ""
    sources: dict[str, SourceAbout]
    marks: list[Mark] = Field(default_factory=list)
    dropped: dict[str, int] = Field(default_factory=dict)
    tap: tuple[str, str] | None = None
    pulses: tuple[str, ...] | None = None


def make_record(
    folder: Path,
    begun: BegunTrial,
    end_ns: int,
    warnings: tuple[str, ...] = (),
    *,
    lost: Lost | None = None,
    devices: Mapping[str, Any] | None = None,
) -> TrialRecord:
    """Return the record of a trial whose files are complete; their clocks are fitted.

    Args:
        end_ns: of the trial, on the host's clock.
        lost: of a trial that was cut.
        devices: what devices report, by name.
    """
    span = begun.begin_ns, max(end_ns, begun.begin_ns + 1)
    streams = _streams(folder, begun)
    counted = {name: rows for name, (rows, _) in streams.items()}
    present = {name: each for name, each in begun.sources.items() if counted.get(name)}
    tapped = [mark.t_ns for mark in begun.marks if mark.name == TAP]
    clocks = fit_clocks(folder, present, span, begun.tap, tapped, begun.pulses)
    gates = {
        f"clock_{name}": Gate(passed=False, value=why)
        for name, why in clocks.refused.items()
        if name in FIRST_CAMERAS  # which the analysis works on
    }
    marks = tuple(sorted(begun.marks, key=lambda mark: mark.t_ns))
    inside = [mark for mark in marks if span[0] <= mark.t_ns <= span[1]]
    notes = [f"mark {m.name} lies outside of the trial" for m in marks if m not in inside]
    notes += [f"nothing came from {name}" for name in begun.sources if name not in present]
    notes += [f"{name}: {each.doubt}" for name, each in present.items() if each.doubt]
    notes += clocks.common
    notes += [f"the clock of {name} is not known: {why}" for name, why in clocks.refused.items()]
    about: dict[str, Any] = {
        "format": FORMAT,
        "from": "sliplab record",
        "epoch": "the host's monotonic clock",
        "unknown": () if begun.condition else ("condition",),
        "warnings": (*warnings, *notes),
        "span_ns": span,
    }
    more = {
        "given": _given(inside),
        "marks": marks,
        "lost": lost,
        "dropped": begun.dropped,
    }
    about |= {key: value for key, value in more.items() if value}
    named = {name: record for name, (_, record) in streams.items() if name not in FIRST_CAMERAS}
    first = {name: begun.sources[name].record for name in FIRST_CAMERAS if name in begun.sources}
    record = TrialRecord(
        format=TrialRecord.FORMAT,
        trial=begun.trial,
        campaign=begun.campaign,
        experiment=begun.experiment,
        role="imported",
        block=0,
        repetition=begun.repetition,
        attempt=0,
        condition=begun.condition,
        simulated=begun.simulated,
        recorded_s=(span[1] - span[0]) / 1e9,
        counts=StreamCounts(
            events=counted.get(EVENTS_KIND, 0),
            frames=counted.get(FRAMES_KIND, 0),
            poses=0,
            pulses=0,
        ),
        clocks=_maps(clocks),
        quality=TrialQuality(passed=not gates, gates=gates),
        geometry=Geometry(
            event_px=first[EVENTS_KIND].size_px
            if counted.get(EVENTS_KIND) and EVENTS_KIND in first
            else None,
            frame_px=first[FRAMES_KIND].size_px if FRAMES_KIND in first else None,
        ),
        imported=Imported.model_validate(about),
    )
    further = {"streams": named, "devices": dict(devices or {})}
    return record.model_copy(update={name: value for name, value in further.items() if value})


def _maps(clocks: Clocks) -> TrialClockMaps:
    streams = {name: each for name, each in clocks.found.items() if name not in FIRST_CAMERAS}
    first = {name: each for name, each in clocks.found.items() if name in FIRST_CAMERAS}
    found: dict[str, Any] = {"reference": "host", **first}
    found |= {"refused": clocks.refused} if clocks.refused else {}
    found |= {"streams": streams} if streams else {}
    return TrialClockMaps(**found)


def _streams(folder: Path, begun: BegunTrial) -> dict[str, tuple[int, StreamRecord]]:
    """Return the rows and record of every stream in the files."""
    found: dict[str, tuple[int, StreamRecord]] = {}
    with StreamReader(folder / DATA) as reader:
        counts = reader.counts()
        for name, parts in reader.stream_counts().items():
            rows = parts["t"]
            kind = reader.streams()[name]
            known = begun.sources.get(name)
            record = StreamRecord(kind=kind, rows=rows) if known is None else known.record
            found[name] = rows, record.model_copy(update={"rows": rows})
    for name in FIRST_CAMERAS:
        if name in begun.sources:
            rows = counts[f"{name}/t"]
            found[name] = rows, begun.sources[name].record
    for name, source in begun.sources.items():
        if source.record.of_camera and name not in FIRST_CAMERAS:
            with StreamReader(folder / stream_file(name)) as camera:
                counts = camera.counts()
            rows = counts[f"{source.record.kind}/t"]
            more: dict[str, Any] = {"rows": rows}
            if source.record.kind == EVENTS_KIND:
                more["pulses"] = counts["event_pulses/t"]
            found[name] = rows, source.record.model_copy(update=more)
    return found


def _given(marks: Sequence[Mark]) -> Given | None:
    """Return the onsets that marks state, and the bound of their error."""
    first: dict[str, Mark] = {}
    for mark in marks:
        key = {**dict.fromkeys(INCIPIENT, "incipient_ns"), **dict.fromkeys(GROSS, "gross_ns")}
        if mark.name in key:
            first.setdefault(key[mark.name], mark)
    if not first:
        return None
    errors = [mark.uncertainty_ns for mark in first.values()]
    bound = None if None in errors else max(error for error in errors if error is not None)
    onsets: dict[str, Any] = {key: mark.t_ns for key, mark in first.items()}
    return Given(source="marks", uncertainty_ns=bound, **onsets)
