"""Clocks of a recorded trial: each stream's map onto the host's clock, or why there is none.

The host's clock takes the place of the sync box, so the maps are fitted as those of a rig are
(`analysis.clocks.synchronise`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from sliplab.analysis.clocks.synchronise import (
    ClockInput,
    clocks_in,
    streams_of,
    synchronise,
)
from sliplab.plugins.record.pulsed import clocks_by_pulses
from sliplab.plugins.record.shared_clock import SHARED, explained
from sliplab.plugins.record.sources import (
    CLOCK_STREAM,
    FIRST_CAMERAS,
    HOST,
    TIMING,
    SourceAbout,
)
from sliplab.plugins.record.tapped import ContradictionError, clock_by_taps
from sliplab.protocols.timing import StreamTiming, Timing
from sliplab.storage.clockmap import IDENTITY
from sliplab.storage.schema.trial import DeviceRecord
from sliplab.storage.streams import CLOCK, EVENTS_KIND, FRAMES_KIND, I64, ClockReads
from sliplab.storage.trials.checksums import DATA, stream_file
from sliplab.storage.trials.hdf5_reader import StreamReader
from sliplab.storage.trials.hdf5_writer import STREAM_GROUP
from sliplab.storage.trials.verify import falls

AHEAD_NS = 1_000_000_000
"""How long after they came times of the host's clock may lie where no error is stated."""

DRIFT_S, LEAST_ARRIVALS = 0.2, 20
"""By how much times must drift steadily from their arrival to be of another clock, seconds; and how
many arrivals say so."""


@dataclass(frozen=True)
class Clocks:
    """Maps onto the host's clock by stream, why others have none, and why there is none by taps
    or pulses."""

    found: dict[str, DeviceRecord] = field(default_factory=dict)
    refused: dict[str, str] = field(default_factory=dict)
    common: list[str] = field(default_factory=list)

    def contradict(self, why: str, *names: str) -> None:
        """Refuse clocks that common events and arrivals put in different places."""
        for name in names:
            self.found.pop(name, None)
            self.refused[name] = why


def fit_clocks(
    folder: Path,
    sources: Mapping[str, SourceAbout],
    span_ns: tuple[int, int],
    tap: tuple[str, str] | None = None,
    taps_ns: Sequence[int] = (),
    pulses: tuple[str, ...] | None = None,
) -> Clocks:
    """Fit the clocks of a sealed trial.

    Args:
        sources: streams that have rows.
        span_ns: begin and end of the trial on the host's clock.
        tap, taps_ns: see `plugins.record.tapped`. pulses: see `plugins.record.pulsed`.
    """
    result = _fitted(folder, sources, span_ns)
    known = result.found
    with StreamReader(folder / DATA) as reader:
        if tap is not None and known.keys() >= set(tap):
            try:
                known[tap[0]] = clock_by_taps(reader, tap, sources[tap[0]], known, taps_ns)
            except ContradictionError as error:
                result.contradict(f"taps: {error}", tap[0])
            except ValueError as error:
                result.common.append(f"the clock of {tap[0]} by taps: {error}")
        # which also time a clock that its arrivals could not bound
        if pulses is not None and pulses[0] in sources and pulses[1] in known:
            shared = tuple(name for name in pulses[2:] if name in known)
            try:
                known.update(clocks_by_pulses(reader, (*pulses[:2], *shared), known))
                result.refused.pop(pulses[0], None)
            except ContradictionError as error:
                result.contradict(f"pulses: {error}", pulses[0], *shared)
            except ValueError as error:
                result.common.append(f"the clock of {pulses[0]} by pulses: {error}")
    return result


def _fitted(folder: Path, sources: Mapping[str, SourceAbout], span_ns: tuple[int, int]) -> Clocks:
    result = Clocks()
    timed = {}
    for name, source in sources.items():
        if (wrong := _wrong_times(folder, name, source, span_ns)) is not None:
            result.refused[name] = wrong
        elif source.clock == HOST:
            error = source.uncertainty_ns
            result.found[name] = DeviceRecord(grade=HOST, map=IDENTITY, uncertainty_ns=error)
        else:
            timed[name] = source
    if not timed:
        return result
    by_timing = {
        name: each.record
        for name, each in timed.items()
        if each.clock == TIMING and name not in FIRST_CAMERAS
    }
    inputs, errors = clocks_in(folder, by_timing), {}
    with StreamReader(folder / DATA) as reader:
        for name, source in timed.items():
            if source.clock != TIMING:
                timing = source.record.timing or StreamTiming()
                how = timing.model_copy(update={"grade": "device time stamps"})
                reads, errors[name] = _reads(reader, name)
                inputs[name] = ClockInput(how, reads=reads)
            elif name in FIRST_CAMERAS:
                mid_ns = source.record.mid_exposure_ns or 0
                reads = reader.clock_reads("frame_camera_reads")
                inputs[name] = ClockInput(source.record.timing, reads=reads, mid_exposure_ns=mid_ns)
        streams = streams_of(reader, None, inputs)
    host = np.array([span_ns[0], sum(span_ns) // 2, span_ns[1]], np.int64)
    streams = replace(streams, named=inputs, box_reads=ClockReads(host, host, host))
    fitted = synchronise(streams, Timing(arm="host time"), 1, with_events=False)
    for name in timed:
        if name not in fitted.devices:
            shared = timed[name].clock in SHARED
            why = explained(timed[name].clock, inputs[name].reads) if shared else ""
            result.refused[name] = why or fitted.refused[name]
            continue
        record, error = fitted.devices[name].record(), errors.get(name, 0)
        source = timed[name]
        changed: dict[str, Any] = {"uncertainty_ns": (record.uncertainty_ns or 0.0) + error}
        if source.clock in SHARED:
            changed["grade"] = source.clock
            changed["uncertainty_ns"] += source.uncertainty_ns or 0.0
        result.found[name] = record.model_copy(update=changed)
    return result


def _wrong_times(
    folder: Path, name: str, source: SourceAbout, span_ns: tuple[int, int]
) -> str | None:
    """Return why a stream's times cannot be right whatever its clock; None if they can."""
    if not source.record.of_camera:  # whose times do not fall back: late rows are left out
        with StreamReader(folder / DATA) as reader:
            fallen = list(islice(falls(reader, f"{STREAM_GROUP}/{name}/t"), 2))
        if fallen:
            why = "the clock was set, or several clocks stamped the rows"
            where = " and ".join(f"row {row + 1}" for row in fallen)
            return f"its times fall back at {where}: {why}"
    if source.clock != HOST:
        return None
    own, came, row = _arrivals(folder, name, source)
    if not own.size:
        return None
    furthest = int((own - came).argmax())
    ahead_ns, newest_ns = int((own - came)[furthest]), int(own.max())
    most_ns = AHEAD_NS if source.uncertainty_ns is None else source.uncertainty_ns
    if ahead_ns > most_ns:
        what = "row" if source.record.kind != EVENTS_KIND else "reading"
        return (
            f"its times lie up to {ahead_ns / 1e9:.6f} s after they came, at {what} "
            f"{row[furthest] + 1}"
        )
    if newest_ns < span_ns[0] - most_ns:
        before_s = (span_ns[0] - newest_ns) / 1e9
        return f"all its times lie before the trial, by {before_s:.6f} s at least"
    came, newest = np.unique(came, return_index=True)  # of rows that came together the first
    if came.size < LEAST_ARRIVALS:
        return None
    late_s = (came - own[newest]) / 1e9
    slope, start = np.polyfit(seconds := (came - came[0]) / 1e9, late_s, 1)
    gained_s = slope * seconds[-1]
    rest_s = float(np.std(late_s - start - slope * seconds))
    if abs(gained_s) > max(DRIFT_S, 8 * rest_s):
        slow = "fall behind their arrival", "slow, or the program pushes ever later"
        what, why = (
            slow if slope > 0 else ("run ahead of their arrival", "fast, or of another unit")
        )
        return f"its times {what} by {abs(1000 * slope):.3g} ms a second: its clock is {why}"
    return None


def _arrivals(folder: Path, name: str, source: SourceAbout) -> tuple[I64, I64, I64]:
    """Return the times of some thousand rows, when they came, ns, and the rows; of events of the
    newest."""
    file, group, came = DATA, f"{STREAM_GROUP}/{name}", "host"
    if source.record.kind == EVENTS_KIND:
        group, came = f"{STREAM_GROUP}/{CLOCK_STREAM.format(name)}", "after"
    elif source.record.kind == FRAMES_KIND:
        file, group = DATA if name in FIRST_CAMERAS else stream_file(name), FRAMES_KIND
    with StreamReader(folder / file) as reader:
        if not reader.has(f"{group}/{came}"):
            return (np.empty(0, np.int64),) * 3
        parts = zip(
            reader.column_parts(f"{group}/t"), reader.column_parts(f"{group}/{came}"), strict=True
        )
        found, begin = [], 0
        for own, host in parts:
            some = np.arange(0, len(own), max(1, len(own) // 1000))
            some = np.r_[some, np.argmax(own), np.argmax(own - host)]
            found.append(np.stack([own[some], host[some], begin + some]))
            begin += len(own)
    times = np.concatenate(found, axis=1)
    order = np.argsort(times[1], kind="stable")
    return times[0, order], times[1, order], times[2, order]


def _reads(reader: StreamReader, name: str) -> tuple[ClockReads, int]:
    """Return the readings of a stream's clock, and what else its times may be off, ns.

    Some thousand readings say as much as all.
    """
    group = f"{STREAM_GROUP}/{CLOCK_STREAM.format(name)}"
    t_ns, before, after, error = (reader.column(f"{group}/{part}") for part in CLOCK.columns)
    # an odd step: of a shared clock every other reading is an arrival
    some = slice(None, None, max(1, len(t_ns) // 4000) | 1)
    reads = ClockReads(t_ns[some], (before - error)[some], (after + error)[some])
    return reads, int(error.max(initial=0))
