"""Streams, clocks and labels that adapters read, each compared with what was put in."""

from __future__ import annotations

import csv
import io
import zipfile
from collections.abc import Callable, Mapping
from contextlib import closing
from decimal import ROUND_HALF_UP, Decimal
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest

from sliplab.protocols.adapter import load_adapter
from sliplab.protocols.errors import InputError
from sliplab.storage.formats import data_folder, tables
from sliplab.storage.formats.adapted_trials import find_trials
from sliplab.storage.formats.data_folder import DataFolder
from sliplab.storage.formats.foreign import Skipped
from sliplab.storage.trials.recording import Recording
from tests.storage.formats.adapters import SLIDES, bring, slides
from tests.storage.formats.files import SMALL, lab_pickles
from tests.storage.formats.recordings import (
    SIZE,
    all_events,
    write_aedat4,
    write_dat,
    write_dsec,
    write_es,
    write_evt2,
    write_lab,
    write_mcap,
)

HOUR_NS = 3_600_000_000_000
EVENTS: dict[str, Any] = {
    "format": "csv", "columns": {"t": 0, "x": 1, "y": 2, "p": 3}, "unit": "us", "size_px": [8, 6],
}  # fmt: skip
BASE: dict[str, Any] = {
    "adapter": 1,
    "name": "streams",
    "experiment": "kinematic",
    "trials": {"files": "{who}/events.csv", "id": "{who}"},
    "streams": {"events": EVENTS},
}
FRAMES: dict[str, Any] = {
    "images": {"files": "{who}/img/*.png"},
    "numpy": {"files": "{who}/frames.npy"},
    "video": {"files": "{who}/film.mkv"},
}


def adapter(streams: Mapping[str, Any] | None = None, **more: Any) -> dict[str, Any]:
    """An adapter with streams beside the events, and further keys."""
    return {**BASE, "streams": {**BASE["streams"], **(streams or {})}, **more}


def folder_of(tmp_path: Path, who: str = "ann", last_us: int = 1_000_000) -> Path:
    """Make the folder of a trial with two events, and return it."""
    folder = tmp_path / "set" / who
    folder.mkdir(parents=True)
    (folder / "events.csv").write_text(f"0,1,2,1\n{last_us},7,5,0\n")
    return folder


def imported(made: dict[str, Any], tmp_path: Path, who: str = "ann") -> Recording:
    """Import the set of a test, and return one of its trials."""
    return bring(made, tmp_path / "set", tmp_path / "store").recording(who)


def refused(made: dict[str, Any], tmp_path: Path, message: str) -> None:
    """Import what is wrong: it is named, and nothing of it stays."""
    with pytest.raises(InputError, match=message):
        bring(made, tmp_path / "set", tmp_path / "store")
    assert not list((tmp_path / "store").glob("campaigns/*"))


def write_frames(folder: Path, form: str, images: Any) -> None:
    """Write frames in a form that loses nothing; the names of images sort otherwise as text."""
    if form == "numpy":
        np.save(folder / "frames.npy", images)
    elif form == "images":
        (folder / "img").mkdir()
        for number, image in enumerate(images):
            assert cv2.imwrite(str(folder / "img" / f"{8 + number}.png"), image)
    else:
        with av.open(str(folder / "film.mkv"), "w") as file:
            stream = file.add_stream("ffv1", rate=30)
            stream.height, stream.width = images.shape[1:]
            stream.pix_fmt = "gray"
            for image in images:
                file.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="gray")))
            file.mux(stream.encode(None))


def some_frames(count: int = 35) -> Any:
    """Frames of noise: none is like another."""
    return np.random.default_rng(count).integers(0, 256, (count, 12, 16)).astype(np.uint8)


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


@pytest.mark.parametrize(
    ("form", "timing"),
    [
        ("video", "csv"), ("images", "npy"), ("numpy", "rate"),
        pytest.param("video", "rate", marks=FURTHER), pytest.param("video", "npy", marks=FURTHER),
        pytest.param("images", "csv", marks=FURTHER), pytest.param("images", "rate", marks=FURTHER),
        pytest.param("numpy", "csv", marks=FURTHER), pytest.param("numpy", "npy", marks=FURTHER),
    ],
)  # fmt: skip
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
    ("times", "message"),
    [
        (34, "holds more than 34 frames, as there are times"),
        (36, "holds 35 frames, and 36 times of frames"),
        pytest.param(32, "holds more than 32 frames", marks=FURTHER),
        pytest.param(0, "holds more than 0 frames", marks=FURTHER),
    ],
)
def test_another_number_of_times_than_frames_is_refused(
    form: str, times: int, message: str, tmp_path: Path
) -> None:
    folder = folder_of(tmp_path)
    write_frames(folder, form, some_frames())
    timed, _ = write_times(folder, "npy", times)
    made = adapter({"frames": {**FRAMES[form], "format": form, **timed}})
    refused(made, tmp_path, f"streams.frames: {message}")


def test_frames_that_are_none_are_refused_with_their_file(tmp_path: Path) -> None:
    folder = folder_of(tmp_path)
    made = adapter({"frames": {**FRAMES["images"], "format": "images", "rate_hz": 30}})
    write_frames(folder, "images", some_frames(2))
    other = np.zeros((12, 15), np.uint8)
    assert cv2.imwrite(str(folder / "img" / "10.png"), other)
    refused(made, tmp_path, r"frames of \(12, 15\) and of \(12, 16\)")
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
        ("1\n2\n2\n", 0, "times of frames that do not rise"),
        ("1\nx\n2\n", 0, "column 0 that is not all numbers: row 2 is 'x'"),
        ("1\n2\n3\n", "t", "has no column t; there are 1"),
        ("1\n2\ninf\n", 0, "row 3 is inf"),
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
    onsets = {
        "file": "marks.csv", "match": {"who": "{id}"}, "incipient": "first", "gross": "full",
        "unit": "s", "clock": "start", "uncertainty_ms": 3,
    }  # fmt: skip
    timed = {"files": "{who}/times.npy", "unit": "s"}
    streams = {"frames": {**FRAMES["numpy"], "format": "numpy", "times": timed}}
    made = {
        **BASE, "trials": {"files": "{who}/frames.npy", "id": "{who}"}, "streams": streams,
        "labels": {"onsets": onsets},
    }  # fmt: skip
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
    rows = np.zeros(4, [("when", "<i8"), ("f", "<f8", 3), ("fx", "<f8"), ("fy", "<f8"),
                        ("fz", "<f8"), ("tx", "<f8"), ("ty", "<f8"), ("tz", "<f8")])  # fmt: skip
    rows["when"] = stamps
    for index, axis in enumerate("xyz"):
        rows[f"f{axis}"], rows[f"t{axis}"] = force[:, index], torque[:, index]
    np.save(folder / "force.npy", rows)
    np.save(folder / "heat.npy", np.stack([np.arange(4.0), heat], axis=1))
    clock = {"offset_ms": float(offset_ms), "drift_ppm": float(drift_ppm)}
    made = adapter({
        "poses": {
            "files": "{who}/arm.csv", "format": "csv", "unit": "ns", "length": "m", "angle": "rad",
            "columns": {key: key for key in ("t", "x", "y", "z", "rx", "ry", "rz")},
            "clock": {**clock, "uncertainty_ms": 0.25},
        },
        "wrenches": {"force": {
            "files": "{who}/force.npy", "format": "numpy", "unit": "ns", "clock": clock,
            "columns": {"t": "when", **{k: k for k in ("fx", "fy", "fz", "tx", "ty", "tz")}},
        }},
        "scalars": {"heat": {
            "files": "{who}/heat.npy", "format": "numpy", "unit": "s", "quantity_unit": "degC",
            "columns": {"t": 0, "value": 1},
        }},
    })  # fmt: skip
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
    known = recording.record.clocks.devices()
    assert [known[name].grade for name in ("arm", "force", "heat")] == ["given"] * 2 + ["unknown"]
    assert [known[name].uncertainty_ns for name in ("arm", "force", "heat")] == [
        250_000,
        None,
        None,
    ]
    assert recording.record.imported.unknown == ("clock of heat",)
    assert recording.clock("heat").to_reference(HOUR_NS) == HOUR_NS


def test_angles_in_degrees_and_places_in_mm_stay_as_they_are(tmp_path: Path) -> None:
    folder = folder_of(tmp_path)
    (folder / "arm.csv").write_text("0 1.5 -2 0.1 90 0 -45.25\n0.5 1 2 3 0 0 0\n")
    made = adapter({"poses": {
        "files": "{who}/arm.csv", "format": "csv", "unit": "s", "angle": "deg",
        "columns": dict(zip(("t", "x", "y", "z", "rx", "ry", "rz"), range(7), strict=True)),
        "clock": {},
    }})  # fmt: skip
    recording = imported(made, tmp_path)
    with recording.open() as reader:
        poses = reader.poses()
    assert poses.t_ns.tolist() == [0, 500_000_000]
    assert poses.xyz_mm.tolist() == [[1.5, -2, 0.1], [1, 2, 3]]
    assert poses.rotvec_deg.tolist() == [[90, 0, -45.25], [0, 0, 0]]
    assert recording.record.clocks.arm.grade == "given"
    assert recording.record.clocks.arm.uncertainty_ns is None


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
    onsets = {
        "file": "marks.csv", "match": {"who": "{id}"}, "incipient": "first", "gross": "full",
        "unit": "ns", "clock": "frames", "uncertainty_ms": 2,
    }  # fmt: skip
    campaign = bring(
        adapter({"frames": frames}, labels={"onsets": onsets}), tmp_path / "set", tmp_path / "store"
    )
    offset, drift = ("-12.5", "100") if clock else ("0", "0")
    first, full = (on_line(HOUR_NS + more, offset, drift) for more in (0, 7))
    given = campaign.recording("ann").record.imported.given
    assert (given.incipient_ns, given.gross_ns) == (first, full)
    assert given.uncertainty_ns == uncertainty_ns
    given = campaign.recording("bob").record.imported.given
    assert (given.incipient_ns, given.uncertainty_ns) == (first, uncertainty_ns)


KNOWN: dict[str, tuple[str, str, Callable[[Path], None], tuple[int, int] | None]] = {
    "aedat4": ("aedat4", "a.aedat4", write_aedat4, SIZE),
    "dsec": ("dsec", "a.h5", write_dsec, None),
    "lab-hdf5": ("lab-hdf5", "a.h5", write_lab, SIZE),
    "mcap": ("mcap", "a.mcap", write_mcap, SIZE),
    "raw": ("raw", "a.raw", write_evt2, SIZE),
    "dat": ("raw", "a.dat", write_dat, SIZE),
    "es": ("es", "a.es", write_es, SIZE),
}
LIBRARIES = {"mcap": "mcap", "es": "faery"}


def zipped(path: Path) -> Path:
    """Pack a folder into a zip beside it, and return that."""
    packed = path.parent / f"{path.name}.zip"
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as file:
        for each in sorted(path.rglob("*")):
            file.write(each, each.relative_to(path))
    return packed


@pytest.mark.parametrize("name", KNOWN)
def test_events_of_a_known_format_are_those_of_the_file(name: str, tmp_path: Path) -> None:
    form, file, write, size = KNOWN[name]
    if form in LIBRARIES:
        pytest.importorskip(LIBRARIES[form])
    folder = tmp_path / "set" / "s7"
    folder.mkdir(parents=True)
    write(folder / file)
    made = {
        **BASE, "trials": {"files": f"s{{number:number}}/{file}", "id": "trial-{number}"},
        "streams": {"events": {"format": form}},
    }  # fmt: skip
    whole = all_events()
    for path in (tmp_path / "set", zipped(tmp_path / "set")):
        campaign = bring(made, path, tmp_path / f"store{path.suffix}")
        recording = campaign.recording("trial-7")
        events = recording.events()
        for column, values in vars(whole).items():
            np.testing.assert_array_equal(getattr(events, column), values)
        record = recording.record
        assert record.geometry.event_px == size
        assert ("sensor size" in record.imported.unknown) == (size is None)
        assert record.imported.span_ns == (
            int(whole.t_us[0]) * 1000, (int(whole.t_us[-1]) + 1) * 1000
        )  # fmt: skip
        assert record.imported.fields == {"number": "7"}
        with recording.open() as reader:
            pulses = reader.pulses("event_pulses")
        assert pulses.tolist() == (whole.t_us[::100] * 1000).tolist() * (form == "aedat4")


def test_frames_in_the_file_of_the_events_come_with_them(tmp_path: Path) -> None:
    (tmp_path / "set").mkdir()
    write_aedat4(tmp_path / "set" / "a.aedat4")
    made = {
        **BASE,
        "trials": {"files": "{who}.aedat4"},
        "streams": {"events": {"format": "aedat4"}},
    }
    recording = bring(made, tmp_path / "set", tmp_path / "store").recording("a")
    assert recording.record.counts.frames == 3
    assert recording.frame_px[:2] == (8, 6)
    assert [int(recording.frame(k).mean()) for k in range(3)] == [0, 10, 20]
    assert "clock of frames" in recording.record.imported.unknown


@pytest.mark.usefixtures("small")
def test_the_labs_pickles_are_one_trial_of_two_files(tmp_path: Path) -> None:
    (tmp_path / "set").mkdir()
    lab_pickles(tmp_path / "set", "d3_s0.5", SMALL[::-1], by_columns=True)
    made = {
        **BASE, "trials": {"files": "{what}_events_on.pickle", "id": "{what}"},
        "streams": {"events": {"format": "lab-pickles", "files": "{what}_events_*.pickle"}},
    }  # fmt: skip
    for path in (tmp_path / "set", zipped(tmp_path / "set")):
        events = bring(made, path, tmp_path / f"store{path.suffix}").recording("d3_s0.5").events()
        found = sorted(zip(*(column.tolist() for column in vars(events).values()), strict=True))
        assert found == [
            (0, 0, 0, 125), (3, 5, 0, 11_250), (3, 5, 1, 10_000), (3, 5, 1, 12_500),
            (7, 5, 1, 11_000),
        ]  # fmt: skip
    (tmp_path / "set" / "d3_s0.5_events_off.pickle").write_bytes(b"\x80\x04.")
    for path in (tmp_path / "set", zipped(tmp_path / "set")):
        with pytest.raises(InputError, match=f"{path}/d3_s0.5_events_off.pickle: "):
            bring({**made, "name": "damaged"}, path, tmp_path / "store")


ROWS = [(0, 7, 5, 1), (3, 0, 0, -1), (3, 1, 4, 0), (999_999, 2, 3, 1)]


def _text(
    separator: str, heading: str | None, *, end: str = "\n", mark: str = "", quoted: bool = False
) -> bytes:
    file = io.StringIO()
    quoting = csv.QUOTE_NONNUMERIC if quoted else csv.QUOTE_MINIMAL
    writer = csv.writer(file, delimiter=separator, lineterminator=end, quoting=quoting)
    if heading is not None:
        writer.writerow(heading.split("|"))
    writer.writerows([(p, t, x, y) for t, x, y, p in ROWS])
    return (mark + file.getvalue()).encode()


NAMED = {"t": "time", "x": "col", "y": "row", "p": "pol"}
BY_INDEX = {"t": 1, "x": 2, "y": 3, "p": 0}
HEADING = "pol|time|col|row"
TEXTS: dict[str, tuple[bytes, dict[str, Any]]] = {
    **{
        f"{what} {said}": (_text(separator, heading), columns)
        for what, separator in (
            ("commas", ","), ("semicolons", ";"), ("tabs", "\t"), ("spaces", " ")
        )
        for said, heading, columns in (
            ("headed", HEADING, NAMED), ("headed by index", HEADING, BY_INDEX),
            ("bare", None, BY_INDEX),
        )
    },
    "Windows' ends and a mark": (_text(",", HEADING, end="\r\n", mark="\ufeff"), NAMED),
    "a mark and no heading": (_text(",", None, mark="\ufeff"), BY_INDEX),
    "a separator in a name": (
        _text(",", "pol, -1 or 1|time|col|row"), {**NAMED, "p": "pol, -1 or 1"}
    ),
    "another one in a name": (
        _text(",", "pol; -1 or 1|time|col|row", quoted=True), {**NAMED, "p": "pol; -1 or 1"}
    ),
    "spaces in rows": (_text(",", HEADING).replace(b",", b" , "), NAMED),
    "many spaces": (
        b"".join(b"  %4d %8d   %2d %2d\n" % (p, t, x, y) for t, x, y, p in ROWS), BY_INDEX
    ),
    "no end": (_text(",", None).rstrip(), BY_INDEX),
}  # fmt: skip


def check_rows(recording: Recording, rows: list[tuple[int, int, int, int]]) -> None:
    """Check that events are rows of time, column, row and polarity."""
    events = recording.events()
    found = list(zip(events.t_us.tolist(), events.x.tolist(), events.y.tolist(), events.p.tolist(),
                     strict=True))  # fmt: skip
    assert found == [(t, x, y, int(p > 0)) for t, x, y, p in rows]


@pytest.mark.parametrize("name", TEXTS)
def test_events_of_a_table_of_text_are_its_rows(name: str, tmp_path: Path) -> None:
    text, columns = TEXTS[name]
    folder = folder_of(tmp_path)
    (folder / "events.csv").write_bytes(text)
    made = {**BASE, "streams": {"events": {**EVENTS, "columns": columns}}}
    check_rows(imported(made, tmp_path), ROWS)


def _structured() -> Any:
    return np.array(ROWS, [("time", ">i8"), ("col", "<u2"), ("row", "u1"), ("pol", "i1")])


def _columns() -> dict[str, Any]:
    rows = _structured()
    return {name: rows[name] for name in rows.dtype.names}


ARRAYS: dict[str, tuple[Callable[[Path], None], dict[str, Any]]] = {
    "structured": (lambda path: np.save(path, _structured()), NAMED),
    "whole numbers": (
        lambda path: np.save(path, np.array(ROWS, np.int32)), {"t": 0, "x": 1, "y": 2, "p": 3}
    ),
    "columns first": (
        lambda path: np.save(path, np.asfortranarray(np.array(ROWS, float))),
        {"t": 0, "x": 1, "y": 2, "p": 3},
    ),
    "an archive": (
        lambda path: np.savez(path, **_columns()), NAMED
    ),
    "a packed archive": (
        lambda path: np.savez_compressed(path, **_columns()), NAMED
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", ARRAYS)
def test_events_of_arrays_are_their_rows(name: str, tmp_path: Path) -> None:
    write, columns = ARRAYS[name]
    file = "events.npz" if "archive" in name else "events.npy"
    write(folder_of(tmp_path) / file)
    made = adapter(trials={"files": f"{{who}}/{file}", "id": "{who}"})
    made["streams"] = {"events": {**EVENTS, "format": "numpy", "columns": columns}}
    check_rows(imported(made, tmp_path), ROWS)


def test_times_in_each_unit_become_the_nearest_microsecond(tmp_path: Path) -> None:
    for unit, times in (
        ("ns", "0 499 500 1499 1500 999999999"),
        ("us", "0 0.499 0.5 1.499 1.5 999999.999"),
        ("ms", "0 0.000499 0.0005 0.001499 0.0015 999.999999"),
        ("s", "0 0.000000499 0.0000005 0.000001499 0.0000015 0.999999999"),
    ):
        folder = folder_of(tmp_path / unit)
        (folder / "events.csv").write_text("".join(f"{t},1,2,1\n" for t in times.split()))
        made = {**BASE, "streams": {"events": {**EVENTS, "unit": unit}}}
        events = imported(made, tmp_path / unit).events()
        assert events.t_us.tolist() == [0, 0, 1, 1, 2, 1_000_000], unit


def test_rows_out_of_order_are_sorted_and_polarities_are_those_named(tmp_path: Path) -> None:
    folder = folder_of(tmp_path)
    (folder / "events.csv").write_text("9,1,1,1\n4,2,2,2\n4,3,3,3\n0,4,4,4\n")
    made = {**BASE, "streams": {"events": {**EVENTS, "positive": [2, 4]}}}
    check_rows(imported(made, tmp_path), [(0, 4, 4, 1), (4, 2, 2, 1), (4, 3, 3, 0), (9, 1, 1, 0)])
    taxels = {**EVENTS, "columns": {"t": 0, "x": 1}, "size_px": [8, 1]}
    recording = imported({**BASE, "name": "taxels", "streams": {"events": taxels}}, tmp_path)
    check_rows(recording, [(0, 4, 0, 1), (4, 2, 0, 1), (4, 3, 0, 1), (9, 1, 0, 1)])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("time,x,x,p\n1,2,3,1\n", "has the column x twice"),
        # R names its rows without a heading; a decimal comma makes two cells of one
        ("time,x,y,p\n1,1,2,3,1\n2,1,2,3,1\n", "5 cells in row 2 below a heading of 4 columns"),
        ("time,x,y,p\n\n1,5,2,3,1\n", "5 cells in row 2 below a heading of 4 columns"),
        # the time 1,5 in a later row, also where every row ends with a separator
        ("time,x,y,p\n1,2,3,1\n1,5,2,3,1\n", "5 cells in row 3 below a heading of 4 columns"),
        ("time,x,y,p\n1,2,3,1,\n1,5,2,3,1\n", "5 cells in row 3 below a heading of 4 columns"),
        ("time x y p\n1 2 3 1\n\n1 5 2 3 1\n", "5 cells in row 4 below a heading of 4 columns"),
        ("time,x,y,p\r1,2,3,1\r", "is not CSV"),
        ("time,x,y,p\n1,2,3,1\n1,2\n", "no number in column y: row 3"),
        ("time,x,y,p\n1,2.5,3,1\n", "x = 2.5 in row 1"),
        ("time,x,y,p\n1,2,-3,1\n", "row is -3"),
        ("time,x,y,p\n-1,2,3,1\n", "time is -1"),
        ("", "has no column time"),
        ("time,x,y,p\n", "contains no event: its length is unknown"),
    ],
)
def test_a_table_that_cannot_be_right_is_refused(text: str, message: str, tmp_path: Path) -> None:
    (folder_of(tmp_path) / "events.csv").write_text(text)
    columns = {"t": "time", "x": "x", "y": "y", "p": "p"}
    made = {**BASE, "streams": {"events": {**EVENTS, "columns": columns}}}
    refused(made, tmp_path, f"events.csv: .*{message}")


def test_arrays_that_cannot_be_right_are_refused(tmp_path: Path) -> None:
    folder = folder_of(tmp_path)
    made = adapter(trials={"files": "{who}/events.np{kind}", "id": "{who}"})
    made["streams"] = {
        "events": {**EVENTS, "format": "numpy", "columns": {"t": 0, "x": 1, "y": 2, "p": 3}}
    }
    for wrong, message in (
        (np.zeros(3), r"array of shape \(3,\); a table has rows and columns"),
        (np.zeros((2, 3)), "has no column 3; there are 0, 1, 2"),
        (np.full((2, 4), np.nan), "no time in us: row 1 is nan"),
        (np.array([[1.0, 2, 3, np.nan]]), "p = nan in row 1"),
        (np.array([[1, 2, 3, 1]], object), "holds Python objects"),
    ):
        np.save(folder / "events.npy", wrong)
        refused(made, tmp_path, f"events.npy: .*{message}")
    (folder / "events.npy").unlink()
    columns = {str(k): np.arange(200) % 5 for k in range(4)}
    np.savez_compressed(folder / "events.npz", **{**columns, "3": np.arange(2)})
    refused(made, tmp_path, "columns of different lengths")
    np.savez_compressed(folder / "events.npz", **columns)
    whole = (folder / "events.npz").read_bytes()
    with zipfile.ZipFile(folder / "events.npz") as file:
        ends = [item.header_offset for item in file.infolist()][1:]
    for at in ends:  # bytes of what is packed, behind which the next one begins
        damaged = bytearray(whole)
        damaged[at - 30 : at - 20] = b"\xff" * 10
        (folder / "events.npz").write_bytes(damaged)
        refused(made, tmp_path, "events.npz: streams.events: is a damaged .npz file")
    (folder / "events.npz").write_bytes(_marked(whole, flag=1))
    refused(made, tmp_path, "events.npz: streams.events: is a damaged .npz file .*encrypted")
    (folder / "events.npz").write_bytes(whole)
    assert len(imported(made, tmp_path).events()) == 200


SPANS: dict[str, Any] = {
    "file": "marks.csv", "match": {"trial": "{who}"}, "start": "a", "end": "b", "class": "what",
    "unit": "ms", "names": {"pause": "", "rub": "slide"},
}  # fmt: skip


def test_a_second_import_takes_the_labels_of_new_trials_from_the_table_of_all(
    tmp_path: Path,
) -> None:
    made = adapter(experiment="classes", labels={"spans": SPANS})
    for who in ("ann", "bob"):
        folder_of(tmp_path, who)
    rows = [
        "trial,a,b,what", "ann,0,100,rub", "ann,100,250,pause", "ann,250,500,tap", "cid,1,2,tap",
        "bob,10,20,pause",
    ]  # fmt: skip
    marks = tmp_path / "set" / "marks.csv"
    marks.write_text("\n".join(rows) + "\n")
    first = bring(made, tmp_path / "set", tmp_path / "store")
    given = first.recording("ann").record.imported.given
    assert [(s.start_ns, s.end_ns, s.name) for s in given.spans] == [
        (0, 100_000_000, "slide"), (250_000_000, 500_000_000, "tap")
    ]  # fmt: skip
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
    with pytest.raises(InputError, match="labels: differs from the adapter of campaign 'streams'"):
        bring(
            adapter(experiment="classes", labels={"spans": changed}),
            tmp_path / "set", tmp_path / "store",
        )  # fmt: skip


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
    onsets = {
        "file": "t.jsonl", "match": {"trial": "{id}"}, "incipient": "a", "gross": "b",
        "unit": "s", "clock": clock, "uncertainty_ms": 1,
    }  # fmt: skip
    frames = {
        **FRAMES["numpy"], "format": "numpy", "times": {"files": "{who}/t.npy", "unit": "s"},
        "clock": {"offset_ms": 7.5, "uncertainty_ms": 0.25},
    }  # fmt: skip
    np.save(folder / "t.npy", np.array([0.6, 0.7]))
    made = adapter(
        {"frames": frames}, labels={"onsets": onsets},
        motion={"start": 0.6, "end": "0.95", "unit": "s", "clock": clock},
    )  # fmt: skip
    recording = imported(made, tmp_path)
    given = recording.record.imported.given
    assert given.incipient_ns == 700_000_000 + moved_ns
    assert given.gross_ns == 900_000_000 + moved_ns
    assert given.uncertainty_ns == (1_000_000 if clock == "start" else 1_250_000)
    assert recording.motion_ns == (600_000_000 + moved_ns, 950_000_000 + moved_ns)


def test_a_zip_gives_what_its_folder_gives(tmp_path: Path) -> None:
    names = slides(tmp_path / "set")
    for name in names:
        write_frames(tmp_path / "set" / "rec" / name, "video", some_frames(4))
    frames = {**SLIDES["streams"]["frames"], "files": "rec/{folder}/film.mkv", "format": "video"}
    made = {**SLIDES, "streams": {**SLIDES["streams"], "frames": frames}}
    one = bring(made, tmp_path / "set", tmp_path / "store")
    two = bring(made, zipped(tmp_path / "set"), tmp_path / "again")
    for name in names:
        a, b = one.recording(name), two.recording(name)
        assert a.record == b.record
        np.testing.assert_array_equal(list(a.frames()), some_frames(4))
        np.testing.assert_array_equal(list(b.frames()), list(a.frames()))
        with a.open() as first, b.open() as second:
            for column in ("events/t", "events/x", "poses/xyz", "frames/t"):
                np.testing.assert_array_equal(first.column(column), second.column(column))
            np.testing.assert_array_equal(
                first.wrenches("force").force_n, second.wrenches("force").force_n
            )


def _marked(data: bytes, *, flag: int) -> bytes:
    """Set a flag of every file in a zip."""
    made = bytearray(data)
    for signature, at in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        place = -1
        while (place := made.find(signature, place + 1)) >= 0:
            made[place + at] |= flag
    return bytes(made)


def _zip_of_one(tmp_path: Path) -> Path:
    folder = folder_of(tmp_path)
    rows = "".join(f"{t},{t % 8},{t % 6},1\n" for t in range(5000))
    (folder / "events.csv").write_text(rows)
    return zipped(tmp_path / "set")


def test_an_encrypted_zip_is_refused(tmp_path: Path) -> None:
    path = _zip_of_one(tmp_path)
    path.write_bytes(_marked(path.read_bytes(), flag=1))
    with pytest.raises(InputError, match=r"set.zip/ann/events.csv: cannot be .*encrypted"):
        bring(BASE, path, tmp_path / "store")
    assert not list((tmp_path / "store").glob("campaigns/*"))


def test_a_damaged_zip_is_refused(tmp_path: Path) -> None:
    path = _zip_of_one(tmp_path)
    whole = path.read_bytes()
    for length in (0, 1, 100, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:length])
        with pytest.raises(InputError, match=r"set\.zip: is no zip"):
            bring(BASE, path, tmp_path / "store")
    for at in range(80, len(whole) - 200, 997):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 0xFF]) + whole[at + 1 :])
        with pytest.raises(InputError, match=r"set.zip/ann/events.csv: cannot be unpacked"):
            bring(BASE, path, tmp_path / "store")
    assert not list((tmp_path / "store").glob("campaigns/*"))


def test_a_zip_that_unpacks_to_more_than_the_limit_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = _zip_of_one(tmp_path)
    whole = path.read_bytes()
    size = (tmp_path / "set" / "ann" / "events.csv").stat().st_size
    monkeypatch.setattr(data_folder, "MOST_BYTES", size - 1)
    with pytest.raises(InputError, match=r"events\.csv: holds more than .* MiB; unpack the zip"):
        bring(BASE, path, tmp_path / "store")
    # a zip that states a smaller size than it unpacks to
    assert whole.count(size.to_bytes(4, "little")) == 2
    path.write_bytes(whole.replace(size.to_bytes(4, "little"), (1000).to_bytes(4, "little")))
    with pytest.raises(InputError, match=r"events\.csv: cannot be unpacked"):
        bring(BASE, path, tmp_path / "store")
    assert not list((tmp_path / "store").glob("campaigns/*"))
    monkeypatch.setattr(data_folder, "MOST_BYTES", size)
    path.write_bytes(whole)
    assert len(bring(BASE, path, tmp_path / "store").recording("ann").events()) == 5000


def test_an_archive_of_arrays_beyond_the_limit_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = folder_of(tmp_path)
    np.savez_compressed(folder / "events.npz", t=np.zeros(200_000), x=np.zeros(200_000))
    monkeypatch.setattr(tables, "MOST_BYTES", 3 << 20)
    made = adapter(trials={"files": "{who}/events.npz", "id": "{who}"})
    columns = {"t": "t", "x": "x"}
    made["streams"] = {
        "events": {**EVENTS, "format": "numpy", "columns": columns, "size_px": [8, 1]}
    }
    refused(made, tmp_path, "events.npz: streams.events: holds more than 3 MiB")
    monkeypatch.setattr(tables, "MOST_BYTES", 4 << 20)
    assert len(imported(made, tmp_path).events()) == 200_000
