"""The clock of a recorded stream by pulses that another one saw, as `sliplab align` fits them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from sliplab.plugins.record.table import PULSES
from sliplab.plugins.record.tapped import closer, known_error_ns
from sliplab.protocols.plugin import plugins
from sliplab.storage.schema.trial import DeviceRecord
from sliplab.storage.streams import I64
from sliplab.storage.trials.hdf5_writer import STREAM_GROUP

if TYPE_CHECKING:
    from sliplab.storage.trials.hdf5_reader import StreamReader

PULSE = "pulses"
_KNOTS = 33


def clocks_by_pulses(
    reader: StreamReader, names: tuple[str, ...], known: dict[str, DeviceRecord]
) -> dict[str, DeviceRecord]:
    """Return the clocks of the first of two streams, and of further ones that share it.

    Args:
        names: of streams that saw the same pulses; from the third on, those of the first's clock.
        known: clocks by other means, of all but perhaps the first.

    Raises:
        ValueError: no map can be trusted, or it contradicts what is known by other means.
    """
    error_ns = known_error_ns(names[1], known[names[1]])
    (how, own, own_half), (how_too, other, other_half) = (_pulses(reader, n) for n in names[:2])
    if how != how_too:
        raise ValueError(f"{names[0]} has a column {how}, {names[1]} one of {how_too}")
    there = (known[names[1]].map.to_reference(other[0]), other[1])
    sides = (each if how in {"harp", "id"} else each[0] for each in (own, there))
    found = plugins().hook("align")(*sides, harp=how == "harp")
    if len(found.stretches) > 1:
        raise ValueError(f"its clock jumped {len(found.jumps)} times against that of {names[1]}")
    result = {}
    for name in (names[0], *names[2:]):
        t_ns = reader.column(f"{STREAM_GROUP}/{name}/t")
        if np.any(np.diff(t_ns) < 0):
            raise ValueError(f"the times of {name} fall back")
        at = np.unique(np.linspace(0, t_ns[-1] - t_ns[0], _KNOTS).astype(np.int64)) + t_ns[0]
        times = found.map(at)
        if not times.known.all():
            raise ValueError(f"pulses do not cover {name}")
        more = round(error_ns + own_half + other_half)
        about = {"grade": PULSE, "kind": "95 %", "pairs": found.stretches[0].events}
        result[name] = closer(known.get(name), at, times.low_ns - more, times.high_ns + more, about)
    return result


def _pulses(reader: StreamReader, name: str) -> tuple[str, tuple[I64, Any], float]:
    """Return what tells a stream's pulses, their times and ids or levels, and their error, ns."""
    group = f"{STREAM_GROUP}/{name}"
    how = next((part for part in PULSES if reader.has(f"{group}/{part}")), None)
    if how is None:
        raise ValueError(f"{name} has no column {', '.join(PULSES)}")
    t_ns, values = reader.column(f"{group}/t"), reader.column(f"{group}/{how}")
    if not np.isfinite(values).all():
        raise ValueError(f"{name}: {how} is not a number in {np.sum(~np.isfinite(values))} rows")
    if how == "id":
        return how, (t_ns, values.astype(np.int64)), 0.0
    high = values > 0
    if how == "harp" or high.all():
        return how, (t_ns, high), 0.0
    rises = np.flatnonzero(high[1:] & ~high[:-1]) + 1
    if not rises.size:
        raise ValueError(f"{name} saw no pulse")
    if (high[1:] != high[:-1]).all():  # rows are edges
        return how, (t_ns[rises], None), 0.0
    step = t_ns[rises] - t_ns[rises - 1]  # rows are samples: it rose in between
    return how, (t_ns[rises] - step // 2, None), float(step.max()) / 2
