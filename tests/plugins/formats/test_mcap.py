"""Trials as MCAP files: read by the format's own readers, and back into a store as they were."""

from __future__ import annotations

import json
import shutil
import struct
import threading
import time
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from mcap_ros2.decoder import DecoderFactory
from mcap_ros2.writer import Writer as RosWriter
from scipy.spatial.transform import Rotation

from sliplab.flows.api import open_store
from sliplab.plugins.formats.ros import messages as ros2
from sliplab.plugins.formats.ros.mcap_writer import write_mcap
from sliplab.plugins.publish.forms import publish
from sliplab.plugins.publish.imported import of_one_campaign
from sliplab.plugins.record.recorder import RecordedTrial
from sliplab.plugins.record.recorder import record as sliplab_record
from sliplab.plugins.record.sources import push
from sliplab.protocols.errors import InputError
from sliplab.storage.clockmap import ClockMap
from sliplab.storage.formats.export_trials import label_table
from sliplab.storage.formats.foreign import FormatError
from sliplab.storage.formats.import_trials import import_trials
from sliplab.storage.formats.recognition import kind_of, trials_in
from sliplab.storage.schema.label import LABELS, TrialLabel
from sliplab.storage.schema.trial import Provenance, SyncResult, TrialClockMaps
from sliplab.storage.streams import (
    ClockReads,
    EventChunk,
    ExposureChunk,
    Json,
    PulseChunk,
    ScalarChunk,
    TriggerChunk,
    WrenchChunk,
)
from sliplab.storage.trials.catalogue import catalogue
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import SYNC, TrialStore
from sliplab.storage.trials.verify import verify
from tests.flows.older import older_store
from tests.plugins.publish.test_croissant import publication
from tests.storage.trial_files import (
    FRAME,
    IDENTITY,
    campaign,
    commit,
    events,
    fill,
    frames,
    record,
)

SHIFTED = ClockMap.line(5_000_000_000, -3_000_000_000, 20_000).to_json()
"""The event camera's clock: 8 s ahead of the time line, which begins below zero, and slow."""


@pytest.fixture(scope="module")
def labelled(tmp_path_factory: pytest.TempPathFactory) -> TrialStore:
    """Four labelled slides with tracks; the clocks of one were fitted again."""
    store = TrialStore.open(older_store(tmp_path_factory.mktemp("older")))
    (where,) = store.campaigns()
    one = next(where.recordings())
    clocks = one.record.clocks.to_json()
    arm = clocks["arm"]["map"]
    arm["reference_ns"] = [t_ns + 1000 for t_ns in arm["reference_ns"]]
    refitted = SyncResult(
        key="new", raw=one.raw_checksum, clocks=TrialClockMaps.model_validate(clocks)
    )
    Derived.of(store, SYNC, where.name).write(one.folder.name, "new", refitted)
    one.forget_clocks()
    assert one.refitted
    return store


@pytest.fixture(scope="module")
def rich(tmp_path_factory: pytest.TempPathFactory) -> TrialStore:
    """One trial with every stream there is: further cameras, forces, temperature, a video."""
    where = campaign(tmp_path_factory.mktemp("rich") / "store")
    writer = where.begin("t", FRAME, 50)
    fill(writer)
    rows = np.arange(40, dtype=np.int64)
    turns = np.random.default_rng(2).normal(size=(40, 3))
    writer.add("force", WrenchChunk(rows * 10**6, rows, turns, -turns))
    writer.add("warm", ScalarChunk(rows * 10**7, rows, turns[:, 0], "°C"))
    writer.add("side", events(3000, seed=4))
    writer.add("side", PulseChunk(rows * 1000))
    writer.add("back", frames(9, seed=5))
    writer.add("back", ClockReads(rows, rows - 1, rows + 1))
    writer.add("sync_box", ClockReads(rows, rows - 1, rows + 1))
    writer.add("sync_box", ExposureChunk(rows))
    writer.add("events", TriggerChunk(rows * 1000, np.ones(40, np.uint8)))
    plain = record("t").to_json()
    clock = {"map": IDENTITY, "uncertainty_ns": 2000.0}
    clocks = {
        **plain["clocks"],
        "events": {"map": SHIFTED, "uncertainty_ns": 1.0},
        "streams": dict.fromkeys(("side", "back", "warm", "force"), clock),
    }
    streams = {
        "side": {"kind": "events", "rows": 3000, "pulses": 40, "size_px": [640, 480]},
        "back": {"kind": "frames", "rows": 9, "size_px": list(FRAME)},
        "warm": {"kind": "scalar", "rows": 40, "unit": "°C"},
        "force": {"kind": "wrench", "rows": 40},
    }
    steps = [{"phase": "press", "start_ns": 0, "end_ns": 5, "recorded": True}]
    geometry = {"event_px": [640, 480], "frame_px": list(FRAME)}
    writer.commit(
        record("t", clocks=clocks, streams=streams, steps=steps, geometry=geometry),
        Provenance(host="here", operator="somebody", versions={"sliplab": "0.1.0"}),
    )
    return TrialStore.open(where.folder.parents[1])


def decoded(path: Path) -> dict[str, list[Any]]:
    """All messages of a file as the official reader decodes them, by topic, with log times."""
    found = defaultdict(list)
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for schema, channel, message, content in reader.iter_decoded_messages():
            assert (schema.encoding, channel.message_encoding) == ("ros2msg", "cdr")
            found[channel.topic].append((message.log_time, content, schema.name))
    return found


def stamp(content: Any) -> int:
    return int(content.header.stamp.sec * 10**9 + content.header.stamp.nanosec)


def by_hand(packets: list[Any]) -> list[tuple[int, int, int, int]]:
    """Events as the README of event_camera_codecs describes ``mono``: x, y, polarity, ns."""
    found = []
    for _, packet, kind in packets:
        assert (kind, packet.encoding) == ("event_camera_msgs/msg/EventPacket", "mono")
        assert packet.is_bigendian is False
        for (word,) in struct.iter_unpack("<Q", bytes(packet.events)):
            t_ns = packet.time_base + (word & 0xFFFFFFFF)
            found.append((word >> 32 & 0xFFFF, word >> 48 & 0x7FFF, word >> 63, t_ns))
    return found


def test_the_official_readers_find_what_the_store_has(rich: TrialStore, tmp_path: Path) -> None:
    (where,) = rich.campaigns()
    (ours,) = where.recordings()
    path = tmp_path / "t.mcap"
    counts = write_mcap(path, rich, where, ours)
    found = decoded(path)
    assert counts["messages"] == sum(map(len, found.values()))
    with path.open("rb") as file:
        reader = make_reader(file)
        (about,) = [one.metadata for one in reader.iter_metadata()]
        attached = {one.name: one.data for one in reader.iter_attachments()}
        assert reader.get_header().profile == "ros2"
    shift = int(about["log_time_minus_time_line_ns"])
    for name, camera in (("events", ours.events()), ("side", ours.events(stream="side"))):
        columns = zip(camera.x, camera.y, camera.p, camera.t_us * 1000, strict=True)
        assert by_hand(found[f"/{name}"]) == [tuple(map(int, row)) for row in columns]
        for log, packet, _ in found[f"/{name}"]:
            assert (packet.width, packet.height, packet.header.frame_id) == (640, 480, name)
            assert stamp(packet) == ours.clock(name).to_reference(packet.time_base) == log - shift
            assert len(packet.events) <= 8 * 65536
        assert [packet.seq for _, packet, _ in found[f"/{name}"]] == list(
            range(len(found[f"/{name}"]))
        )
    assert stamp(found["/events"][0][1]) == -3_000_000_000 + ours.clock("events").to_reference(
        int(ours.events().t_us[0]) * 1000
    ) - ours.clock("events").to_reference(5_000_000_000)
    assert shift > 2_900_000_000  # the time line begins below zero, log times cannot
    for name in ("frames", "back"):
        images = [one for _, one, _ in found[f"/{name}"]]
        assert {(one.encoding, one.width, one.height, one.step) for one in images} == {
            ("mono8", *FRAME, FRAME[0])
        }
        for one, levels, t_ns in zip(
            images, ours.frames(stream=name), ours.frame_times(name), strict=True
        ):
            assert bytes(one.data) == levels.tobytes()
            assert stamp(one) == t_ns
    with ours.open() as reader:
        poses, sent = reader.poses(), reader.pulses("sync_pulses")
        seen = reader.pulses("event_pulses")
    for (_, one, _), xyz, turn in zip(
        found["/arm/pose"], poses.xyz_mm, poses.rotvec_deg, strict=True
    ):
        place, q = one.pose.position, one.pose.orientation
        np.testing.assert_allclose([place.x, place.y, place.z], xyz / 1000, rtol=1e-15)
        back = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_rotvec(degrees=True)
        np.testing.assert_allclose(back, turn, atol=1e-12)
    forces = ours.wrenches()
    assert [[w.wrench.force.x, w.wrench.torque.z] for _, w, _ in found["/force"]] == (
        np.stack([forces.force_n[:, 0], forces.torque_nm[:, 2]], 1).tolist()
    )
    assert [stamp(w) for _, w, _ in found["/force"]] == forces.t_ns.tolist()
    assert [(one.value, one.unit) for _, one, _ in found["/warm"]] == [
        (value, "°C") for value in ours.scalars("warm").value.tolist()
    ]
    assert [stamp(one) for _, one, _ in found["/sync_pulses"]] == sent.tolist()
    assert [one.device_ns for _, one, _ in found["/event_pulses"]] == seen.tolist()
    ((_, press, kind),) = found["/phases"]
    assert (kind, press.phase, press.end_ns) == ("sliplab_msgs/msg/Phase", "press", 5)
    rows = {(one.column, one.file): one for _, one, _ in found["/columns"]}
    raw = rows["poses/rotvec", "data.h5"]
    assert (raw.unit, raw.dtype, list(raw.shape)) == ("degrees, rotation vector", "<f8", [3])
    assert np.array_equal(
        np.frombuffer(bytes(raw.data), raw.dtype).reshape(-1, *raw.shape), poses.rotvec_deg
    )
    assert attached["record.json"] == (ours.folder / "record.json").read_bytes()
    assert attached["rig.yaml"] == (where.folder / "rig.yaml").read_bytes()


def test_onsets_are_messages_with_rule_and_doubt(labelled: TrialStore, tmp_path: Path) -> None:
    (where,) = labelled.campaigns()
    one = next(where.recordings())
    write_mcap(tmp_path / "t.mcap", labelled, where, one)
    label = Derived.of(labelled, LABELS, where.name).load(one.folder.name, TrialLabel)
    onsets = [
        (item.t_ns, item.rule, item.kind) for _, item, _ in decoded(tmp_path / "t.mcap")["/onsets"]
    ]
    assert set(onsets) == {
        (label.incipient_ns, "own", "incipient"),
        (label.gross_ns, "own", "gross"),
        (label.paper.incipient_ns, "paper", "incipient"),
        (label.paper.gross_ns, "paper", "gross"),
        (label.change_point.incipient_ns, "change_point", "incipient"),
        (label.change_point.gross_ns, "change_point", "gross"),
    }
    assert [t_ns for t_ns, _, _ in onsets] == sorted(t_ns for t_ns, _, _ in onsets)


def take(store: TrialStore, path: Path, name: str) -> Json:
    assert kind_of(path) == "mcap"
    return import_trials(store, name, trials_in(path, "mcap"), path, "mcap")


def columns_of(recording: Recording) -> Iterator[tuple[str, Any]]:
    for stream in (None, *(n for n, s in recording.record.streams.items() if s.of_camera)):
        with recording.open(stream) as reader:
            names = [name for name, rows in reader.counts().items() if rows]
            named = [f"streams/{n}/{p}" for n, ps in reader.stream_counts().items() for p in ps]
            for name in names + named:
                yield f"{stream} {name}", reader.column(name)


def assert_equal(ours: TrialStore, theirs: TrialStore) -> None:
    """Hold every trial of two stores against each other: all columns, frames, documents, labels."""
    assert verify(theirs) == []
    assert catalogue(theirs).equals(catalogue(ours))
    for where, again in zip(ours.campaigns(), theirs.campaigns(), strict=True):
        assert again.info == where.info
        for name in ("protocol.yaml", "rig.yaml"):
            assert (again.folder / name).read_bytes() == (where.folder / name).read_bytes()
        for one, other in zip(where.recordings(), again.recordings(), strict=True):
            assert other.record.to_json() == one.record.to_json()
            assert (other.clocks, other.refitted) == (one.clocks, one.refitted)
            mine, yours = dict(columns_of(one)), dict(columns_of(other))
            assert mine.keys() == yours.keys()
            for name, values in mine.items():
                np.testing.assert_array_equal(yours[name], values, err_msg=name)
                assert yours[name].dtype == values.dtype
            for stream in one.streams("frames"):
                if one.video(stream) is not None:
                    for levels, found in zip(
                        one.frames(stream=stream), other.frames(stream=stream), strict=True
                    ):
                        np.testing.assert_array_equal(found, levels)
        names = sorted(where.committed())
        table = label_table(ours, where.name, names)
        assert label_table(theirs, again.name, names).equals(table)
        kept, kept_again = (Derived.of(store, LABELS, where.name) for store in (ours, theirs))
        for name in names if len(table) else ():
            assert kept_again.read(name) == kept.read(name)
            arrays, again_arrays = kept.arrays(name), kept_again.arrays(name)
            assert arrays.keys() == again_arrays.keys()
            for key, values in arrays.items():
                np.testing.assert_array_equal(again_arrays[key], values)


@pytest.mark.quick(1)
@pytest.mark.parametrize("which", ["labelled", "rich"])
def test_a_published_store_comes_back_as_it_was(
    which: str, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    ours: TrialStore = request.getfixturevalue(which)
    output = tmp_path / "out"
    result = publish(publication(ours), output, "mcap")
    (where,) = ours.campaigns()
    assert result["trials"] == len(where.committed())
    theirs = TrialStore.create(tmp_path / "store")
    folder = output / "campaigns" / where.name
    taken = take(theirs, folder, where.name)
    assert len(taken["imported"]) == result["trials"]
    assert_equal(ours, theirs)
    again = take(theirs, folder, where.name)
    assert (again["imported"], len(again["there"])) == ([], result["trials"])
    (first, *_) = theirs.campaigns()[0].recordings()
    kept = Provenance.load(first.folder / "provenance.json")
    assert (kept.host, kept.operator, kept.source) == (None, None, f"{first.folder.name}.mcap")
    assert kept.versions
    card = (output / "README.md").read_text()
    assert card.startswith("Simulated data.\n")
    assert "| /arm/pose | geometry_msgs/msg/PoseStamped |" in card
    listed = json.loads((output / "ro-crate-metadata.json").read_text())["@graph"]
    (made,) = [item for item in listed if item["@type"] == "CreateAction"]
    assert all((output / item["@id"]).is_file() for item in made["result"])


def test_an_imported_campaign_and_one_without_frames_come_back(tmp_path: Path) -> None:
    where = campaign(tmp_path / "store")
    where.update(
        {"name": "c", "simulated": False, "imported": {"from": "x"}},
        "imported: mcap\n",
        "imported: mcap\n",
    )
    writer = where.begin("t", None, 100)
    fill(writer, count=70_000, with_frames=False)
    counts = {"events": 70_000, "frames": 0, "poses": 10, "pulses": 10}
    clock = {"map": IDENTITY}
    clocks = {"reference": "event camera", "events": clock}
    writer.commit(record("t", counts=counts, clocks=clocks, simulated=False), Provenance())
    ours = TrialStore.open(tmp_path / "store")
    publish(publication(ours), tmp_path / "out", "mcap")
    theirs = TrialStore.create(tmp_path / "again")
    only = of_one_campaign(tmp_path / "out")
    assert only == tmp_path / "out" / "campaigns" / "c"
    assert of_one_campaign(only) is None
    take(theirs, tmp_path / "out", "c")
    assert_equal(ours, theirs)
    (tmp_path / "out" / "campaigns" / "d").mkdir()
    with pytest.raises(InputError, match=r"must be of one campaign; name one of these folders: "):
        of_one_campaign(tmp_path / "out")


def test_a_recorded_campaign_comes_back_with_its_tables(tmp_path: Path) -> None:
    streams = [
        push("pull", {"fx": "N", "fy": "N"}, clock="utc", uncertainty_ms=1000),
        push("wrong", {"warm": "degC"}, clock="ptp", uncertainty_ms=1),
        push("events", events_px=(64, 48)),
    ]
    with sliplab_record(streams, tmp_path / "store", "c") as recording, recording.trial() as trial:
        for k in range(5):
            trial.push("pull", time.time_ns(), k, -k)
            trial.push("wrong", 10**12 - k * 10**10, k)
            trial.push("events", None, 1, 2, 1)
            waited_for(trial, "pull", k + 1)
    ours = TrialStore.open(tmp_path / "store")
    (found,) = ours.campaign("c").recordings()
    assert "wrong" in found.clocks.refused
    arrays = open_store(tmp_path / "store").trial(trial.id).to_dict()
    assert arrays["data_vars"]["pull_fy"]["data"].tolist() == [0, -1, -2, -3, -4]
    assert "wrong_t_ns" not in arrays["coords"]
    publish(publication(ours), tmp_path / "out", "mcap")
    (file,) = (tmp_path / "out").rglob("*.mcap")
    with file.open("rb") as handle:
        topics = {channel.topic for _, channel, _ in make_reader(handle).iter_messages()}
    assert {"/pull/fx", "/pull/fy", "/wrong", "/events"} < topics
    theirs = TrialStore.create(tmp_path / "again")
    take(theirs, tmp_path / "out", "c")
    assert_equal(ours, theirs)
    (again,) = theirs.campaign("c").recordings()
    with again.open() as reader:
        assert reader.column_unit("pull", "fx") == "N"


def waited_for(trial: RecordedTrial, name: str, rows: int) -> None:
    """Wait until a trial has rows of a stream."""
    end = time.monotonic() + 30
    while trial.rows()[name] < rows:
        assert time.monotonic() < end
        threading.Event().wait(0.002)


@pytest.mark.long
def test_trials_of_two_campaigns_are_not_mixed(
    labelled: TrialStore, rich: TrialStore, tmp_path: Path
) -> None:
    folder = tmp_path / "files"
    folder.mkdir()
    for store in (labelled, rich):
        for where in store.campaigns():
            for one in where.recordings():
                write_mcap(folder / f"{one.folder.name}.mcap", store, where, one)
    made = TrialStore.create(tmp_path / "store")
    (failed,) = take(made, folder, "all")["failed"]
    assert failed["file"] == "t.mcap"
    assert failed["reason"].startswith("--name = all: has another protocol or rig than t.mcap")
    assert len(made.campaign("all").committed()) == 4
    commit(campaign(tmp_path / "other", "mine"), "x")
    result = take(TrialStore.open(tmp_path / "other"), folder, "mine")
    assert result["imported"] == ["t"]  # its protocol and rig are the same
    reasons = [each["reason"] for each in result["failed"]]
    assert len(reasons) == 4
    assert all("--name = mine: has another protocol or rig" in text for text in reasons)


def test_a_damaged_file_stops_no_other_and_is_named(rich: TrialStore, tmp_path: Path) -> None:
    folder = tmp_path / "files"
    folder.mkdir()
    (where,) = rich.campaigns()
    (one,) = where.recordings()
    write_mcap(folder / "t.mcap", rich, where, one)
    whole = (folder / "t.mcap").read_bytes()
    for name in ("a", "z"):  # before and behind the good one
        (folder / f"{name}.mcap").write_bytes(whole[: len(whole) // 2])
    made = TrialStore.create(tmp_path / "store")
    for key in ("imported", "there"):  # into a new campaign, and into the one that is there
        result = take(made, folder, "c")
        assert (result[key], [each["file"] for each in result["failed"]]) == (
            ["t"],
            ["a.mcap", "z.mcap"],
        )
        assert all("is damaged or cut short" in each["reason"] for each in result["failed"])
    assert_equal(rich, made)


def _ros_bag(
    path: Path, encoding: str = "mono", compression: CompressionType = CompressionType.LZ4
) -> EventChunk:
    """A recording by other programs, written by the official ROS 2 writer."""
    sent = events(5000, seed=8, start_us=1_700_000_000_000_000)
    base = 1_700_000_000_000_000_300  # the host's clock, between two microseconds
    with path.open("wb") as file:
        writer = RosWriter(file, compression=compression)
        types = {
            kind: writer.register_msgdef(kind, ros2.definition(kind).decode())
            for kind in (ros2.EVENTS, ros2.IMAGE, ros2.POSE)
        }
        header = {"stamp": {"sec": 1_700_000_000, "nanosec": 5}, "frame_id": "camera"}
        for low in range(0, 5000, 1000):
            rows = slice(low, low + 1000)
            words = [
                (int(t) * 1000 + 300 - base) | int(x) << 32 | int(y) << 48 | int(p) << 63
                for x, y, p, t in zip(*(part[rows] for part in vars(sent).values()), strict=True)
            ]
            packet = {
                "header": header,
                "width": 640,
                "height": 480,
                "seq": low,
                "time_base": base,
                "encoding": encoding,
                "is_bigendian": False,
                "events": struct.pack(f"<{len(words)}Q", *words),
            }
            writer.write_message("/cam/events", types[ros2.EVENTS], packet, base, base)
        for number in range(3):
            levels = np.full((4, 8), number, np.uint8)
            one = {
                "header": {"stamp": {"sec": 1_700_000_000, "nanosec": number}, "frame_id": ""},
                "height": 4,
                "width": 6,
                "encoding": "mono8",
                "is_bigendian": 0,
                "step": 8,
                "data": levels.tobytes(),
            }
            writer.write_message("/cam/image", types[ros2.IMAGE], one, base, base)
        writer.write_message("/tool", types[ros2.POSE], {"header": header}, base, base)
        writer.finish()
    return sent


@pytest.mark.parametrize("compression", list(CompressionType))
def test_a_recording_of_ros_2_is_imported(compression: CompressionType, tmp_path: Path) -> None:
    sent = _ros_bag(tmp_path / "bag.mcap", compression=compression)
    made = TrialStore.create(tmp_path / "store")
    result = take(made, tmp_path / "bag.mcap", "theirs")
    assert (result["events"], result["frames"]) == (5000, 3)
    assert verify(made) == []
    found = made.campaign("theirs").recording("bag")
    with found.open() as reader:
        got = reader.events()
    for name, values in vars(sent).items():  # 300 ns are rounded off
        np.testing.assert_array_equal(getattr(got, name), values)
    assert found.record.geometry.event_px == (640, 480)
    assert [frame.shape for frame in found.frames()] == [(4, 6)] * 3
    assert found.frame_times().tolist() == [1_700_000_000_000_000_000 + n for n in range(3)]
    assert found.record.imported.left_out == ["/tool"]
    assert found.record.clocks.events.grade == "unknown"


def test_other_encodings_and_topics_are_named(tmp_path: Path) -> None:
    _ros_bag(tmp_path / "bag.mcap", encoding="trigger")
    made = TrialStore.create(tmp_path / "store")
    result = take(made, tmp_path / "bag.mcap", "theirs")
    assert (result["events"], result["frames"]) == (0, 3)
    assert "holds events encoded as 'trigger'; read are mono, " in result["warnings"][0]
    shutil.rmtree(made.folder / "campaigns")
    with (tmp_path / "none.mcap").open("wb") as file:
        writer = RosWriter(file)
        kind = writer.register_msgdef(ros2.POSE, ros2.definition(ros2.POSE).decode())
        writer.write_message("/tool", kind, {}, 0, 0)
        writer.finish()
    with pytest.raises(InputError, match=r"its topics are: /tool \(geometry_msgs/msg/PoseStamped"):
        take(made, tmp_path / "none.mcap", "theirs")
    assert not list(made.folder.glob("campaigns/*"))


@pytest.mark.long
def test_damage_ends_in_a_message_and_leaves_nothing(rich: TrialStore, tmp_path: Path) -> None:
    (where,) = rich.campaigns()
    (one,) = where.recordings()
    path = tmp_path / "t.mcap"
    write_mcap(path, rich, where, one)
    whole = path.read_bytes()
    rng = np.random.default_rng(5)
    cuts = [whole[: int(at)] for at in rng.integers(0, len(whole), 40)]
    flips = []
    for at in rng.integers(8, len(whole), 80):
        data = bytearray(whole)
        data[at] ^= 1 << int(rng.integers(8))
        flips.append(bytes(data))
    refused = 0
    made = TrialStore.create(tmp_path / "store")
    for data in (*cuts, *flips):
        path.write_bytes(data)
        try:
            import_trials(made, "c", trials_in(path, "mcap"), path, "mcap")
        except InputError as error:
            said = str(error)
        else:  # what was hit is read by nobody: an index, a library's name
            assert_equal(rich, made)
            shutil.rmtree(made.folder / "campaigns")
            continue
        assert said.startswith(f"{path}: ")
        assert not list(made.folder.glob("campaigns/c/trials/*"))
        assert not list(made.folder.glob("derived/labels/**/*"))
        refused += 1
    assert refused > 100


def test_a_length_beyond_any_file_is_refused(tmp_path: Path) -> None:
    """Found by fuzzing: the library asks for as many bytes as the record says."""
    path = tmp_path / "t.mcap"
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.NONE, enable_crcs=False)
        writer.start("ros2")
        kind = writer.register_schema(ros2.POSE, "ros2msg", ros2.definition(ros2.POSE))
        writer.add_message(writer.register_channel("/a", "cdr", kind), 0, b"marked", 0)
        writer.finish()
    data = bytearray(path.read_bytes())
    at = data.index(b"marked") - 22 - 9  # the message's record: a byte, its length, its head
    assert data[at] == 5
    data[at : at + 9] = struct.pack("<BQ", 0x7F, 2**63)
    path.write_bytes(data)
    with pytest.raises(InputError, match=r"t\.mcap: is damaged or cut short"):
        take(TrialStore.create(tmp_path / "store"), path, "c")


def _with(where: TrialStore, path: Path, change: Any) -> None:
    """Write a file of ours whose attachments, metadata and columns were changed on the way."""
    (campaign_,) = where.campaigns()
    (one,) = campaign_.recordings()
    with pytest.MonkeyPatch.context() as patch:
        change(patch)
        write_mcap(path, where, campaign_, one)


@pytest.mark.parametrize(
    ("name", "change", "says"),
    [
        ("dtype", {"values": lambda v: v.astype("<f4")}, "holds the column"),
        ("rows", {"values": lambda v: v[:-1]}, "different lengths|record says|no whole trial"),
        ("file", {"file": lambda f: "../x"}, "which no trial has"),
        ("column", {"column": lambda c: "events/x"}, "which no trial has"),
    ],
)
def test_columns_that_no_trial_has_are_refused(
    name: str, change: dict[str, Any], says: str, rich: TrialStore, tmp_path: Path
) -> None:
    real = ros2.RowsMessage.message

    def changed(self: ros2.RowsMessage, t_ns: int) -> bytes:
        if self.column in {"poses/t", "frames/number"}:
            facts = {key: edit(getattr(self, key)) for key, edit in change.items()}
            self = ros2.RowsMessage(**{**vars(self), **facts})
        return real(self, t_ns)

    path = tmp_path / "t.mcap"
    _with(rich, path, lambda patch: patch.setattr(ros2.RowsMessage, "message", changed))
    made = TrialStore.create(tmp_path / "store")
    with pytest.raises(InputError, match=says):
        take(made, path, "c")
    assert not list(made.folder.glob("campaigns/c/trials/*"))


def test_a_time_or_a_row_that_does_not_fit_is_refused() -> None:
    with pytest.raises(FormatError, match="32 bits of seconds"):
        ros2.pulse(2**62, "", 0)
    none, row = np.zeros(1, np.int64), np.array([2**15], np.uint16)
    tall = EventChunk(none.astype(np.uint16), row, none.astype(np.uint8), none)
    with pytest.raises(FormatError, match="row 32768"):
        ros2.pack_mono(tall, 0)


def test_a_frame_without_a_clock_is_kept(tmp_path: Path) -> None:
    where = campaign(tmp_path / "store")
    writer = where.begin("t", FRAME, 100)
    fill(writer, with_frames=False)
    late = frames(12)
    writer.add("frames", replace(late, t_ns=late.t_ns + 7))
    clocks = {"reference": "sync box", "events": {"map": IDENTITY}}
    writer.commit(record("t", clocks=clocks), Provenance())
    ours = TrialStore.open(tmp_path / "store")
    publish(publication(ours), tmp_path / "out", "mcap")
    found = decoded(tmp_path / "out" / "campaigns" / "c" / "t.mcap")
    assert {stamp(one) for _, one, _ in found["/frames"]} == {0}
    theirs = TrialStore.create(tmp_path / "again")
    take(theirs, tmp_path / "out" / "campaigns" / "c", "c")
    assert_equal(ours, theirs)
