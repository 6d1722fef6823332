"""Recordings of ROS 1 and ROS 2 as drivers and recorders write them."""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode

from sliplab.plugins.formats.ros.events import EventDecoder
from sliplab.plugins.formats.ros.messages import Fields
from sliplab.plugins.formats.ros.pictures import PictureDecoder
from sliplab.protocols.errors import InputError
from sliplab.storage.formats.foreign import FormatError
from sliplab.storage.formats.recognition import kind_of, skipped_in
from sliplab.storage.streams import EventChunk
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import TrialStore
from tests.plugins.formats import ros_files as ros
from tests.plugins.formats.ros_files import BASE_NS, ROS1, ROS2, SIZE
from tests.storage.formats.files import taken

ENCODINGS = ("mono", "libcaer", "libcaer_cmp", "evt3")
Write = Callable[[Path, list[ros.Message]], None]
WRITERS: dict[str, tuple[str, Any, Write]] = {
    "mcap": ("a.mcap", ROS2, ros.write_mcap),
    "mcap idl": ("a.mcap", ROS2, lambda path, made: ros.write_mcap(path, made, idl=True)),
    "mcap of ros 1": ("a.mcap", ROS1, lambda path, made: ros.write_mcap(path, made, store=ROS1)),
    "bag": ("a.bag", ROS1, ros.write_bag),
    "bag lz4": (
        "a.bag",
        ROS1,
        lambda path, made: ros.write_bag(path, made, Writer1.CompressionFormat.LZ4),
    ),
    "bag bz2": (
        "a.bag",
        ROS1,
        lambda path, made: ros.write_bag(path, made, Writer1.CompressionFormat.BZ2),
    ),
    "folder": ("a", ROS2, ros.write_folder),
    "folder of mcap": ("a", ROS2, lambda path, made: ros.write_folder(path, made, "mcap")),
    "folder of packed messages": (
        "a",
        ROS2,
        lambda path, made: ros.write_folder(
            path, made, compression=(CompressionMode.MESSAGE, CompressionFormat.ZSTD)
        ),
    ),
    "folder of packed files": (
        "a",
        ROS2,
        lambda path, made: ros.write_folder(
            path, made, compression=(CompressionMode.FILE, CompressionFormat.ZSTD)
        ),
    ),
}


def refused(folder: Path, path: Path) -> str:
    """Import into a new store, which is refused and leaves nothing; return the message."""
    with pytest.raises(InputError) as caught:
        taken(folder, path)
    assert TrialStore.open(folder).campaigns() == []
    return caught.value.message


def assert_events(found: Recording, sent: EventChunk) -> None:
    events = found.events()
    for name, values in vars(sent).items():
        np.testing.assert_array_equal(getattr(events, name), values, err_msg=name)


# -- containers ----------------------------------------------------------------------------


@pytest.mark.quick(5)
@pytest.mark.parametrize("writer", WRITERS)
@pytest.mark.parametrize("of", ["evt3", "list"])
def test_every_container_gives_events_and_frames(tmp_path: Path, writer: str, of: str) -> None:
    name, store, write = WRITERS[writer]
    sent = ros.sent()
    made = ros.arrays(store, sent) if of == "list" else ros.packets(store, of, sent)
    write(tmp_path / name, [*made, *ros.frames(store)])
    result, (found,) = taken(tmp_path / "store", tmp_path / name)
    assert (result["events"], result["frames"]) == (len(sent), 3)
    assert "warnings" not in result
    assert found.trial_id == "a"
    assert_events(found, sent)
    assert found.record.geometry.event_px == SIZE
    assert [int(levels[0, 0]) for levels in found.frames()] == [0, 10, 20]
    assert found.frame_times().tolist() == [BASE_NS, BASE_NS + 1, BASE_NS + 2]


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("writer", ["mcap", "bag"])
def test_every_encoding_gives_the_events(tmp_path: Path, encoding: str, writer: str) -> None:
    name, store, write = WRITERS[writer]
    sent = ros.sent()
    write(tmp_path / name, ros.packets(store, encoding, sent))
    _, (found,) = taken(tmp_path / "store", tmp_path / name)
    assert_events(found, sent)
    assert found.record.imported is not None
    assert found.record.imported.encoding == encoding
    assert found.record.imported.event_topic == "/event_camera/events"


def test_a_database_alone_is_read_as_its_folder_is(tmp_path: Path) -> None:
    sent = ros.sent()
    ros.write_folder(tmp_path / "rec", ros.packets(ROS2, "libcaer_cmp", sent))
    lone = tmp_path / "odd ?#% name.db3"
    shutil.move(tmp_path / "rec" / "rec.db3", lone)
    _, (found,) = taken(tmp_path / "store", lone)
    assert found.trial_id == "odd_name"
    assert_events(found, sent)
    assert {item.name for item in tmp_path.iterdir()} == {"rec", lone.name, "store"}
    lone.rename(tmp_path / "without_an_ending")
    assert kind_of(tmp_path / "without_an_ending") == "rosbag"


def test_a_definition_of_an_unknown_encoding_costs_nothing(tmp_path: Path) -> None:
    """rosbag2 writes `unknown` for a type whose definition it does not find."""
    ros.write_folder(tmp_path / "rec", ros.packets(ROS2, "mono", ros.sent()))
    with sqlite3.connect(tmp_path / "rec" / "rec.db3") as database:
        database.execute("UPDATE message_definitions SET encoding = 'unknown'")
    result, _ = taken(tmp_path / "store", tmp_path / "rec")
    assert result["events"] == 2000


def test_the_parts_of_a_folder_are_one_trial(tmp_path: Path) -> None:
    sent = ros.sent(4000)
    made = ros.packets(ROS2, "evt3", sent)
    rec = tmp_path / "all" / "rec"
    for number, low in enumerate(range(0, len(made), 4)):
        ros.write_folder(tmp_path / f"rec_{number}", made[low : low + 4], "mcap")
    shutil.move(tmp_path / "rec_0", rec)
    for number in range(4):
        file = tmp_path / f"rec_{number}" / f"rec_{number}.mcap"
        if file.exists():
            shutil.move(file, rec)
    text = (rec / "metadata.yaml").read_text()
    line = next(one for one in text.splitlines() if "rec_0.mcap" in one and "path" not in one)
    named = "\n".join(line.replace("rec_0", f"rec_{number}") for number in range(5))
    (rec / "metadata.yaml").write_text(text.replace(line, named))
    result, (found,) = taken(tmp_path / "store", tmp_path / "all")
    assert_events(found, sent)
    (line,) = result["warnings"]
    assert line == "rec: lacks rec_4.mcap, a part of the recording that metadata.yaml names"
    assert skipped_in(tmp_path / "all", "rosbag") == []
    (rec / "metadata.yaml").write_text("rosbag2_bagfile_information: [")
    assert skipped_in(rec, "rosbag") == []
    result, (found,) = taken(tmp_path / "again", rec)
    assert_events(found, sent)
    assert "has a damaged metadata.yaml" in result["warnings"][0]


# -- topics --------------------------------------------------------------------------------


def _imu(store: Any) -> ros.Message:
    kind = store.types[ros.IMU]
    one, turn = (store.types[f"geometry_msgs/msg/{name}"] for name in ("Vector3", "Quaternion"))
    none = np.zeros(9)
    zero = one(0, 0, 0)
    message = kind(ros.of(store, BASE_NS), turn(0, 0, 0, 1), none, zero, none, zero, none)
    return "/imu", ros.IMU, message


@pytest.mark.parametrize("writer", ["mcap", "bag", "folder"])
def test_what_is_not_read_is_named(tmp_path: Path, writer: str) -> None:
    name, store, write = WRITERS[writer]
    deep = ros.image(store, BASE_NS, "32FC1", np.ones((4, 6), np.float32), width=6)
    other = ros.image(store, BASE_NS, "mono8", np.ones((4, 6), np.uint8))
    made = [
        _imu(store),
        ("/depth", ros.IMAGE, deep),
        *ros.packets(store, "mono", ros.sent()),
        *[("/right/events", kind, one) for _, kind, one in ros.arrays(store, ros.sent(250))],
        *ros.frames(store),
        ("/other", ros.IMAGE, other),
    ]
    write(tmp_path / name, made)
    result, (found,) = taken(tmp_path / "store", tmp_path / name)
    assert (result["events"], result["frames"]) == (2000, 3)
    about = found.record.imported
    assert about is not None
    assert about.left_out == ["/depth", "/imu", "/other", "/right/events"]
    (line,) = about.warnings
    assert line == (
        "has topics that are not imported: /depth (sensor_msgs/msg/Image, which holds frames as "
        "'32FC1', which are not read), /imu (sensor_msgs/msg/Imu), /other (sensor_msgs/msg/Image, "
        "after /camera/image_raw), /right/events (dvs_msgs/msg/EventArray, after "
        "/event_camera/events)"
    )
    assert result["warnings"] == [f"{name}: {line}"]


def test_events_of_an_unknown_encoding_do_not_cost_the_frames(tmp_path: Path) -> None:
    made = [*ros.packets(ROS2, "trigger", ros.sent()), *ros.frames(ROS2)]
    ros.write_mcap(tmp_path / "a.mcap", made)
    result, (found,) = taken(tmp_path / "store", tmp_path / "a.mcap")
    assert (result["events"], result["frames"]) == (0, 3)
    assert found.record.imported is not None
    (line,) = found.record.imported.warnings
    assert "encoded as 'trigger'; read are mono, libcaer, libcaer_cmp, evt3" in line


@pytest.mark.parametrize("writer", ["mcap", "bag", "folder"])
def test_a_recording_of_which_nothing_is_read_is_refused_with_its_topics(
    tmp_path: Path, writer: str
) -> None:
    name, store, write = WRITERS[writer]
    write(tmp_path / name, [_imu(store), *ros.packets(store, "trigger", ros.sent(250))])
    said = refused(tmp_path / "store", tmp_path / name)
    assert "no topic of events or frames that can be read; its topics are: /event_camera" in said
    assert "/imu (sensor_msgs/msg/Imu)" in said
    assert said.count(name) == 1 or name == "a"


def test_the_second_camera_is_read_where_the_first_cannot_be(tmp_path: Path) -> None:
    first = ros.packets(ROS2, "trigger", ros.sent(500))
    second = [("/right", kind, one) for _, kind, one in ros.arrays(ROS2, ros.sent(500))]
    ros.write_mcap(tmp_path / "a.mcap", [*first, *second])
    _, (found,) = taken(tmp_path / "store", tmp_path / "a.mcap")
    assert_events(found, ros.sent(500))


# -- damage --------------------------------------------------------------------------------


@pytest.mark.parametrize("writer", ["mcap", "bag", "folder"])
@pytest.mark.parametrize("encoding", [*ENCODINGS, "list"])
def test_a_broken_message_costs_itself(tmp_path: Path, writer: str, encoding: str) -> None:
    name, store, write = WRITERS[writer]
    sent = ros.sent()
    of_list = encoding == "list"
    made = ros.arrays(store, sent) if of_list else ros.packets(store, encoding, sent)
    topic, kind, whole = made[3]
    made[3] = topic, kind, ros.serialised(store, whole, kind)[:-101]
    frames = ros.frames(store)
    frames[1] = ("/camera/image_raw", ros.IMAGE, b"\0\1\0\0abc")
    write(tmp_path / name, [*made, *frames])
    result, (found,) = taken(tmp_path / "store", tmp_path / name)
    assert result["frames"] == 2
    if encoding == "evt3":  # row and time of the events behind it are not known at first
        rows = list(zip(*(c.tolist() for c in vars(found.events()).values()), strict=True))
        assert 1500 < len(rows) < 1750
        assert set(rows) <= set(zip(*(c.tolist() for c in vars(sent).values()), strict=True))
    else:
        kept = ros.parts(sent)
        del kept[3]
        assert_events(found, EventChunk.concatenate(kept))
    assert found.record.imported is not None
    first, second = found.record.imported.warnings
    assert first.startswith(f"1 of 8 messages of {topic} are left out; the first one holds a mess")
    assert second.startswith("1 of 3 messages of /camera/image_raw are left out; the first one ")


def test_events_outside_of_the_camera_are_left_out_and_counted(tmp_path: Path) -> None:
    for encoding in ENCODINGS:
        sent = ros.sent()
        sent.x[[7, 8, 900]] = SIZE[0]
        path = tmp_path / f"{encoding}.mcap"
        ros.write_mcap(path, ros.packets(ROS2, encoding, sent))
        result, (found,) = taken(tmp_path / encoding, path)
        inside = sent.x < SIZE[0]
        assert_events(found, sent[inside])
        assert result["warnings"] == [f"{path.name}: 3 events outside of the sensor left out"]
        assert found.record.imported is not None
        assert found.record.imported.dropped == {"events outside of the sensor": 3}


@pytest.mark.parametrize("writer", ["mcap", "bag", "folder"])
@pytest.mark.parametrize("at", [0, 5])
def test_a_packet_that_runs_back_is_left_out(tmp_path: Path, writer: str, at: int) -> None:
    """One of a run before, at the start, or one that was published twice."""
    name, store, write = WRITERS[writer]
    sent = ros.sent()
    made = ros.packets(store, "mono", sent)
    late = EventChunk(sent.x[:9], sent.y[:9], sent.p[:9], sent.t_us[:9] + 10**9)
    made.insert(at, ros.packets(store, "mono", late)[0] if at == 0 else made[2])
    write(tmp_path / name, made)
    result, (found,) = taken(tmp_path / "store", tmp_path / name)
    assert_events(found, sent)
    (line,) = result["warnings"]
    assert f"{9 if at == 0 else 250} events " in line
    assert line.endswith(" left out")


@pytest.mark.parametrize("writer", ["bag lz4", "bag bz2", "bag"])
def test_a_damaged_chunk_of_a_bag_costs_itself(tmp_path: Path, writer: str) -> None:
    name, store, write = WRITERS[writer]
    write(tmp_path / name, ros.packets(store, "mono", ros.sent(20_000)))
    data = bytearray((tmp_path / name).read_bytes())
    at = data.index(b"compression=", len(data) // 2) + 60
    data[at : at + 200] = b"\xff" * 200
    (tmp_path / name).write_bytes(data)
    result, _ = taken(tmp_path / "store", tmp_path / name)
    assert 18_000 <= result["events"] < 20_000
    (line,) = result["warnings"]
    assert "of 80 messages of /event_camera/events are left out; the first one is in a" in line


def test_a_damaged_page_of_a_database_costs_its_messages(tmp_path: Path) -> None:
    ros.write_folder(tmp_path / "rec", ros.packets(ROS2, "mono", ros.sent(40_000)))
    path = tmp_path / "rec" / "rec.db3"
    data = bytearray(path.read_bytes())
    leaves = [at for at in range(0, len(data), 4096) if data[at] == 13]
    data[leaves[80] + 8 : leaves[80] + 16] = b"\xff" * 8  # where its rows stand
    path.write_bytes(data)
    result, _ = taken(tmp_path / "store", path)
    assert 38_000 < result["events"] < 40_000
    (line,) = result["warnings"]
    assert "of 160 messages of /event_camera/events are left out; the first one is in a" in line


def test_a_database_that_is_cut_short_is_salvaged(tmp_path: Path) -> None:
    sent = ros.sent(40_000)
    ros.write_folder(tmp_path / "rec", ros.packets(ROS2, "mono", sent))
    path = tmp_path / "rec" / "rec.db3"
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    said = refused(tmp_path / "plain", path)
    assert "rec.db3: is cut short: it has " in said
    assert "; --salvage imports " in said
    result, (found,) = taken(tmp_path / "saved", path, salvage=True)
    assert 10_000 < result["events"] < 30_000
    assert_events(found, sent[: result["events"]])
    assert result["salvaged"][0]["reason"].startswith("is cut short: it has ")


def test_a_bag_without_an_index_says_what_mends_it(tmp_path: Path) -> None:
    ros.write_bag(tmp_path / "a.bag", ros.packets(ROS1, "mono", ros.sent()))
    data = bytearray((tmp_path / "a.bag").read_bytes())
    at = data.index(b"index_pos=") + len(b"index_pos=")
    data[at : at + 8] = bytes(8)
    (tmp_path / "a.bag.active").write_bytes(data)
    said = refused(tmp_path / "store", tmp_path / "a.bag.active")
    assert "`rosbag reindex` writes one" in said


@pytest.mark.quick(1)
@pytest.mark.parametrize("writer", ["bag", "bag lz4", "folder"])
def test_flipped_bits_give_events_or_one_line(tmp_path: Path, writer: str) -> None:
    name, store, write = WRITERS[writer]
    write(tmp_path / name, [*ros.packets(store, "evt3", ros.sent()), *ros.frames(store)])
    path = tmp_path / name / "a.db3" if writer == "folder" else tmp_path / name
    whole, rng = path.read_bytes(), np.random.default_rng(7)
    for number in range(12):
        data = np.frombuffer(whole, np.uint8).copy()
        data[rng.integers(0, len(data), 1 + 10 * (number % 3))] ^= np.uint8(1 << number % 8)
        path.write_bytes(data.tobytes())
        try:
            result, _ = taken(tmp_path / str(number), path)
        except InputError as error:
            assert "\n" not in error.message  # noqa: PT017
            assert error.message.startswith(f"{path}: ")  # noqa: PT017
        else:
            assert result["events"] + result["frames"] > 0


def test_messages_that_sqlite_left_beside_a_database_are_named(tmp_path: Path) -> None:
    ros.write_folder(tmp_path / "rec", ros.packets(ROS2, "mono", ros.sent()))
    (tmp_path / "rec" / "rec.db3-wal").write_bytes(b"more")
    result, _ = taken(tmp_path / "store", tmp_path / "rec")
    assert "rec.db3-wal, in which its recorder left messages" in result["warnings"][0]


def test_another_sqlite_file_is_named(tmp_path: Path) -> None:
    with sqlite3.connect(tmp_path / "a.db3") as database:
        database.execute("CREATE TABLE messages (id INTEGER)")
        database.execute("CREATE VIEW topics AS SELECT 1 AS id")
    said = refused(tmp_path / "store", tmp_path / "a.db3")
    assert "a.db3: is an SQLite file without the tables `topics` and `messages` of ROS 2" in said


# -- events --------------------------------------------------------------------------------


def decoded(encoding: str, *data: bytes, base_ns: int = 0, stamps: tuple[int, ...] = ()) -> Any:
    decoder = EventDecoder(ros.PACKET)
    found = []
    for number, one in enumerate(data):
        stamp = stamps[number] if stamps else BASE_NS
        message = ros.packet(ROS2, stamp, encoding, one, base_ns, (640, 480))
        chunk = decoder.read(Fields(ros.serialised(ROS2, message, ros.PACKET)))
        rows = (chunk.t_us, chunk.x, chunk.y, chunk.p)
        found += list(zip(*(c.tolist() for c in rows), strict=True))
    return found, decoder


def words(*found: int) -> bytes:
    return np.array(found, "<u2").tobytes()


def test_tokens_of_libcaer_cmp_mean_what_the_driver_writes() -> None:
    data = words(
        2 << 12 | 100,
        3 << 12 | 1 << 11 | 7,  # an ON event at (100, 7), at the base
        1 << 12 | 5,
        4 << 12 | 16,
        5 << 12 | 0b1000_0001,
        5 << 12 | 0b10,  # OFF; 8 rows further
        0 << 12 | 3,
        3 << 12 | 8,  # the high part alone
        1 << 12 | 4000,
        3 << 12 | 9,
        1 << 12 | 2,
        3 << 12 | 10,  # a high part that is not written
        0 << 12 | 15,
        3 << 12 | 11,
        0 << 12 | 1,
        3 << 12 | 12,  # of which 4 bits are written
    )
    found, decoder = decoded("libcaer_cmp", data, base_ns=7_000_400)
    assert found == [
        (7000, 100, 7, 1),
        (7005, 100, 16, 0),
        (7005, 100, 23, 0),
        (7005, 100, 25, 0),
        (7000 + 3 * 4096 + 5, 100, 8, 0),
        (7000 + 3 * 4096 + 4000, 100, 9, 0),
        (7000 + 4 * 4096 + 2, 100, 10, 0),
        (7000 + 15 * 4096 + 2, 100, 11, 0),
        (7000 + 17 * 4096 + 2, 100, 12, 0),
    ]
    assert decoder.warnings() == []


def test_the_state_of_libcaer_cmp_begins_with_each_packet() -> None:
    one = words(1 << 12 | 5, 2 << 12 | 9, 3 << 12 | 7)
    found, _ = decoded("libcaer_cmp", one, words(2 << 12 | 8, 3 << 12 | 6), base_ns=9_000_000)
    assert found == [(9005, 9, 7, 0), (9000, 8, 6, 0)]


def test_31_bits_of_libcaer_begin_again_within_a_packet() -> None:
    last = (1 << 31) - 1
    data = np.array([1 | 3 << 2 | 4 << 17, last, 1 | 2 | 5 << 2 | 6 << 17, 1], "<u4").tobytes()
    found, _ = decoded("libcaer", data, base_ns=1000)
    assert found == [(last + 1, 4, 3, 0), ((1 << 31) + 2, 6, 5, 1)]


def test_the_state_of_evt3_goes_from_packet_to_packet() -> None:
    """Its clock begins at the stamp of the first packet, and turns every 16.8 s."""
    found, decoder = decoded(
        "evt3",
        words(0x8000 | 4095, 0x6000 | 9, 5, 0x2800 | 7),
        words(0x6000 | 11, 0x2000 | 8, 0x8000, 0x2000 | 9, 0xA001, 0x2000 | 640),
        stamps=(BASE_NS, BASE_NS + 10**9),
    )
    base = BASE_NS // 1000
    assert found == [(base, 7, 5, 1), (base + 2, 8, 5, 0), (base + 4087, 9, 5, 0)]
    assert decoder.edges.tolist() == [[base + 4087, 0, 1]]


def test_edges_of_evt3_are_triggers(tmp_path: Path) -> None:
    data = words(0x8001, 0x6009, 5, 0x2807, 0xA001, 0x600B, 0xA000, 0xA601, 0x2008)
    made = [("/e", ros.PACKET, ros.packet(ROS2, BASE_NS, "evt3", data))]
    ros.write_mcap(tmp_path / "a.mcap", made)
    _, (found,) = taken(tmp_path / "store", tmp_path / "a.mcap")
    with found.open() as reader:
        assert reader.pulses("event_pulses").tolist() == [BASE_NS]
    assert found.record.imported is not None
    assert found.record.imported.left_out == ["trigger input 6"]


def test_words_of_evt3_that_are_called_libcaer_cmp_are_read_with_a_warning(tmp_path: Path) -> None:
    sent = ros.sent()
    made = ros.packets(ROS2, "evt3", sent)
    for _, _, one in made:
        one.encoding = "libcaer_cmp"
    ros.write_mcap(tmp_path / "a.mcap", made)
    result, (found,) = taken(tmp_path / "store", tmp_path / "a.mcap")
    assert_events(found, sent)
    assert "are called libcaer_cmp and hold words of evt3" in result["warnings"][0]


def test_packets_of_evt3_of_a_run_before_are_left_out(tmp_path: Path) -> None:
    """The camera's clock restarted behind them: the high part of its time falls."""
    sent = ros.sent()
    sent.t_us[:] += (700 << 12) - (int(sent.t_us[0]) & 0xFFFFFF)  # well above 0
    before = EventChunk(sent.x[:9], sent.y[:9], sent.p[:9], sent.t_us[:9] + (400 << 12))
    made = [*ros.packets(ROS2, "evt3", before), *ros.packets(ROS2, "evt3", sent)]
    ros.write_mcap(tmp_path / "a.mcap", made)
    result, (found,) = taken(tmp_path / "store", tmp_path / "a.mcap")
    events = found.events()
    for name in ("x", "y", "p"):
        np.testing.assert_array_equal(getattr(events, name), getattr(sent, name))
    assert np.diff(events.t_us).tolist() == np.diff(sent.t_us).tolist()
    assert "9 events " in result["warnings"][0]


def _rows(chunk: EventChunk) -> list[tuple[int, ...]]:
    return list(zip(*(c.tolist() for c in vars(chunk).values()), strict=True))


def _numbered(encoding: str, sent: EventChunk) -> list[ros.Message]:
    made = ros.packets(ROS2, encoding, sent)
    for number, (_, _, one) in enumerate(made):
        one.seq = number
    return made


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_a_packet_that_comes_twice_is_taken_once(tmp_path: Path, encoding: str) -> None:
    sent = ros.sent()
    made = _numbered(encoding, sent)
    ros.write_mcap(tmp_path / "a.mcap", [*made[:4], made[3], made[3], *made[4:]])
    result, (found,) = taken(tmp_path / "store", tmp_path / "a.mcap")
    assert_events(found, sent)
    assert result["warnings"]


def test_packets_of_evt3_behind_a_lost_one_have_no_times_of_it(tmp_path: Path) -> None:
    sent = ros.sent()
    made = _numbered("evt3", sent)
    ros.write_mcap(tmp_path / "a.mcap", [*made[:3], *made[5:]])
    _, (found,) = taken(tmp_path / "store", tmp_path / "a.mcap")
    rows = _rows(found.events())
    assert 1250 < len(rows) < 1500
    assert set(rows) <= set(_rows(sent))


def test_a_late_packet_of_evt3_is_left_out(tmp_path: Path) -> None:
    sent = ros.sent()
    made = _numbered("evt3", sent)
    ros.write_mcap(tmp_path / "a.mcap", [*made[:3], made[4], made[3], *made[5:]])
    result, (found,) = taken(tmp_path / "store", tmp_path / "a.mcap")
    rows = _rows(found.events())
    assert 1500 < len(rows) < 1750
    assert set(rows) <= set(_rows(sent))
    assert "the first one holds packet 3 behind packet 4" in result["warnings"][0]


def test_a_driver_of_evt3_that_starts_again_counts_its_packets_from_0(tmp_path: Path) -> None:
    sent = ros.sent()
    made = _numbered("evt3", sent)
    for number, (_, _, one) in enumerate(made[4:]):
        one.seq = number
    ros.write_mcap(tmp_path / "a.mcap", made)
    _, (found,) = taken(tmp_path / "store", tmp_path / "a.mcap")
    assert 1750 < len(found.events()) <= 2000


def test_any_bytes_give_events_or_an_error() -> None:
    rng = np.random.default_rng(5)
    for number in range(300):
        encoding = ENCODINGS[number % 4]
        data = rng.integers(0, 256, int(rng.integers(0, 400)), dtype=np.uint8).tobytes()
        decoder = EventDecoder(ros.PACKET)
        message = ros.packet(ROS2, BASE_NS, encoding, data, BASE_NS, (640, 480))
        try:
            chunk = decoder.read(Fields(ros.serialised(ROS2, message, ros.PACKET)))
        except FormatError:
            continue
        assert (
            len({len(column) for column in vars(chunk).values() if hasattr(column, "dtype")}) == 1
        )
        assert np.abs(chunk.t_us).max(initial=0) < 1 << 62


# -- frames --------------------------------------------------------------------------------

GREY = np.array([[0, 50, 100, 150], [200, 250, 30, 60]], np.uint8)
BGR = np.random.default_rng(1).integers(0, 256, (4, 6, 3)).astype(np.uint8)
IN_GREY = np.asarray((BGR.astype(int) @ [114, 587, 299] + 500) // 1000, np.uint8)
RGBA = np.concatenate([BGR[..., ::-1], np.full((4, 6, 1), 9, np.uint8)], 2)
WIDE = BGR.astype(np.uint16) << 8 | 0x7F
PIXELS: dict[str, tuple[str, Any, int, Any]] = {
    # encoding, pixels by row, columns, grey levels
    "mono8": ("mono8", GREY, 4, GREY),
    "8UC1": ("8UC1", GREY, 4, GREY),
    "wider rows": ("mono8", GREY, 3, GREY[:, :3]),
    "mono16": ("mono16", GREY.astype("<u2") << 8 | 0xAB, 4, GREY),
    "16UC1": ("16UC1", GREY.astype("<u2") << 8, 4, GREY),
    "bgr8": ("bgr8", BGR, 6, IN_GREY),
    "8UC3": ("8UC3", BGR, 6, IN_GREY),
    "rgb8": ("rgb8", BGR[..., ::-1], 6, IN_GREY),
    "rgba8": ("rgba8", RGBA, 6, IN_GREY),
    "bgra8": ("bgra8", RGBA[..., [2, 1, 0, 3]], 6, IN_GREY),
    "rgb16": ("rgb16", WIDE[..., ::-1].astype("<u2"), 6, IN_GREY),
    "yuv422": ("yuv422", np.stack([GREY * 0 + 128, GREY], 2), 4, GREY),
    "yuv422_yuy2": ("yuv422_yuy2", np.stack([GREY, GREY * 0 + 128], 2), 4, GREY),
}
"""Frames by their encoding."""


def pictured(kind: str, *messages: Any) -> Any:
    decoder = PictureDecoder(kind)
    found = [decoder.read(Fields(ros.serialised(ROS2, one, kind)))[1] for one in messages]
    return found, decoder


@pytest.mark.parametrize("name", PIXELS)
def test_pixels_of_every_encoding_become_grey_levels(name: str) -> None:
    encoding, pixels, width, expected = PIXELS[name]
    rows = np.ascontiguousarray(pixels).reshape(len(pixels), -1)
    (levels,), decoder = pictured(ros.IMAGE, ros.image(ROS2, BASE_NS, encoding, rows, width=width))
    np.testing.assert_array_equal(levels, expected)
    assert levels.dtype == np.uint8
    assert decoder.encoding == encoding
    assert bool(decoder.warnings()) == ("16" in encoding)


def test_numbers_of_16_bits_may_be_big_endian() -> None:
    pixels = (GREY.astype(np.uint16) << 8 | 1).astype(">u2")
    (levels,), decoder = pictured(
        ros.IMAGE, ros.image(ROS2, BASE_NS, "mono16", pixels, big_endian=1)
    )
    np.testing.assert_array_equal(levels, GREY)
    assert "values of up to 64,001; their grey levels are the upper 8 bits" in decoder.warnings()[0]


@pytest.mark.parametrize("order", ["rggb", "bggr", "gbrg", "grbg"])
@pytest.mark.parametrize("bits", [8, 16])
def test_a_plain_colour_behind_a_bayer_filter_keeps_its_brightness(order: str, bits: int) -> None:
    colour = {"b": 40, "g": 120, "r": 200}
    tile = np.array([[colour[order[0]], colour[order[1]]], [colour[order[2]], colour[order[3]]]])
    pixels = np.tile(tile, (4, 4)).astype(np.uint8)
    made = pixels if bits == 8 else pixels.astype("<u2") << 8
    (levels,), _ = pictured(ros.IMAGE, ros.image(ROS2, BASE_NS, f"bayer_{order}{bits}", made))
    expected = (40 * 114 + 120 * 587 + 200 * 299 + 500) // 1000
    np.testing.assert_array_equal(levels[2:-2, 2:-2], expected)


@pytest.mark.parametrize("ending", ["png", "jpg"])
def test_compressed_frames_are_read(tmp_path: Path, ending: str) -> None:
    data = cv2.imencode(f".{ending}", BGR)[1].tobytes()
    made = [
        (
            "/image/compressed",
            ros.COMPRESSED,
            ros.compressed(ROS2, BASE_NS + n, f"bgr8; {ending} compressed bgr8", data),
        )
        for n in range(3)
    ]
    ros.write_mcap(tmp_path / "a.mcap", [*ros.packets(ROS2, "evt3", ros.sent()), *made])
    result, (found,) = taken(tmp_path / "store", tmp_path / "a.mcap")
    assert (result["events"], result["frames"]) == (2000, 3)
    for levels in found.frames():
        assert np.abs(levels.astype(int) - IN_GREY).max() <= (0 if ending == "png" else 90)


def test_raw_frames_come_before_compressed_ones(tmp_path: Path) -> None:
    data = cv2.imencode(".png", BGR)[1].tobytes()
    small = ("/a/compressed", ros.COMPRESSED, ros.compressed(ROS2, BASE_NS, "png", data))
    ros.write_mcap(tmp_path / "a.mcap", [small, *ros.frames(ROS2)])
    _, (found,) = taken(tmp_path / "store", tmp_path / "a.mcap")
    assert found.record.imported is not None
    assert found.record.imported.frame_topic == "/camera/image_raw"
    assert found.record.imported.left_out == ["/a/compressed"]


BAD_FRAMES: dict[str, Any] = {
    "of another size": ros.image(ROS2, BASE_NS + 5, "mono8", np.zeros((5, 6), np.uint8)),
    "of a short row": ros.image(ROS2, BASE_NS + 5, "mono8", np.zeros((4, 6), np.uint8), width=7),
    "of no rows": ros.image(ROS2, BASE_NS + 5, "mono8", np.zeros((1, 6), np.uint8), width=0),
    "earlier": ros.image(ROS2, BASE_NS - 5, "mono8", np.zeros((4, 6), np.uint8)),
    "of another encoding": ros.image(ROS2, BASE_NS + 5, "nv21", np.zeros((4, 6), np.uint8)),
}


@pytest.mark.parametrize("name", BAD_FRAMES)
def test_a_frame_that_cannot_be_right_is_left_out(tmp_path: Path, name: str) -> None:
    topic, kind, _ = (good := ros.frames(ROS2))[0]
    bad = topic, kind, BAD_FRAMES[name]
    late = ros.image(ROS2, BASE_NS + 9, "mono8", np.full((4, 6), 30, np.uint8))
    ros.write_mcap(tmp_path / "a.mcap", [*good, bad, (topic, kind, late)])
    result, (found,) = taken(tmp_path / "store", tmp_path / "a.mcap")
    assert result["frames"] == 4
    assert [int(levels[0, 0]) for levels in found.frames()] == [0, 10, 20, 30]
    says = "1 of 5 messages of /camera/image_raw are left out"
    assert ("1 frame " if name == "earlier" else says) in result["warnings"][0]
