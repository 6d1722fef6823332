"""Damaged recordings: a prefix of what the whole file has, its loss counted, or nothing at all."""

from __future__ import annotations

import random
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from sliplab.flows.verify import verify as verify_store
from sliplab.protocols.errors import InputError
from sliplab.storage.errors import DamagedFile
from sliplab.storage.formats.aedat4 import Aedat4File, Aedat4Stream, Aedat4Writer
from sliplab.storage.formats.import_trials import import_trials
from sliplab.storage.formats.recognition import trials_in
from sliplab.storage.schema.trial import Lost
from sliplab.storage.trials.catalogue import UNREAD, catalogue
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import TrialStore
from tests.storage.formats.files import taken
from tests.storage.formats.recordings import (
    CHECKED,
    COUNT,
    FILES,
    PACKET,
    all_events,
    write_aedat4,
    write_dsec,
    write_mcap,
)

SEEDS = [1, *(pytest.param(seed, marks=pytest.mark.long) for seed in range(2, 6))]


@dataclass
class Outcome:
    """What became of a file: the error or the trial."""

    error: InputError | None = None
    found: Recording | None = None

    @property
    def lost(self) -> Lost | None:
        return self.found.record.imported.lost


def _import(folder: Path, path: Path, *, salvage: bool) -> Outcome:
    """Import into a new store; where that is refused, nothing is left of it."""
    try:
        _, (recording,) = taken(folder, path, salvage=salvage)
    except InputError as error:
        _check_refused(folder, path, error.message)
        return Outcome(error)
    return Outcome(None, recording)


def _check_refused(folder: Path, path: Path, message: str) -> None:
    assert path.name in message
    assert [item.name for item in folder.rglob("*") if item.is_file()] == ["store.json"]
    assert TrialStore.open(folder).campaigns() == []


def _is_prefix(found: Recording) -> int:
    """Check that a trial's events are the first of the whole file's; return their number."""
    events, whole = found.events(), all_events()
    count = len(events)
    for name in ("t_us", "x", "y", "p"):
        np.testing.assert_array_equal(getattr(events, name), getattr(whole, name)[:count])
    return count


def _try(folder: Path, name: str, data: bytes) -> tuple[Outcome, Outcome]:
    """Import a file as it is, and salvaged; check what holds for every damage."""
    path = folder / FILES[name][0]
    path.write_bytes(data)
    plain = _import(folder / "plain", path, salvage=False)
    saved = _import(folder / "saved", path, salvage=True)
    if plain.error is None:
        assert saved.error is None
        assert saved.lost is None
    elif saved.error is not None:
        assert "--salvage imports" not in plain.error.message
    else:
        assert isinstance(plain.error, DamagedFile)
        assert f"; --salvage imports {_counted(saved)} events up to " in plain.error.message
        lost = saved.lost
        assert 0 <= lost.at_byte <= len(data)
        assert 0 <= lost.unread_bytes <= len(data)
        assert lost.reason
    return plain, saved


def _counted(outcome: Outcome) -> str:
    return f"{outcome.found.record.counts.events:,}"


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """The bytes of a whole file of each format."""
    found = {}
    for name, (file, write) in FILES.items():
        path = tmp_path_factory.mktemp("whole") / file
        write(path)
        found[name] = path.read_bytes()
    return found


@pytest.mark.parametrize("name", FILES)
def test_a_whole_file_loses_nothing(tmp_path: Path, name: str, whole: dict[str, bytes]) -> None:
    for outcome in _try(tmp_path, name, whole[name]):
        assert outcome.found is not None
        assert _is_prefix(outcome.found) == COUNT
        assert outcome.lost is None


def _cut(folder: Path, name: str, data: bytes, at: int) -> int:
    """Try the first `at` bytes of a file; return the number of events salvaged."""
    plain, saved = _try(folder, name, data[:at])
    if saved.error is not None:
        # of a header that ends early nothing may be left that says what it was
        wrong = isinstance(saved.error, DamagedFile)
        assert wrong or "contains no events" in str(saved.error) or "no format" in str(saved.error)
        return 0
    assert saved.found is not None
    if plain.error is None:
        assert name in {"aedat4", "es", "evt2", "evt3", "dat"}, (
            "formats that do not say where they end"
        )
    return _is_prefix(saved.found)


@pytest.mark.quick(4)
@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("name", FILES)
def test_a_file_cut_short_gives_a_prefix(tmp_path: Path, name: str, seed: int, whole: Any) -> None:
    rng = random.Random(seed)
    data = whole[name]
    places = sorted(rng.randrange(len(data)) for _ in range(4 if seed == 1 else 24))
    counts = []
    for at in places:
        folder = tmp_path / str(at)
        folder.mkdir(exist_ok=True)
        counts.append(_cut(folder, name, data, at))
    assert counts == sorted(counts), "a longer file holds less"


@pytest.mark.parametrize("name", sorted(FILES.keys() - {"dsec checked", "contiguous", "lab"}))
def test_most_of_a_file_without_its_end_is_salvaged(tmp_path: Path, name: str, whole: Any) -> None:
    shares = {"dsec": 0.5, "dsec newest": 0.5, "mcap": 0.8, "aedat4": 0.9, "es": 0.9}
    share = shares.get(name, 0.94)
    at = int(len(whole[name]) * 0.95) | 1
    assert _cut(tmp_path, name, whole[name], at) >= share * COUNT


@pytest.mark.quick(4)
@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("name", FILES)
def test_flipped_bits_give_no_traceback_and_where_seen_a_prefix(
    tmp_path: Path, name: str, seed: int, whole: dict[str, bytes]
) -> None:
    rng = random.Random(seed)
    for number in range(4 if seed == 1 else 24):
        data = bytearray(whole[name])
        for _ in range(rng.choice((1, 8))):
            data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        folder = tmp_path / str(number)
        folder.mkdir()
        plain, saved = _try(folder, name, bytes(data))
        if plain.error is not None and saved.found is not None and name in CHECKED:
            _is_prefix(saved.found)


def test_the_table_at_the_end_of_aedat4_counts_what_is_lost(tmp_path: Path) -> None:
    """As dv-processing writes it: place, stream and items of every packet."""
    path = tmp_path / "a.aedat4"
    write_aedat4(path)
    data = bytearray(path.read_bytes())
    with Aedat4File(path) as file:
        packets = [(file.at, stream, size) for stream, size in file._headers()]
    items = {0: PACKET, 1: 1, 2: 1}
    table = _table([(at + 8, stream, size, items[stream]) for at, stream, size in packets])
    begin = packets[0][0]
    place = data.index(struct.pack("<q", -1), 0, begin)
    data[place : place + 8] = struct.pack("<q", len(data))
    import pyarrow as pa

    data += pa.compress(table, codec="zstd", asbytes=True)
    at, _, size = [packet for packet in packets if packet[1] == 0][17]
    data[at + 8 : at + 8 + size] = bytes(size)
    path.write_bytes(data)
    outcome = _import(tmp_path / "store", path, salvage=True)
    assert _is_prefix(outcome.found) == 17 * PACKET
    lost = outcome.lost
    assert (lost.at_byte, lost.unread_bytes) == (at, len(data) - at)
    assert (lost.events, lost.frames) == (13 * PACKET, 1)
    assert outcome.found.record.counts.frames == 2
    with outcome.found.open() as reader:
        assert len(reader.pulses("event_pulses")) == 17


def _table(rows: list[tuple[int, int, int, int]]) -> bytes:
    """A flatbuffer `FTAB`: a vector of tables of place (q), stream and size (ii), and items (q)."""
    vtable = struct.pack("<5H", 10, 28, 4, 12, 20) + bytes(2)
    first = 24 + 4 + 4 * len(rows)
    at = first + (-first) % 4
    places = []
    body = bytearray()
    for place, stream, size, items in rows:
        places.append(at + len(body) + len(vtable))
        body += vtable + struct.pack("<iqiiq", len(vtable), place, stream, size, items)
    head = struct.pack("<I", 16) + b"FTAB" + struct.pack("<4H", 6, 8, 4, 0)
    head += struct.pack("<iI", 8, 4) + struct.pack("<I", len(rows))
    made = bytearray(head)
    for place in places:
        made += struct.pack("<I", place - len(made))
    made += bytes(at - len(made)) + body
    return struct.pack("<I", len(made)) + bytes(made)


def test_an_event_outside_of_the_camera_is_no_damage(tmp_path: Path) -> None:
    path, whole = tmp_path / "a.aedat4", all_events()
    wrong = 17 * PACKET + 5
    whole.x[wrong] = 640
    with Aedat4Writer(path, {0: Aedat4Stream("EVTS", "events", (640, 480), "camera")}) as file:
        for low in range(0, COUNT, PACKET):
            file.events(0, whole[low : low + PACKET])
    for outcome in _try(tmp_path, "aedat4", path.read_bytes()):
        expected = np.delete(whole.t_us, wrong)
        np.testing.assert_array_equal(outcome.found.events().t_us, expected)
        imported = outcome.found.record.imported
        assert imported.dropped == {"events outside of the sensor": 1}


def test_a_damaged_chunk_counts_its_events(tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    write_dsec(path, fletcher32=True)
    with h5py.File(path) as file:
        info = file["events/y"].id.get_chunk_info(11)
    data = bytearray(path.read_bytes())
    data[info.byte_offset] ^= 1
    path.write_bytes(data)
    outcome = _import(tmp_path / "store", path, salvage=True)
    assert outcome.found is not None
    assert _is_prefix(outcome.found) == 11 * PACKET
    assert outcome.lost.events == 19 * PACKET
    assert outcome.lost.at_byte <= info.byte_offset


def test_the_statistics_of_mcap_count_the_frames_that_are_lost(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    write_mcap(path)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    outcome = _import(tmp_path / "store", path, salvage=True)
    assert 0 < _is_prefix(outcome.found) < COUNT
    assert outcome.lost.frames == 3 - outcome.found.record.counts.frames
    assert outcome.lost.events is None
    path.write_bytes(data[:-1])
    cut = _import(tmp_path / "cut", path, salvage=True)
    assert cut.lost.frames is None


def test_a_salvaged_trial_is_never_called_whole(tmp_path: Path) -> None:
    path = tmp_path / "a.aedat4"
    write_aedat4(path)
    path.write_bytes(path.read_bytes()[:-10])
    store = TrialStore.create(tmp_path / "store")
    found = trials_in(path, "aedat4", salvage=True)
    result = import_trials(store, "theirs", found, path, "aedat4", salvage=True)
    (lost,) = result["salvaged"]
    assert (lost["trial"], lost["file"]) == ("a", "a.aedat4")
    (text,) = result["warnings"]
    assert text.startswith("a.aedat4: is not whole: it is cut short")
    assert f"{lost['unread_bytes']:,} bytes were not read" in text
    (recording,) = store.campaign("theirs").recordings()
    assert [f"a.aedat4: {one}" for one in recording.record.imported.warnings] == [text]
    assert verify_store(str(store.folder))["salvaged"] == ["theirs/a"]
    assert catalogue(store)[UNREAD].tolist() == [lost["unread_bytes"]]
    assert catalogue(store)[UNREAD].tolist() == [lost["unread_bytes"]]  # from the index
    found = trials_in(path, "aedat4", salvage=True)
    again = import_trials(store, "theirs", found, path, "aedat4", salvage=True)
    assert again["there"] == ["a"]


def test_a_published_trial_that_is_cut_short_is_not_taken_for_a_recording(tmp_path: Path) -> None:
    """Its record is at the end: nobody would know that it was simulated."""
    from sliplab.plugins.formats.ros.mcap_writer import write_mcap
    from tests.storage.trial_files import campaign, commit

    where = campaign(tmp_path / "ours")
    commit(where, "t")
    path = tmp_path / "t.mcap"
    write_mcap(path, TrialStore.open(tmp_path / "ours"), where, where.recording("t"))
    path.write_bytes(path.read_bytes()[:-2000])
    outcome = _import(tmp_path / "store", path, salvage=True)
    assert isinstance(outcome.error, DamagedFile)
    assert "publish it again" in outcome.error.message
