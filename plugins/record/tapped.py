"""The clock of a recorded sensor by taps that another one felt, where that is known closer."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from sliplab.analysis.clocks.pulse_match import NoMatchError
from sliplab.analysis.clocks.synchronise import HOST_PPM
from sliplab.analysis.clocks.taps import Taps, find_taps, map_by_taps
from sliplab.plugins.record.sources import HOST, READS, TIMING, Source, SourceAbout
from sliplab.plugins.record.table import PULSES
from sliplab.protocols.errors import InputError
from sliplab.protocols.timing import StreamTiming
from sliplab.storage.clockmap import ClockMap
from sliplab.storage.schema.trial import DeviceRecord
from sliplab.storage.streams import I64
from sliplab.storage.trials.hdf5_writer import STREAM_GROUP

if TYPE_CHECKING:
    from sliplab.storage.trials.hdf5_reader import StreamReader

TAP = "tap"
"""Name of marks that say when both were tapped."""
NEAR_NS = 1_000_000_000
"""Time on either side of such a mark in which taps are looked for."""


class ContradictionError(NoMatchError):
    """Common events and arrivals put a clock in different places."""


def check_common(key: str, names: tuple[str, ...] | str, sources: Iterable[Source]) -> None:
    """Raise InputError unless all of two or more sensors but the second have their own clock.

    Args:
        key: ``tap`` or ``pulses``, which they have in common.
    """
    known = {source.name: source for source in sources if not source.stream.about.of_camera}
    if isinstance(names, str):
        text = f"must be a tuple of names, such as {tuple(names.split(','))}"
        raise InputError(key, "", names, text)
    most = 2 if key == TAP else len(names)
    if not known.keys() >= set(names) or not 2 <= len(set(names)) == len(names) <= most:
        right = "two different" if key == TAP else "two or more different"
        text = f"must be {right} sensors of {', '.join(known) or 'which there are none'}"
        raise InputError(key, "", ", ".join(map(str, names)), text)
    for name in (names[0], *names[2:]):
        timing = known[name].stream.about.timing or StreamTiming()
        own = known[name].clock == TIMING and timing.grade == "host time"
        if not own and known[name].clock != READS:
            text = f"has no clock of its own that {key} could align; name it second"
            raise InputError(key, "", name, text)
    second = known[names[1]]
    if second.clock == HOST and second.uncertainty_ns is None:
        text = (
            f"must say how far its times may be off, for {key} to rely on: uncertainty_ms of push"
        )
        raise InputError(key, "", names[1], text)


def check_pulses(names: tuple[str, ...], sources: Iterable[Source]) -> None:
    """Raise InputError unless two sensors, which are connected, see pulses in the same way."""
    known = {source.name: source.kind for source in sources}
    seen = [next((part for part in PULSES if part in known[n].columns), "none") for n in names[:2]]
    if "none" in seen or len(set(seen)) > 1:
        text = f"have the columns {' and '.join(seen)}; must both have one of {', '.join(PULSES)}"
        raise InputError("pulses", "", ", ".join(names[:2]), text)


def clock_by_taps(
    reader: StreamReader,
    tap: tuple[str, str],
    about: SourceAbout,
    known: dict[str, DeviceRecord],
    marks_ns: Iterable[int],
) -> DeviceRecord:
    """Return the clock of the first of two sensors.

    Args:
        known: clocks by other means, of both.
        marks_ns: moments on the host's clock near which both were tapped; none: anywhere.

    Raises:
        NoMatchError: there is no clear tap, or it contradicts what is known by other means.
    """
    first, second = known[tap[0]], known[tap[1]]
    error = known_error_ns(tap[1], second)
    own_ns, own = _taps(reader, tap[0], marks_ns)
    _, other = _taps(reader, tap[1], marks_ns)
    there = (second.map.to_reference(each) for each in (other.low_ns, other.high_ns))
    low, high = there
    timing = about.record.timing or StreamTiming()
    found = map_by_taps(own, Taps(low - error, high + error), timing.drift_ppm + HOST_PPM)
    ends = np.array([own_ns[0], own_ns[-1]])
    said = {"grade": TAP, "kind": "hard bound", "pairs": found.taps}
    return closer(first, ends, *found.bounds(ends), said)


def known_error_ns(name: str, clock: DeviceRecord) -> int:
    """Return the bound of a clock's error, ns. Raises ValueError if there is none."""
    if clock.uncertainty_ns is None:
        raise ValueError(f"how far the times of {name} may be off is not stated (uncertainty_ms)")
    return round(clock.uncertainty_ns)


def closer(
    first: DeviceRecord | None, at: I64, least: I64, most: I64, about: Mapping[str, Any]
) -> DeviceRecord:
    """Return the clock by common events, or the one known by other means if that is closer.

    Args:
        first: the clock by other means, if it is known.
        at, least, most: (n,) times of the clock, and between which times on the host's they lie.
        about: what the record says of the clock by common events.

    Raises:
        ContradictionError: they contradict each other.
    """
    middle, half = least + (most - least) // 2, float((most - least).max()) / 2 + 1
    if first is not None:
        known = first.uncertainty_ns or 0
        off = np.abs(middle - first.map.to_reference(at)).max()
        if off > half + known:
            raise ContradictionError(
                "no_match",
                f"they put it {off / 1e6:.1f} ms from where its arrivals do: one of both is wrong; "
                "do rows come later than delay_ms, or did the two see different ones?",
            )
        if half >= (first.uncertainty_ns or np.inf):
            return first
    line: Any = ClockMap.through(at.tolist(), middle.tolist())
    return DeviceRecord(map=line, uncertainty_ns=half, **about)


def _taps(reader: StreamReader, name: str, marks_ns: Iterable[int]) -> tuple[Any, Taps]:
    """Return a stream's times, and the taps in it."""
    group = f"{STREAM_GROUP}/{name}"
    columns = [part for part in reader.stream_counts()[name] if part not in {"t", "host", "stamp"}]
    t_ns, host = reader.column(f"{group}/t"), reader.column(f"{group}/host")
    windows = [np.abs(host - mark) <= NEAR_NS for mark in marks_ns]
    part = np.any(windows, axis=0) if windows else slice(None)
    values = np.column_stack([reader.column(f"{group}/{each}")[part] for each in columns])
    return t_ns, find_taps(name, t_ns[part], values)
