"""Named streams besides the fixed ones: forces and torques, only where a rig has the sensor."""

from itertools import pairwise
from pathlib import Path

import h5py
import hdf5plugin  # noqa: F401  (registers the filters)
import numpy as np
import pytest

from sliplab.storage.errors import StoreError
from sliplab.storage.schema.trial import Provenance
from sliplab.storage.streams import NullSink, WrenchChunk
from sliplab.storage.trials.hdf5_reader import StreamReader
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import TrialStore
from sliplab.storage.trials.verify import verify
from sliplab.storage.trials.writer import TrialWriter
from tests.storage.trial_files import FRAME, campaign, fill, record

COUNT = 20_000
"""More rows than are held back."""
FIELDS = ("t_ns", "host_ns", "force_n", "torque_nm")


def wrenches(count: int, seed: int = 0) -> WrenchChunk:
    """Random forces at 1,000 a second, on a clock that began long ago."""
    rng = np.random.default_rng(seed)
    times = 2**61 + np.arange(count, dtype=np.int64) * 1_000_000
    late = rng.integers(100_000, 900_000, count)
    return WrenchChunk(
        times, times - 2**61 + late, rng.normal(0, 2, (count, 3)), rng.normal(0, 0.1, (count, 3))
    )


ALL = wrenches(COUNT)


def said(**rows: int) -> dict[str, dict[str, object]]:
    """What a record says of streams."""
    return {name: {"kind": "wrench", "rows": count} for name, count in rows.items()}


def write(writer: TrialWriter, pieces: int) -> Path:
    """A committed trial with two sensors, in some pieces."""
    fill(writer)
    edges = np.linspace(0, COUNT, pieces + 1).astype(int).tolist()
    for low, high in pairwise(edges):
        writer.add("force", ALL[low:high])
    writer.add("arm_force", ALL[:300])
    known = record("t", streams=said(force=COUNT, arm_force=300))
    return writer.commit(known, Provenance())


@pytest.mark.parametrize("pieces", [1, 7])
def test_they_come_back_however_they_were_chunked(pieces: int, tmp_path: Path) -> None:
    folder = write(campaign(tmp_path / "s").begin("t", FRAME, 100), pieces)
    recording = Recording(folder)
    for name, rows in (("force", slice(None)), ("arm_force", slice(0, 300))):
        found, sent = recording.wrenches(name), ALL[rows]
        assert len(found) == len(sent)
        for field in FIELDS:
            assert np.array_equal(getattr(found, field), getattr(sent, field))
            assert getattr(found, field).dtype == getattr(sent, field).dtype
    with recording.open() as reader:
        assert reader.streams() == {"arm_force": "wrench", "force": "wrench"}
        assert reader.stream_counts()["force"] == dict.fromkeys(
            ("t", "host", "force", "torque"), COUNT
        )
        assert len(reader.wrenches("none")) == 0
    assert verify(TrialStore.open(tmp_path / "s")) == []
    with h5py.File(folder / "data.h5") as file:
        group = file["streams/force"]
        assert group.attrs["kind"] == b"wrench"
        assert group["force"].attrs["unit"].startswith("N ")
        assert group["torque"].attrs["unit"].startswith("N m ")
        assert group["t"].attrs["unit"].startswith("ns of the sensor's clock")


def test_the_same_forces_are_the_same_bytes(tmp_path: Path) -> None:
    folders = [write(campaign(tmp_path / name).begin("t", FRAME, 100), 3) for name in "ab"]
    one, other = ((folder / "data.h5").read_bytes() for folder in folders)
    assert one == other


def test_nothing_is_made_where_nothing_comes(tmp_path: Path) -> None:
    where, data = campaign(tmp_path / "s"), []
    for name in ("plain", "empty"):
        writer = where.begin(name, FRAME, 100)
        if name == "empty":
            writer.add("force", WrenchChunk.empty())
        fill(writer)
        data.append(writer.commit(record(name), Provenance()))
    assert (data[0] / "data.h5").read_bytes() == (data[1] / "data.h5").read_bytes()
    with StreamReader(data[0] / "data.h5") as reader:
        assert reader.streams() == {}
        assert reader.stream_counts() == {}
        assert not reader.has("streams")
    assert b"streams" not in (data[0] / "record.json").read_bytes()
    with pytest.raises(StoreError, match="no wrench 'force'; it has: none"):
        Recording(data[0]).wrenches()


def test_a_record_knows_the_clock_of_a_stream() -> None:
    clock = {"map": {"device_ns": [5], "reference_ns": [1000], "drift": [0]}, "grade": "host time"}
    plain = record("t")
    assert "streams" not in plain.to_json()["clocks"]
    clocks = {**plain.to_json()["clocks"], "streams": {"force": {**clock, "uncertainty_ns": 5e5}}}
    found = record("t", clocks=clocks).clocks
    assert list(found.devices()) == ["events", "frames", "arm", "force"]
    assert found.against_events_ns("force") == 501_000.0


@pytest.mark.parametrize("name", ["Force", "a/b", "", "x" * 40, "../up"])
def test_a_name_is_a_small_identifier(name: str, tmp_path: Path) -> None:
    writer = campaign(tmp_path / "s").begin("t", FRAME, 100)
    with pytest.raises(ValueError, match="a name must match"):
        writer.add(name, ALL)
    writer.discard()


def test_a_sink_that_drops_everything_drops_them() -> None:
    NullSink().add("force", ALL)


@pytest.mark.parametrize(
    ("rows", "streams", "problem"),
    [
        (300, said(force=299), "300 rows of streams/force/t, the record says 299"),
        (300, {}, "streams/force is not in the record"),
        (0, said(force=3), "streams/force is not in the file"),
        (300, {"force": {"kind": "other", "rows": 300}}, "the record says 'other'"),
    ],
)
def test_verify_holds_file_and_record_against_each_other(
    rows: int, streams: dict[str, object], problem: str, tmp_path: Path
) -> None:
    writer = campaign(tmp_path / "s").begin("t", FRAME, 100)
    fill(writer)
    writer.add("force", ALL[:rows])
    writer.commit(record("t", **({"streams": streams} if streams else {})), Provenance())
    assert any(problem in found.what for found in verify(TrialStore.open(tmp_path / "s")))


def test_verify_sees_a_clock_that_runs_backwards(tmp_path: Path) -> None:
    writer = campaign(tmp_path / "s").begin("t", FRAME, 100)
    fill(writer)
    writer.add("force", ALL[:2])
    writer.add("force", ALL[:1])
    writer.commit(record("t", streams=said(force=3)), Provenance())
    found = [problem.what for problem in verify(TrialStore.open(tmp_path / "s"))]
    assert found == ["streams/force/t runs backwards"]


def damaged(folder: Path, how: str) -> Path:
    """A data file whose streams lead out of it, or are none."""
    with h5py.File(folder / "data.h5", "r+", libver="latest") as file:
        if how == "group":
            file["streams"] = h5py.ExternalLink("other.h5", "/streams")
        elif how == "stream":
            file.create_group("streams")["force"] = h5py.SoftLink("/poses")
        elif how == "dataset":
            file["streams/force"] = np.zeros(3)
        elif how == "many":
            for number in range(100):
                file.create_group(f"streams/s{number}")
        elif how == "name":
            file.create_group("streams/FORCE")
        elif how == "kind":
            file.create_group("streams/force").attrs["kind"] = np.bytes_("x" * 5000)
    return folder / "data.h5"


@pytest.mark.parametrize("how", ["group", "stream", "dataset", "many", "name", "kind"])
def test_a_hostile_file_is_refused(how: str, tmp_path: Path) -> None:
    writer = campaign(tmp_path / "s").begin("t", FRAME, 100)
    fill(writer)
    path = damaged(writer.seal(), how)
    with StreamReader(path) as reader:
        if how == "kind":
            assert reader.streams() == {"force": ""}
        else:
            with pytest.raises(ValueError, match=r"points out|no group|more than 64|has the name"):
                reader.streams()
