"""Events that adapters read: of known formats, tables and arrays, compared with what was put in."""

from __future__ import annotations

import csv
import io
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sliplab.plugins.adapters.streams import read_counts
from sliplab.protocols.adapter_parts import EventFiles
from sliplab.protocols.errors import InputError
from sliplab.storage.trials.recording import Recording
from tests.plugins.adapters.adapter_streams import (
    BASE,
    EVENTS,
    adapter,
    folder_of,
    imported,
    marked,
    refused,
    zipped,
)
from tests.plugins.adapters.adapters import bring
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


@pytest.mark.parametrize("name", KNOWN)
def test_events_of_a_known_format_are_those_of_the_file(name: str, tmp_path: Path) -> None:
    form, file, write, size = KNOWN[name]
    if form in LIBRARIES:
        pytest.importorskip(LIBRARIES[form])
    folder = tmp_path / "set" / "s7"
    folder.mkdir(parents=True)
    write(folder / file)
    made = {**BASE, "streams": {"events": {"format": form}}}
    made["trials"] = {"files": f"s{{number:number}}/{file}", "id": "trial-{number}"}
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
        span_us = int(whole.t_us[0]), int(whole.t_us[-1]) + 1
        assert record.imported.span_ns == (span_us[0] * 1000, span_us[1] * 1000)
        assert record.imported.fields == {"number": "7"}
        with recording.open() as reader:
            pulses = reader.pulses("event_pulses")
        assert pulses.tolist() == (whole.t_us[::100] * 1000).tolist() * (form == "aedat4")


def test_frames_in_the_file_of_the_events_come_with_them(tmp_path: Path) -> None:
    (tmp_path / "set").mkdir()
    write_aedat4(tmp_path / "set" / "a.aedat4")
    made = {**BASE, "trials": {"files": "{who}.aedat4"}}
    made["streams"] = {"events": {"format": "aedat4"}}
    recording = bring(made, tmp_path / "set", tmp_path / "store").recording("a")
    assert recording.record.counts.frames == 3
    assert recording.frame_px[:2] == (8, 6)
    assert [int(recording.frame(k).mean()) for k in range(3)] == [0, 10, 20]
    assert "clock of frames" in recording.record.imported.unknown


@pytest.mark.usefixtures("small")
def test_the_labs_pickles_are_one_trial_of_two_files(tmp_path: Path) -> None:
    (tmp_path / "set").mkdir()
    lab_pickles(tmp_path / "set", "d3_s0.5", SMALL[::-1], by_columns=True)
    made = {**BASE, "trials": {"files": "{what}_events_on.pickle", "id": "{what}"}}
    made["streams"] = {"events": {"format": "lab-pickles", "files": "{what}_events_*.pickle"}}
    there = [(0, 0, 0, 125), (3, 5, 0, 11_250), (3, 5, 1, 10_000), (3, 5, 1, 12_500)]
    for path in (tmp_path / "set", zipped(tmp_path / "set")):
        events = bring(made, path, tmp_path / f"store{path.suffix}").recording("d3_s0.5").events()
        found = sorted(zip(*(column.tolist() for column in vars(events).values()), strict=True))
        assert found == [*there, (7, 5, 1, 11_000)]
    (tmp_path / "set" / "d3_s0.5_events_off.pickle").write_bytes(b"\x80\x04.")
    for path in (tmp_path / "set", zipped(tmp_path / "set")):
        with pytest.raises(InputError, match=f"{path}/d3_s0.5_events_off.pickle: "):
            bring({**made, "name": "damaged"}, path, tmp_path / "store")


ROWS = [(0, 7, 5, 1), (3, 0, 0, -1), (3, 1, 4, 0), (999_999, 2, 3, 1)]


def _text(separator: str, heading: Any, end: str = "\n", mark: str = "", quoted: int = 0) -> bytes:
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
HEADED = {"headed": (HEADING, NAMED), "by index": (HEADING, BY_INDEX), "bare": (None, BY_INDEX)}
SPACED = b"".join(b"  %4d %8d   %2d %2d\n" % (p, t, x, y) for t, x, y, p in ROWS)
OWN, OTHER = "pol, -1 or 1", "pol; -1 or 1"
TEXTS: dict[str, tuple[bytes, dict[str, Any]]] = {
    **{
        f"{separator!r} {how}": (_text(separator, heading), columns)
        for separator in ",;\t "
        for how, (heading, columns) in HEADED.items()
    },
    "Windows' ends and a mark": (_text(",", HEADING, end="\r\n", mark="\ufeff"), NAMED),
    "a mark and no heading": (_text(",", None, mark="\ufeff"), BY_INDEX),
    "a separator in a name": (_text(",", f"{OWN}|time|col|row"), {**NAMED, "p": OWN}),
    "another": (_text(",", f"{OTHER}|time|col|row", quoted=1), {**NAMED, "p": OTHER}),
    "spaces in rows": (_text(",", HEADING).replace(b",", b" , "), NAMED),
    "many spaces": (SPACED, BY_INDEX),
    "no end": (_text(",", None).rstrip(), BY_INDEX),
}


def check_rows(recording: Recording, rows: list[tuple[int, int, int, int]]) -> None:
    """Check that events are rows of time, column, row and polarity."""
    events = recording.events()
    columns = (events.t_us, events.x, events.y, events.p)
    found = list(zip(*(column.tolist() for column in columns), strict=True))
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


IN_ORDER = {"t": 0, "x": 1, "y": 2, "p": 3}
ARRAYS: dict[str, tuple[Callable[[Path], None], dict[str, Any]]] = {
    "structured": (lambda path: np.save(path, _structured()), NAMED),
    "whole numbers": (lambda path: np.save(path, np.array(ROWS, np.int32)), IN_ORDER),
    "columns first": (lambda path: np.save(path, np.array(ROWS, float, order="F")), IN_ORDER),
    "an archive": (lambda path: np.savez(path, **_columns()), NAMED),
    "a packed archive": (lambda path: np.savez_compressed(path, **_columns()), NAMED),
}


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


@pytest.mark.parametrize("times", ["0 10 20", "0.0 10.0 20.5"])
def test_events_at_whole_seconds_fail_a_gate(tmp_path: Path, times: str) -> None:
    """They are rather microseconds whose unit was stated wrongly."""
    folder = folder_of(tmp_path)
    (folder / "events.csv").write_text("".join(f"{t},1,2,1\n" for t in times.split()))
    recording = imported({**BASE, "streams": {"events": {**EVENTS, "unit": "s"}}}, tmp_path)
    assert recording.record.quality.passed == ("." in times)


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
        ("time,x,y,p\r1,2,3,1\r", "has lines that end in CR alone"),
        ("time,x,y,p\n1,2,3,1\n1,2\n", "no number in column y: row 3"),
        ("time,x,y,p\n1,2.5,3,1\n", "events: 1 .*outside of the .* gives its camera; 0 can"),
        ("time,x,y,p\n1,2,-3,1\n", "events: 1 .*outside of the .* gives its camera; 0 can"),
        ("time,x,y,p\n1,2,3,1\n2,2,3,2\n", "polarities from 1 to 2, all above 0; `positive` says"),
        ("time,x,y,p\n1,2,3,-1\n2,2,3,0\n", "polarities from -1 to 0, none above 0; `positive`"),
        ("time,x,y,p\n-1,2,3,1\n", "events: 1 events with a negative time; 0 can"),
        ("", "is empty; its first line names the columns"),
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
    made["streams"] = {"events": {**EVENTS, "format": "numpy", "columns": IN_ORDER}}
    for wrong, message in (
        (np.zeros(3), r"array of shape \(3,\); a table has rows and columns"),
        (np.zeros((2, 3)), "has no column 3; there are 0, 1, 2"),
        (np.full((2, 4), np.nan), "events: 2 .*outside of the .* gives its camera; 0 can"),
        (np.array([[1.0, 2, 3, np.nan]]), "events: 1 events with an unknown polarity; 0 can"),
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
    (folder / "events.npz").write_bytes(marked(whole, flag=1))
    refused(made, tmp_path, "events.npz: streams.events: is a damaged .npz file .*encrypted")
    (folder / "events.npz").write_bytes(whole)
    assert len(imported(made, tmp_path).events()) == 200


def test_counts_of_16_bits_are_counts() -> None:
    part = EventFiles.model_validate({"format": "counts", "axes": ["taxel", "step"], "step_ms": 1})
    counts = np.array([[0, 3, 60_000], [1, 0, 0]])
    found = list(read_counts(counts.astype(np.float16), part).events())  # a warning is an error
    assert sum(map(len, found)) == int(counts.astype(np.float16).astype(np.float64).sum())
