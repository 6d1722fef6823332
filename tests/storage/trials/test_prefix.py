"""What is kept of a trial whose program was killed between two writes of HDF5."""

from __future__ import annotations

import json
from pathlib import Path

import h5py
import numpy as np

from sliplab.storage.streams import EventChunk, PulseChunk
from sliplab.storage.trials.checksums import DATA
from sliplab.storage.trials.hdf5_writer import StreamFile
from sliplab.storage.trials.prefix import keep_prefix
from sliplab.storage.trials.prefix_journal import JOURNAL
from sliplab.storage.trials.superblock import HEAD_BYTES

ROWS = 50_000


def test_a_superblock_that_is_older_than_the_rest_costs_nothing(tmp_path: Path) -> None:
    """It says where the file ends, and HDF5 writes it last."""
    expected = {"events": (EventChunk.empty(), PulseChunk.empty())}
    path = tmp_path / DATA
    file, states = StreamFile(path, expected), []
    for number in range(4):
        t_us = np.arange(number * ROWS, (number + 1) * ROWS)
        x, y, p = t_us % 64, t_us // 64 % 48, t_us % 2
        file.add("events", EventChunk(*(a.astype("u2") for a in (x, y)), p.astype("u1"), t_us))
        states.append({**file.mark(), "images": [0, 0]})
        if number == 0:
            old = path.read_bytes()[:HEAD_BYTES]
    killed = old + path.read_bytes()[HEAD_BYTES:]
    file.finish()
    path.write_bytes(killed)
    (tmp_path / JOURNAL).write_text("".join(json.dumps({"": state}) + "\n" for state in states))
    assert keep_prefix(tmp_path) == {"": states[-1]}
    with h5py.File(path) as kept:
        np.testing.assert_array_equal(kept["events/x"][:], np.arange(4 * ROWS) % 64)
