"""Frames, poses, clocks and labels that adapters read, each compared with what was put in."""

from __future__ import annotations

import csv
import shutil
from contextlib import closing
from decimal import ROUND_HALF_UP, Decimal
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from sliplab.plugins.adapters.trials import find_trials
from sliplab.protocols.adapter import load_adapter
from sliplab.protocols.errors import InputError
from sliplab.storage.formats.data_folder import DataFolder
from sliplab.storage.formats.foreign import Skipped
from tests.plugins.adapters.adapter_streams import (
    BASE,
    FRAMES,
    ONSETS,
    adapter,
    folder_of,
    imported,
    refused,
    some_frames,
    write_frames,
)
from tests.plugins.adapters.adapters import bring

HOUR_NS = 3_600_000_000_000


def write_times(folder: Path, form: str, count: int) -> tuple[dict[str, Any], list[int]]:
    """Write times that are not even; return the key of an adapter, and the times in ns."""
    us = [100_000 + 31_007 * k + k * k for k in range(count)]
    if form == "csv":
        rows = [f"{k};{Decimal(t) / 1000}" for k, t in enumerate(us)]
        (folder / "times.csv").write_text("\n".join(["number;middle", *rows]) + "\n")
        times: dict[str, Any] = {"files": "{who}/times.csv", "column": "middle", "unit": "ms"}
    else:
        np.save(folder / "times.npy", np.array(us, np.uint64))
        times = {"files": "{who}/times.npy", "unit": "us"}
    return {"times": times}, [t * 1000 for t in us]


def at_rate(count: int, rate: str) -> tuple[dict[str, Any], list[int]]:
    """Return the key of an adapter, and the times at an even rate in ns by decimal arithmetic."""
    times = [Decimal(k) * 10**9 / Decimal(rate) for k in range(count)]
    return {"rate_hz": float(rate)}, [int(t.to_integral_value(ROUND_HALF_UP)) for t in times]


FURTHER = pytest.mark.long


FIRST = {("video", "csv"), ("images", "npy"), ("numpy", "rate")}


@pytest.mark.parametrize(
    ("form", "timing"),
    [
        pytest.param(form, timing, marks=() if (form, timing) in FIRST else FURTHER)
        for form in ("video", "images", "numpy")
        for timing in ("csv", "npy", "rate")
    ],
)
def test_frames_and_their_times_are_those_of_the_files(
    form: str, timing: str, tmp_path: Path
) -> None:
    folder, images = folder_of(tmp_path), some_frames()
    write_frames(folder, form, images)
    timed, t_ns = at_rate(35, "29.97") if timing == "rate" else write_times(folder, timing, 35)
    recording = imported(adapter({"frames": {**FRAMES[form], "format": form, **timed}}), tmp_path)
    np.testing.assert_array_equal(np.stack(list(recording.frames())), images)
    with recording.open() as reader:
        assert reader.column("frames/t").tolist() == t_ns
        assert reader.column("frames/number").tolist() == list(range(35))
    assert recording.frame_px == (16, 12)
    assert recording.record.clocks.frames.grade == "unknown"
    assert "clock of frames" in recording.record.imported.unknown
    # events end at 1 s, frames later
    assert recording.record.imported.span_ns == (0, t_ns[-1] + 1000)


@pytest.mark.parametrize("form", FRAMES)
@pytest.mark.parametrize(
    "times", [30, 40, pytest.param(64, marks=FURTHER), pytest.param(0, marks=FURTHER)]
)
def test_other_counts_of_times_than_frames_are_refused(
    form: str, times: int, tmp_path: Path
) -> None:
    folder = folder_of(tmp_path)
    write_frames(folder, form, some_frames())
    timed, _ = write_times(folder, "npy", times)
    made = adapter({"frames": {**FRAMES[form], "format": form, **timed}})
    refused(made, tmp_path, f"streams.frames: holds 35 frames, and {times} times of frames")


def test_frames_that_are_none_are_refused_with_their_file(tmp_path: Path) -> None:
    folder = folder_of(tmp_path)
    made = adapter({"frames": {**FRAMES["images"], "format": "images", "rate_hz": 30}})
    write_frames(folder, "images", some_frames(2))
    other = np.zeros((12, 15), np.uint8)
    assert cv2.imwrite(str(folder / "img" / "10.png"), other)
    assert imported(made, tmp_path).record.imported.dropped == {"frames of another size": 1}
    shutil.rmtree(tmp_path / "store")
    (folder / "img" / "10.png").write_bytes(b"\x89PNG")
    refused(made, tmp_path, "an image that cannot be read: ann/img/10.png")
    (folder / "img" / "10.png").write_bytes(b"")
    refused(made, tmp_path, "an image that cannot be read: ann/img/10.png")
    made = adapter({"frames": {**FRAMES["video"], "format": "video", "rate_hz": 30}})
    (folder / "film.mkv").write_bytes(b"\x1a\x45\xdf\xa3 and no video")
    refused(made, tmp_path, "film.mkv: streams.frames: is no video that can be read")
    other = tmp_path / "elsewhere.mkv"
    write_frames(tmp_path, "video", some_frames(2))
    (tmp_path / "film.mkv").rename(other)
    for text in (f"ffconcat version 1.0\nfile '{other}'\n", f"#EXTM3U\n#EXTINF:1,\n{other}\n"):
        (folder / "film.mkv").write_text(text)  # a list of other files is no video
        refused(made, tmp_path, "film.mkv: streams.frames: is no video that can be read")
    made = adapter({"frames": {**FRAMES["numpy"], "format": "numpy", "rate_hz": 30}})
    for wrong, message in (
        (np.zeros((2, 3, 4, 3), np.uint8), r"uint8 of shape \(2, 3, 4, 3\); frames are"),
        (np.zeros((2, 3, 4)), r"float64 of shape \(2, 3, 4\); frames are uint8"),
        (np.zeros((0, 3, 4), np.uint8), r"uint8 of shape \(0, 3, 4\)"),
    ):
        np.save(folder / "frames.npy", wrong)
        refused(made, tmp_path, f"frames.npy: streams.frames: holds {message}")


def test_wrong_times_of_frames_name_the_file_of_times(tmp_path: Path) -> None:
    folder = folder_of(tmp_path)
    write_frames(folder, "numpy", some_frames(3))
    for times, column, message in (
        ("1\nx\n2\n", 0, "has 1 row without a number"),
        ("1\n2\n3\n", "t", "has no column t; there are 1"),
    ):
        (folder / "times.csv").write_text(times)
        timed = {"files": "{who}/times.csv", "column": column, "unit": "ms"}
        made = adapter({"frames": {**FRAMES["numpy"], "format": "numpy", "times": timed}})
        refused(made, tmp_path, rf"times.csv: streams.frames.times: .*{message}")


def test_a_recording_of_frames_only_lies_on_their_clock(tmp_path: Path) -> None:
    images = some_frames(4)
    for who in ("ann", "bob"):
        folder = tmp_path / "set" / who
        folder.mkdir(parents=True)
        write_frames(folder, "numpy", images)
        np.save(folder / "times.npy", np.array([2.5, 2.75, 3.0, 4.0]))
    (tmp_path / "set" / "marks.csv").write_text("who,first,full\nann,0.25,1.5\nbob,2,\n")
    onsets = ONSETS | {"unit": "s", "clock": "start", "uncertainty_ms": 3}
    timed = {"files": "{who}/times.npy", "unit": "s"}
    streams = {"frames": {**FRAMES["numpy"], "format": "numpy", "times": timed}}
    made = {**BASE, "streams": streams, "labels": {"onsets": onsets}}
    made["trials"] = {"files": "{who}/frames.npy", "id": "{who}"}
    with pytest.raises(InputError, match=r"row 3, first = 2: lies outside of .* trial bob"):
        imported(made, tmp_path)
    (tmp_path / "set" / "marks.csv").write_text("who,first,full\nann,0.25,1.5\nbob,1.5,\n")
    made["name"] = "again"
    record = imported(made, tmp_path).record
    assert record.clocks.reference == "frame camera"
    assert record.clocks.events is None
    assert record.imported.span_ns == (2_500_000_000, 4_000_001_000)
    assert record.imported.unknown == ("events",)
    given = record.imported.given
    assert (given.incipient_ns, given.gross_ns) == (2_750_000_000, 4_000_000_000)
    assert given.uncertainty_ns == 3_000_000
    onsets |= {"clock": "frames"}
    (tmp_path / "set" / "marks.csv").write_text("who,first,full\nann,2.75,4\nbob,2.5,\n")
    made["name"] = "by-frames"
    given = imported(made, tmp_path).record.imported.given
    assert (given.incipient_ns, given.gross_ns) == (2_750_000_000, 4_000_000_000)
    (tmp_path / "set" / "bob" / "times.npy").unlink()
    file = tmp_path / "adapter.yaml"
    with closing(DataFolder(tmp_path / "set")) as opened:
        found = find_trials(load_adapter(file), file, opened)
    assert [trial.id for trial in found.trials] == ["ann"]
    reason = "trial bob has no file of frames.times"
    assert Skipped("bob/frames.npy", reason) in found.skipped


def on_line(stamp_ns: int, offset_ms: str, drift_ppm: str) -> int:
    """Return a time on the time line by decimal arithmetic: offset plus gained time, ns."""
    exact = Decimal(offset_ms) * 10**6 + stamp_ns * (1 + Decimal(drift_ppm) / 10**6)
    return int(exact.to_integral_value(ROUND_HALF_UP))


@pytest.mark.parametrize(
    ("offset_ms", "drift_ppm"),
    [("0", "100"), ("-3.25", "-100"), ("86400000.000001", "12.345678"), ("0.1", "0.0004")],
)
def test_each_stream_has_its_clock_to_the_nanosecond_after_an_hour(
    offset_ms: str, drift_ppm: str, tmp_path: Path
) -> None:
    folder = folder_of(tmp_path)
    stamps = [0, 1, 1_799_999_999_999, HOUR_NS]
    rng = np.random.default_rng(2)
    xyz, turned, force, torque = rng.normal(size=(4, 4, 3))
    heat = rng.normal(size=4)
    with (folder / "arm.csv").open("w") as file:
        writer = csv.writer(file, delimiter="\t")
        writer.writerow(["rz", "t", "x", "y", "z", "rx", "ry"])
        for t, place, turn in zip(stamps, xyz.tolist(), turned.tolist(), strict=True):
            writer.writerow([turn[2], t, *place, *turn[:2]])
    axes = [f"{kind}{axis}" for kind in "ft" for axis in "xyz"]
    rows = np.zeros(4, [("when", "<i8"), ("f", "<f8", 3), *((name, "<f8") for name in axes)])
    rows["when"] = stamps
    for index, axis in enumerate("xyz"):
        rows[f"f{axis}"], rows[f"t{axis}"] = force[:, index], torque[:, index]
    np.save(folder / "force.npy", rows)
    np.save(folder / "heat.npy", np.stack([np.arange(4.0), heat], axis=1))
    clock = {"offset_ms": float(offset_ms), "drift_ppm": float(drift_ppm)}
    poses = {"files": "{who}/arm.csv", "format": "csv", "unit": "ns", "length": "m", "angle": "rad"}
    poses["columns"] = {key: key for key in ("t", "x", "y", "z", "rx", "ry", "rz")}
    felt = {"files": "{who}/force.npy", "format": "numpy", "unit": "ns", "clock": clock}
    felt["columns"] = {"t": "when", **{name: name for name in axes}}
    warm = {"files": "{who}/heat.npy", "format": "numpy", "unit": "s", "quantity_unit": "degC"}
    warm["columns"] = {"t": 0, "value": 1}
    poses["clock"] = {**clock, "uncertainty_ms": 0.25}
    streams = {"poses": poses, "wrenches": {"force": felt}, "scalars": {"heat": warm}}
    made = adapter(streams)
    recording = imported(made, tmp_path)
    with recording.open() as reader:
        poses, wrench, scalar = reader.poses(), reader.wrenches("force"), reader.scalars("heat")
    assert poses.t_ns.tolist() == wrench.t_ns.tolist() == stamps
    np.testing.assert_array_equal(poses.xyz_mm, xyz * 1000)
    np.testing.assert_array_equal(poses.rotvec_deg, np.rad2deg(turned))
    np.testing.assert_array_equal(wrench.force_n, force)
    np.testing.assert_array_equal(wrench.torque_nm, torque)
    assert scalar.t_ns.tolist() == [0, 10**9, 2 * 10**9, 3 * 10**9]
    np.testing.assert_array_equal(scalar.value, heat)
    assert scalar.unit == recording.record.streams["heat"].unit == "degC"
    for device in ("arm", "force"):
        found = recording.clock(device).to_reference(np.array(stamps))
        assert found.tolist() == [on_line(stamp, offset_ms, drift_ppm) for stamp in stamps]
    devices = recording.record.clocks.devices()
    known = [devices[name] for name in ("arm", "force", "heat")]
    assert [clock.grade for clock in known] == ["given", "given", "unknown"]
    assert [clock.uncertainty_ns for clock in known] == [250_000, None, None]
    assert recording.record.imported.unknown == ("clock of heat",)
    assert recording.clock("heat").to_reference(HOUR_NS) == HOUR_NS


def test_angles_in_degrees_and_places_in_mm_stay_as_they_are(tmp_path: Path) -> None:
    folder = folder_of(tmp_path)
    (folder / "arm.csv").write_text("0 1.5 -2 0.1 90 0 -45.25\n0.5 1 2 3 0 0 0\n")
    columns = dict(zip(("t", "x", "y", "z", "rx", "ry", "rz"), range(7), strict=True))
    made = {"files": "{who}/arm.csv", "format": "csv", "unit": "s", "angle": "deg", "clock": {}}
    recording = imported(adapter({"poses": {**made, "columns": columns}}), tmp_path)
    with recording.open() as reader:
        poses = reader.poses()
    assert poses.t_ns.tolist() == [0, 500_000_000]
    assert poses.xyz_mm.tolist() == [[1.5, -2, 0.1], [1, 2, 3]]
    assert poses.rotvec_deg.tolist() == [[90, 0, -45.25], [0, 0, 0]]
    assert recording.record.clocks.arm.grade == "given"
    assert recording.record.clocks.arm.uncertainty_ns is None


@pytest.mark.quick(1)
@pytest.mark.parametrize(
    ("clock", "uncertainty_ns"),
    [
        ({"offset_ms": -12.5, "drift_ppm": 100, "uncertainty_ms": 0.5}, 2_500_000),
        ({"offset_ms": -12.5, "drift_ppm": 100}, None),
        (None, None),
    ],
)
def test_a_label_on_the_frames_clock_after_an_hour_lies_where_its_drift_puts_it(
    clock: dict[str, Any] | None, uncertainty_ns: int | None, tmp_path: Path
) -> None:
    folder = folder_of(tmp_path, last_us=3_601_000_000)
    folder_of(tmp_path, "bob", last_us=3_601_000_000)  # its frames are lost
    write_frames(folder, "numpy", some_frames(2))
    frames = {**FRAMES["numpy"], "format": "numpy", "rate_hz": 1}
    frames |= {} if clock is None else {"clock": clock}
    rows = ["who,first,full", "ann,3600000000000,3600000000007", "bob,3600000000000,"]
    (tmp_path / "set" / "marks.csv").write_text("\n".join(rows) + "\n")
    onsets = ONSETS | {"unit": "ns", "clock": "frames", "uncertainty_ms": 2}
    made = adapter({"frames": frames}, labels={"onsets": onsets})
    campaign = bring(made, tmp_path / "set", tmp_path / "store")
    offset, drift = ("-12.5", "100") if clock else ("0", "0")
    first, full = (on_line(HOUR_NS + more, offset, drift) for more in (0, 7))
    given = campaign.recording("ann").record.imported.given
    assert (given.incipient_ns, given.gross_ns) == (first, full)
    assert given.uncertainty_ns == uncertainty_ns
    given = campaign.recording("bob").record.imported.given
    assert (given.incipient_ns, given.uncertainty_ns) == (first, uncertainty_ns)


SPANS: dict[str, Any] = {"file": "marks.csv", "match": {"trial": "{who}"}, "start": "a", "end": "b"}
SPANS |= {"class": "what", "unit": "ms", "names": {"pause": "", "rub": "slide"}}


def test_a_second_import_takes_the_labels_of_new_trials_from_the_table_of_all(
    tmp_path: Path,
) -> None:
    made = adapter(experiment="classes", labels={"spans": SPANS})
    for who in ("ann", "bob"):
        folder_of(tmp_path, who)
    rows = ["trial,a,b,what", "ann,0,100,rub", "ann,100,250,pause", "ann,250,500,tap"]
    rows += ["cid,1,2,tap", "bob,10,20,pause"]
    marks = tmp_path / "set" / "marks.csv"
    marks.write_text("\n".join(rows) + "\n")
    first = bring(made, tmp_path / "set", tmp_path / "store")
    given = first.recording("ann").record.imported.given
    assert [(s.start_ns, s.end_ns, s.name) for s in given.spans] == [
        (0, 100_000_000, "slide"),
        (250_000_000, 500_000_000, "tap"),
    ]
    assert given.source == "marks.csv"
    assert first.recording("bob").record.imported.given is None
    kept = first.recording("ann").raw_checksum
    folder_of(tmp_path, "cid")
    # what is said now of a trial that is there does not change it
    rows[1] = "ann,0,90,tap"
    rows.append("cid,0.25,1000,rub")
    rows[4] = "cid,1000,1000.0005,pause"
    marks.write_text("\n".join(rows) + "\n")
    again = bring(made, tmp_path / "set", tmp_path / "store")
    assert again.recording("ann").raw_checksum == kept
    given = again.recording("cid").record.imported.given
    assert [(s.start_ns, s.end_ns, s.name) for s in given.spans] == [(250_000, 10**9, "slide")]
    changed = {**SPANS, "names": {}}
    other = adapter(experiment="classes", labels={"spans": changed})
    with pytest.raises(InputError, match="labels: differs from the adapter of campaign 'streams'"):
        bring(other, tmp_path / "set", tmp_path / "store")


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("ann,400,300,tap", "row 3, b = 300: must be after a = 400"),
        ("ann,50,300,tap", "row 3, a = 50: lies inside the interval of row 2"),
        ("ann,300,,tap", "row 3, b: is empty"),
        ("ann,300,400,", "row 3, what: is empty"),
        ("ann,300,1e3x,tap", "row 3, b = 1e3x: must be a time in ms"),
        ("ann,300,1000.002,tap", "row 3, b = 1000.002: lies outside of the recording of trial ann"),
        ("ann,-1,0,tap", "row 3, a = -1: lies outside of the recording of trial ann"),
    ],
)
def test_a_wrong_interval_is_named(row: str, message: str, tmp_path: Path) -> None:
    folder_of(tmp_path)
    (tmp_path / "set" / "marks.csv").write_text(f"trial,a,b,what\nann,0,100,rub\n{row}\n")
    made = adapter(experiment="classes", labels={"spans": SPANS})
    refused(made, tmp_path, f"marks.csv: {message}")


@pytest.mark.parametrize(("clock", "moved_ns"), [("start", 500_000_000), ("frames", 7_500_000)])
def test_onsets_and_motion_on_another_clock_come_to_the_time_line(
    clock: str, moved_ns: int, tmp_path: Path
) -> None:
    folder = folder_of(tmp_path, last_us=2_000_000)
    (folder / "events.csv").write_text("500000,1,2,1\n2000000,7,5,0\n")
    write_frames(folder, "numpy", some_frames(2))
    (tmp_path / "set" / "t.jsonl").write_text('{"trial": "ann", "a": 0.7000000001, "b": 0.9}\n')
    onsets = {"file": "t.jsonl", "match": {"trial": "{id}"}, "incipient": "a", "gross": "b"}
    onsets |= {"unit": "s", "clock": clock, "uncertainty_ms": 1}
    frames = {**FRAMES["numpy"], "format": "numpy", "times": {"files": "{who}/t.npy", "unit": "s"}}
    frames["clock"] = {"offset_ms": 7.5, "uncertainty_ms": 0.25}
    np.save(folder / "t.npy", np.array([0.6, 0.7]))
    motion = {"start": 0.6, "end": "0.95", "unit": "s", "clock": clock}
    made = adapter({"frames": frames}, labels={"onsets": onsets}, motion=motion)
    recording = imported(made, tmp_path)
    given = recording.record.imported.given
    assert given.incipient_ns == 700_000_000 + moved_ns
    assert given.gross_ns == 900_000_000 + moved_ns
    assert given.uncertainty_ns == (1_000_000 if clock == "start" else 1_250_000)
    assert recording.motion_ns == (600_000_000 + moved_ns, 950_000_000 + moved_ns)
