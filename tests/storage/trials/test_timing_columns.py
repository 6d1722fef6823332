"""Extra columns of a rig without trigger wiring: exposures and clock reads, only if present."""

from pathlib import Path

import h5py
import hdf5plugin  # noqa: F401  (registers the filters)
import numpy as np
import pytest

from sliplab.storage.schema.trial import Provenance
from sliplab.storage.streams import ClockReads, ExposureChunk, PulseChunk
from sliplab.storage.trials.hdf5_reader import StreamReader
from sliplab.storage.trials.hdf5_writer import TIMING
from sliplab.storage.trials.store import TrialStore
from sliplab.storage.trials.verify import verify
from sliplab.storage.trials.writer import TrialWriter
from tests.storage.trial_files import FRAME, campaign, fill, record

EMPTY = np.empty(0, np.int64)
COUNT = 20_000
"""More rows than are held back."""


def reads(count: int, seed: int) -> ClockReads:
    """Reads a millisecond apart."""
    rng = np.random.default_rng(seed)
    before = np.arange(count, dtype=np.int64) * 1_000_000
    inside = rng.integers(100_000, 200_000, (2, count))
    return ClockReads(before + inside[0] + 2**61, before, before + inside.sum(0))


BOX, CAMERA = reads(COUNT, 1), reads(300, 2)
EXPOSURES = PulseChunk(np.arange(COUNT, dtype=np.int64) * 10_000_000)


def write(writer: TrialWriter, pieces: int) -> Path:
    """A committed trial with all of it, in some pieces."""
    fill(writer)
    for chunk in (BOX, CAMERA):
        for rows in np.array_split(np.arange(len(chunk)), pieces):
            writer.add("sync_box" if chunk is BOX else "frames", chunk[rows])
    for part in np.array_split(EXPOSURES.t_ns, pieces):
        writer.add("sync_box", ExposureChunk(part))
    return writer.commit(record("t"), Provenance())


@pytest.mark.parametrize("pieces", [1, 7])
def test_they_come_back_however_they_were_chunked(pieces: int, tmp_path: Path) -> None:
    folder = write(campaign(tmp_path / "s").begin("t", FRAME, 100), pieces)
    with StreamReader(folder / "data.h5") as reader:
        assert np.array_equal(reader.pulses("exposures"), EXPOSURES.t_ns)
        for group, sent in (("box_reads", BOX), ("frame_camera_reads", CAMERA)):
            found = reader.clock_reads(group)
            assert len(found) == len(sent)
            for name in ("device_ns", "before_ns", "after_ns"):
                assert np.array_equal(getattr(found, name), getattr(sent, name))
        counts = reader.counts()
    assert (counts["exposures/t"], counts["frame_camera_reads/after"]) == (COUNT, 300)
    assert verify(TrialStore.open(tmp_path / "s")) == []
    with h5py.File(folder / "data.h5") as file:
        for name in TIMING.keys() - {"triggers/t", "triggers/kind"}:  # of imported trials
            assert file[name].attrs["unit"].startswith("ns of the ")


def test_the_same_reads_are_the_same_bytes(tmp_path: Path) -> None:
    folders = [write(campaign(tmp_path / name).begin("t", FRAME, 100), 3) for name in "ab"]
    one, other = ((folder / "data.h5").read_bytes() for folder in folders)
    assert one == other


def test_nothing_is_made_where_nothing_comes(tmp_path: Path) -> None:
    where, data = campaign(tmp_path / "s"), []
    for name in ("plain", "empty"):
        writer = where.begin(name, FRAME, 100)
        if name == "empty":
            writer.add("sync_box", ExposureChunk(EMPTY))
            writer.add("sync_box", ClockReads(EMPTY, EMPTY, EMPTY))
            writer.add("frames", ClockReads(EMPTY, EMPTY, EMPTY))
        fill(writer)
        data.append(writer.commit(record(name), Provenance()) / "data.h5")
    assert data[0].read_bytes() == data[1].read_bytes()
    with StreamReader(data[0]) as reader:
        assert not any(reader.has(name) for name in TIMING)
        assert len(reader.pulses("exposures")) == 0
        assert reader.pulses("exposures").dtype == np.int64
        assert len(reader.clock_reads("box_reads")) == 0
        assert len(reader.clock_reads("frame_camera_reads")) == 0
        assert reader.counts()["exposures/t"] == 0


def test_verify_sees_a_clock_that_was_read_backwards(tmp_path: Path) -> None:
    writer = campaign(tmp_path / "s").begin("t", FRAME, 100)
    fill(writer)
    writer.add("sync_box", BOX[:2])
    writer.add("sync_box", BOX[:1])
    writer.commit(record("t"), Provenance())
    said = [problem.what for problem in verify(TrialStore.open(tmp_path / "s"))]
    assert said == [f"box_reads/{name} runs backwards" for name in ("t", "before", "after")]
