"""Recordings of every format of events that import reads, with the same 3,000 events in each."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import hdf5plugin
import numpy as np

from sliplab.plugins.formats.ros import messages as ros2
from sliplab.storage.formats.aedat4 import Aedat4Stream, Aedat4Writer
from sliplab.storage.formats.flatbuffers import events_buffer
from sliplab.storage.formats.foreign import Triggers
from sliplab.storage.streams import EventChunk

COUNT, PACKET = 3000, 100
SIZE = (640, 480)


def all_events(count: int = COUNT) -> EventChunk:
    """Random pixels and polarities in order of time."""
    rng = np.random.default_rng(7)
    return EventChunk(
        rng.integers(0, SIZE[0], count).astype(np.uint16),
        rng.integers(0, SIZE[1], count).astype(np.uint16),
        rng.integers(0, 2, count).astype(np.uint8),
        np.cumsum(rng.integers(0, 60, count)).astype(np.int64),
    )


def write_aedat4(path: Path) -> None:
    """Packets of 100 events, a trigger with each, a frame with every tenth."""
    streams = {
        0: Aedat4Stream("EVTS", "events", SIZE, "camera"),
        1: Aedat4Stream("FRME", "frames", (8, 6), "camera"),
        2: Aedat4Stream("TRIG", "triggers", None, "camera"),
    }
    whole = all_events()
    with Aedat4Writer(path, streams) as file:
        for number, low in enumerate(range(0, COUNT, PACKET)):
            file._write(0, events_buffer(whole[low : low + PACKET]))
            t_us = int(whole.t_us[low])
            file.triggers(2, Triggers(np.array([t_us]), np.array([1], np.uint8)))
            if number % 10 == 0:
                file.picture(1, np.full((6, 8), number, np.uint8), t_us)


def write_dsec(path: Path, *, newest: bool = False, **storage: Any) -> None:
    """Chunks that were appended as a recorder appends them: the columns take turns."""
    whole = all_events()
    columns = {"x": whole.x, "y": whole.y, "p": whole.p, "t": whole.t_us}
    storage = storage or dict(hdf5plugin.Blosc(cname="zstd"))
    with h5py.File(path, "w", libver="latest" if newest else "earliest") as file:
        for name, values in columns.items():
            file.create_dataset(
                f"events/{name}", (0,), values.dtype, maxshape=(None,), chunks=(PACKET,), **storage
            )
        for low in range(0, COUNT, PACKET):
            for name, values in columns.items():
                file[f"events/{name}"].resize((low + PACKET,))
                file[f"events/{name}"][low:] = values[low : low + PACKET]
            file.flush()


def write_contiguous(path: Path) -> None:
    """DSEC's layout, one column after the other."""
    whole = all_events()
    with h5py.File(path, "w") as file:
        file["events/x"], file["events/y"] = whole.x, whole.y
        file["events/p"], file["events/t"] = whole.p, whole.t_us


def write_lab(path: Path) -> None:
    """The lab's layout in chunks: seconds as floats."""
    whole = all_events()
    columns = {"xs": whole.x, "ys": whole.y, "ps": whole.p, "ts": whole.t_us / 1e6}
    with h5py.File(path, "w") as file:
        for name, values in columns.items():
            file.create_dataset(f"events/{name}", data=values, chunks=(500,), compression="gzip")
        file.attrs["sensor_resolution"] = np.array(SIZE)


def write_mcap(path: Path, chunk_bytes: int = 2000) -> None:
    """Packets of 100 events, and a frame with every tenth."""
    from mcap.writer import CompressionType, Writer

    whole = all_events()
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=chunk_bytes, compression=CompressionType.ZSTD)
        writer.start(profile="ros2", library="a recorder")
        channels = {}
        for topic, kind in (("/dvs/events", ros2.EVENTS), ("/image", ros2.IMAGE)):
            schema = writer.register_schema(kind, "ros2msg", ros2.definition(kind))
            channels[topic] = writer.register_channel(topic, "cdr", schema)
        for seq, low in enumerate(range(0, COUNT, PACKET)):
            part = whole[low : low + PACKET]
            t_ns = int(part.t_us[0]) * 1000
            data = ros2.event_packet(t_ns, "dvs", SIZE, seq, part)
            writer.add_message(channels["/dvs/events"], t_ns, data, t_ns, seq)
            if seq % 10 == 0:
                image = ros2.image(t_ns, "dvs", np.full((6, 8), seq, np.uint8))
                writer.add_message(channels["/image"], t_ns, image, t_ns, seq)
        writer.finish()


def write_es(path: Path) -> None:
    """Change events: 7 bits of time with the polarity, column and row; 255 lets 127 us pass."""
    whole = all_events()
    made = bytearray(b"Event Stream\2\0\0\1" + struct.pack("<HH", *SIZE))
    steps = np.diff(whole.t_us, prepend=0).tolist()
    for x, y, p, step in zip(whole.x, whole.y, whole.p, steps, strict=True):
        made += b"\xff" * (step // 127)
        made += struct.pack("<BHH", step % 127 << 1 | int(p), int(x), SIZE[1] - 1 - int(y))
    path.write_bytes(made)


def write_evt2(path: Path) -> None:
    """Words of 32 bits: events, and high parts of the time between them."""
    whole = all_events()
    words = []
    high = -1
    for x, y, p, t in zip(*(column.tolist() for column in vars(whole).values()), strict=True):
        if t >> 6 != high:
            high = t >> 6
            words.append(8 << 28 | high)
        words.append(p << 28 | (t & 63) << 22 | x << 11 | y)
    path.write_bytes(
        b"% evt 2.0\n% format EVT2;width=640;height=480\n" + struct.pack(f"<{len(words)}I", *words)
    )


def write_evt3(path: Path) -> None:
    """Words of 16 bits that say what changed; events one by one and as vectors of one pixel."""
    whole = all_events()
    words = []
    high = low = row = -1
    for x, y, p, t in zip(*(column.tolist() for column in vars(whole).values()), strict=True):
        if t >> 12 != high:
            high, low = t >> 12, 0
            words.append(8 << 12 | high)
        if t & 0xFFF != low:
            low = t & 0xFFF
            words.append(6 << 12 | low)
        if y != row:
            row = y
            words.append(row)
        if x % 2:
            words.append(2 << 12 | p << 11 | x)
        else:
            words += [3 << 12 | p << 11 | x - x % 32, 4 << 12, 4 << 12, 5 << 12]
            at = x % 32
            words[-3 + at // 12] |= 1 << at % 12
    path.write_bytes(
        b"% evt 3.0\n% format EVT3;height=480;width=640\n% end\n"
        + struct.pack(f"<{len(words)}H", *words)
    )


def write_dat(path: Path) -> None:
    """Words of 64 bits, one an event."""
    whole = all_events()
    x, y, p, t = (column.astype(np.uint64) for column in vars(whole).values())
    words = t | x << np.uint64(32) | y << np.uint64(46) | p << np.uint64(60)
    path.write_bytes(b"% Version 2\n% Width 640\n% Height 480\n\x0c\x08" + words.tobytes())


FILES: dict[str, tuple[str, Callable[[Path], None]]] = {
    "aedat4": ("a.aedat4", write_aedat4),
    "dsec": ("a.h5", write_dsec),
    "dsec newest": ("a.h5", lambda path: write_dsec(path, newest=True)),
    "dsec checked": ("a.h5", lambda path: write_dsec(path, fletcher32=True)),
    "contiguous": ("a.h5", write_contiguous),
    "lab": ("a.h5", write_lab),
    "mcap": ("a.mcap", write_mcap),
    "es": ("a.es", write_es),
    "evt2": ("a.raw", write_evt2),
    "evt3": ("a.raw", write_evt3),
    "dat": ("a.dat", write_dat),
}
CHECKED = {"dsec checked", "mcap"}
"""Formats whose packets have checksums, so that no damage goes by unseen."""
HEADERS = {
    "aedat4": 1354,
    "dsec": 4096,
    "dsec newest": 2048,
    "dsec checked": 4096,
    "contiguous": 2048,
    "lab": 2048,
    "mcap": 300,
    "es": 20,
    "evt2": 44,
    "evt3": 50,
    "dat": 40,
}
"""Bytes at the beginning of each that describe it."""
