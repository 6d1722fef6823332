"""A lab's own format: a line, and column, row, polarity and time (us) of each event, 64 bits each.

`sliplab import FILE` recognises it, `--salvage` reads what a cut file still has, and `sliplab
export --as ticks` writes it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from sliplab.protocols.plugin import Plugin
from sliplab.storage.formats.foreign import Damage, ForeignTrial, FormatError, event_chunk
from sliplab.storage.formats.format import Format
from sliplab.storage.schema.trial import Lost
from sliplab.storage.streams import EventChunk
from sliplab.storage.trials.recording import Recording

LINE = b"ticks\n"
ROW_BYTES, AT_ONCE = 32, 1 << 16


def sniff(path: Path, head: bytes) -> bool:
    """Return whether a file begins as one of this format."""
    return head.startswith(LINE)


def read(path: Path, name: str) -> ForeignTrial:
    """Read a whole file."""
    trial = salvage(path, name)
    if trial.lost is not None:
        raise Damage(trial.lost.reason)
    return trial


def salvage(path: Path, name: str) -> ForeignTrial:
    """Read the whole rows of a file, a few at a time: it may be larger than the memory."""
    with path.open("rb") as file:
        if file.read(len(LINE)) != LINE:
            raise FormatError("is no file of ticks")
    rows, rest = divmod(path.stat().st_size - len(LINE), ROW_BYTES)

    def events() -> Iterator[EventChunk]:
        with path.open("rb") as file:
            file.seek(len(LINE))
            for low in range(0, rows, AT_ONCE):
                count = min(AT_ONCE, rows - low)
                found = np.frombuffer(file.read(count * ROW_BYTES), "<i8").reshape(-1, 4)
                yield event_chunk(*found.T)

    trial = ForeignTrial(name, path.name, events, "the start of the recording")
    if not rest:
        return trial
    end = path.stat().st_size - rest
    reason = f"is cut short: its last {rest} bytes are no whole row"
    return replace(trial, lost=Lost(at_byte=end, unread_bytes=rest, reason=reason))


def export(recording: Recording, path: Path, stream: str) -> dict[str, int]:
    """Write the events of a trial."""
    count = 0
    with path.open("wb") as file, recording.open(stream) as reader:
        file.write(LINE)
        for chunk in reader.event_chunks():
            rows = np.stack([chunk.x, chunk.y, chunk.p, chunk.t_us], axis=1)
            file.write(rows.astype("<i8").tobytes())
            count += len(chunk)
    return {"events": count, "frames": 0, "triggers": 0}


PLUGIN = Plugin(formats={"ticks": "lab_ticks:TICKS"})
TICKS = Format((".tick",), sniff, read, salvage, export=export)
