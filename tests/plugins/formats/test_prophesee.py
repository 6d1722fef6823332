"""Prophesee's files: words as the maker lays them out, and the same events as faery reads."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import faery
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sliplab.plugins.formats import prophesee
from sliplab.plugins.formats.evt import LAST_TURN_US, ROOM
from sliplab.plugins.formats.prophesee import read_header, read_prophesee, salvage_prophesee
from sliplab.storage.formats.foreign import Damage, ForeignTrial, FormatError, left_out_of
from sliplab.storage.streams import EventChunk
from tests.protocols.planning import rows
from tests.storage.formats.files import taken

Row = tuple[int, int, int, int]
ON = 1 << 11
ADDR_Y, ADDR_X, BASE_X, VECT_12, VECT_8, LOW = 0x0, 0x2, 0x3, 0x4, 0x5, 0x6
CONTINUED_4, HIGH, TRIGGER, OTHERS, CONTINUED_12 = 0x7, 0x8, 0xA, 0xE, 0xF
HEADS = {
    "evt2": b"% evt 2.0\n% geometry 640x480\n% end\n",
    "evt21": b"% evt 2.1\n% format EVT21;height=480;width=640\n% end\n",
    "evt3": b"% evt 3.0\n% geometry 640x480\n% end\n",
    "dat": b"% Version 2\n% Width 640\n% Height 480\n\x0c\x08",
}
OTHER_LIBRARY = settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


def evt3(*typed: tuple[int, int]) -> bytes:
    """Words of (type, content)."""
    return np.array([kind << 12 | value for kind, value in typed], "<u2").tobytes()


def cd(p: int, low: int, x: int, y: int) -> int:
    """An event of EVT 2.0."""
    return p << 28 | low << 22 | x << 11 | y


def evt2(*words: int) -> bytes:
    return np.array(words, "<u4").tobytes()


def high(value: int) -> int:
    return HIGH << 28 | value


def evt21(*words: tuple[int, int]) -> bytes:
    """Words of (a word of EVT 2.0, valid pixels)."""
    return np.array([word << 32 | valid for word, valid in words], "<u8").tobytes()


def dat(*rows: Row) -> bytes:
    """Words of (time, column, row, polarity), the time modulo its 32 bits."""
    words = [t % (1 << 32) | x << 32 | y << 46 | p << 60 for t, x, y, p in rows]
    return np.array(words, "<u8").tobytes()


TYPES = {"Y": ADDR_Y, "X": ADDR_X, "B": BASE_X, "V": VECT_12, "v": VECT_8, "L": LOW, "H": HIGH}
TYPES |= {"c": CONTINUED_4, "T": TRIGGER, "O": OTHERS, "C": CONTINUED_12}


def encoded(form: str, text: str) -> bytes:
    """Words of a form, as a text.

    Each is the letter of its type or `#` and its type in hexadecimal, and its content after it; a
    plus sign is the bit of the polarity. Events of EVT 2 are polarity:low:column:row, those of
    DAT time:column:row:polarity; an asterisk stands before the valid pixels of EVT 2.1.
    """
    made: list[Any] = []
    for word in text.split():
        word, _, valid = word.partition("*")
        if ":" in word:
            p, low, x, y = numbers = [int(number, 0) for number in word.split(":")]
            made.append(tuple(numbers) if form == "dat" else cd(p, low, x, y))
        else:
            kind, rest = TYPES.get(word[0]), word[1:]
            if kind is None:
                kind, rest = int(word[1], 16), word[2:]
            value = int(rest.rstrip("+"), 0)
            made.append(
                (kind, value | ON * ("+" in rest)) if form == "evt3" else kind << 28 | value
            )
        if form == "evt21":
            made[-1] = made[-1], int(valid or "0", 0)
    return {"evt2": evt2, "evt21": evt21, "evt3": evt3, "dat": dat}[form](*made)


def write(folder: Path, form: str, data: bytes, head: bytes | None = None) -> Path:
    path = folder / ("a.dat" if form == "dat" else "a.raw")
    path.write_bytes((HEADS[form] if head is None else head) + data)
    return path


def listed(trial: ForeignTrial) -> list[Row]:
    """Events as (time, column, row, polarity), up to the damage."""
    found = []
    chunks = trial.events()
    while True:
        try:
            chunk = next(chunks, None)
        except Damage:
            break
        if chunk is None:
            break
        found.append(chunk)
    return listed_of(found)


def listed_of(chunks: list[EventChunk]) -> list[Row]:
    """Events as (time, column, row, polarity)."""
    whole = EventChunk.concatenate(chunks)
    assert [vars(whole)[name].dtype for name in ("x", "y", "p", "t_us")] == ["u2", "u2", "u1", "i8"]
    return list(zip(*(c.tolist() for c in (whole.t_us, whole.x, whole.y, whole.p)), strict=True))


def events(path: Path) -> list[Row]:
    return listed(read_prophesee(path, "a"))


def by_faery(path: Path, form: str) -> list[Row]:
    stream = faery.events_stream_from_file(
        path, dimensions_fallback=(2048, 2048), file_type="dat" if form == "dat" else "evt"
    )
    packets = [np.asarray(packet) for packet in stream]
    if not packets:
        return []
    whole = np.concatenate(packets)
    columns = (whole["t"], whole["x"], whole["y"], whole["on"].astype(int))
    return list(zip(*(column.tolist() for column in columns), strict=True))


# -- words ---------------------------------------------------------------------------------

# Dropped, as there is no time yet; the row counts, and the lower part of the time is 0; an event of
# a camera that follows another; the base was moved by 8; a single event leaves the base where it
# was; reserved types; an event of another source, not earlier than the one before.
STREAM3 = encoded(
    "evt3",
    """
    Y9 B70+ X1 v0xFF H2 X5 Y0x864 L7 X6+ V0b10 B20+ V0b100000000001 V0b10 v0xF80 X3 v1
    O0x14 C1 C2 c3 T1 #15 #95 #B5 #C5 #D5 H2 L4 X8 H3 Y101 v1
    """,
)
EVENTS3 = [
    (8192, 5, 9, 0),
    (8199, 6, 100, 1),
    (8199, 79, 100, 1),
    (8199, 20, 100, 1),
    (8199, 31, 100, 1),
    (8199, 33, 100, 1),
    (8199, 51, 100, 1),
    (8199, 3, 100, 0),
    (8199, 52, 100, 1),
    (8199, 8, 100, 0),
    (12288, 60, 101, 1),
]
STREAM2 = encoded(
    "evt2",
    "1:3:1:1 H10 1:3:40:50 0:2:639:479 O0 #F5 #50 T0x2400001 0:8:0:0 H10 H12 1:0:7:8",
)
EVENTS2 = [(643, 40, 50, 1), (643, 639, 479, 0), (648, 0, 0, 0), (768, 7, 8, 1)]
STREAM21 = encoded(
    "evt21",
    """
    1:3:1:1*1 H10 1:3:40:50*0x80000005 0:2:639:479*1 O0*0x14 T0x2400001 0:20:3:4 H12
    1:0:608:8*0x80000000
    """,
)
EVENTS21 = [
    (643, 40, 50, 1),
    (643, 42, 50, 1),
    (643, 71, 50, 1),
    (643, 639, 479, 0),
    (768, 639, 8, 1),
]
ROWS = [(5, 1, 2, 1), (5, 639, 479, 0), (3, 3, 4, 1), ((1 << 32) - 1, 5, 6, 0), (1 << 32, 7, 8, 1)]
EVENTS_DAT = [(5, 1, 2, 1), (5, 639, 479, 0), (5, 3, 4, 1), *ROWS[3:]]
STREAMS = {
    "evt2": (STREAM2, EVENTS2),
    "evt21": (STREAM21, EVENTS21),
    "evt3": (STREAM3, EVENTS3),
    "dat": (dat(*ROWS), EVENTS_DAT),
}


@pytest.mark.parametrize("form", STREAMS)
def test_words_mean_what_the_maker_says(tmp_path: Path, form: str) -> None:
    data, expected = STREAMS[form]
    assert events(write(tmp_path, form, data)) == expected


def test_halves_of_evt21_may_be_swapped(tmp_path: Path) -> None:
    head = b"% format EVT21;endianness=legacy;height=480;width=640\n% end\n"
    data = np.frombuffer(STREAM21, "<u4").reshape(-1, 2)[:, ::-1].tobytes()
    assert events(write(tmp_path, "evt21", data, head)) == EVENTS21


def test_the_first_version_of_dat(tmp_path: Path) -> None:
    head = b"% Version 1\n% Width 304\n% Height 240\n\x0c\x08"
    words = [7 | 303 << 32 | 239 << 41 | 1 << 49, 9 | 5 << 32 | 6 << 41]
    path = write(tmp_path, "dat", np.array(words, "<u8").tobytes(), head)
    assert events(path) == [(7, 303, 239, 1), (9, 5, 6, 0)] == by_faery(path, "dat")


@pytest.mark.parametrize("form", STREAMS)
@pytest.mark.parametrize("block", [8, 16, 64])
def test_blocks_chunks_and_edges_may_end_anywhere(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, form: str, block: int
) -> None:
    data, expected = STREAMS[form]
    monkeypatch.setattr(prophesee, "_BLOCK", block)
    monkeypatch.setattr(prophesee, "_CHUNK", ROOM + 2)
    monkeypatch.setattr(prophesee, "_EDGES", 1)
    path = write(tmp_path, form, data * 3 if form == "dat" else data)
    found = read_prophesee(path, "a")
    chunks = list(found.events())
    assert all(len(chunk) <= ROOM + 2 for chunk in chunks)
    assert listed(found)[: len(expected)] == expected
    if form != "dat":
        assert found.triggers is not None
        assert len(found.triggers.t_us) == 1


# -- the clock -----------------------------------------------------------------------------


# form | words | times
TURNS = f"""
    evt3 | H4095 X1 H0 X2 | {4095 << 12} {1 << 24}
    evt3 | H4000 H1 X3 | {4097 << 12}
    evt3 | H3072 H0 H1024 X3 | {5120 << 12}
    evt3 | H4095 H0 H4095 H0 |
    evt2 | H0xFFFFFFF H0 0:1:2:3 | {(1 << 34) + 1}
    evt2 | H0xFFFFFF7 H5 0:1:2:3 | {(1 << 34) + 321}
    evt21 | H0xFFFFFFF H0 0:1:2:3*1 | {(1 << 34) + 1}
    dat | -5:1:1:1 3:1:1:1 -5:1:1:1 | {(1 << 32) - 5} {(1 << 32) + 3} {(2 << 32) - 5}
    dat | 40960:1:1:1 0:1:1:1 | 40960 40960
    dat | 40961:1:1:1 0:1:1:1 | 40961 0
    dat | 0x80000000:1:1:1 0:1:1:1 | {1 << 31} 0
"""
"""Words were lost or it was quiet in the second, as faery writes it; the import leaves out one of
the last but one; the last falls by no more than half."""


@pytest.mark.parametrize(("form", "words", "times"), rows(TURNS))
def test_the_time_goes_on_where_its_bits_begin_anew(
    tmp_path: Path, form: str, words: str, times: str
) -> None:
    path = write(tmp_path, form, encoded(form, words))
    assert [row[0] for row in listed(salvage_prophesee(path, "a"))] == [*map(int, times.split())]


# what is not used | form | words | times
UNUSED = """
    a low part | evt3 | H1 L799 X1 L811 L800 X2 L801 X3 V0 L700 L802 X4 | 4895 4896 4897 4898
    an empty vector | evt3 | H1 L9 V0 L5 X1 v1 | 4101 4101
    an edge | evt3 | H0 L9 T1 L5 X1 | 5
    a high part | evt3 | H6 H5 L4 X1 H6 X2 | 20484 24576
    an edge of EVT 2.0 | evt2 | H1 T0x2400001 0:5:1:1 0:6:1:1 | 69 70
    a high part of EVT 2.0 | evt2 | H8 H7 0:5:1:1 H8 0:6:1:1 | 453 518
    an edge of EVT 2.1 | evt21 | H1 T0x2400001 0:5:1:1*1 | 69
    an empty word of EVT 2.1 | evt21 | H1 0:9:1:1 0:5:1:1*1 | 69
"""


@pytest.mark.parametrize(("name", "form", "words", "times"), rows(UNUSED))
def test_a_time_that_no_event_used_changes_no_later_one(
    tmp_path: Path, name: str, form: str, words: str, times: str
) -> None:
    found = read_prophesee(write(tmp_path, form, encoded(form, words)), "a")
    assert [row[0] for row in listed(found)] == [*map(int, times.split())], name
    assert found.notes() == ()


# what steps back | form | words | times | what is said
STEPS_BACK = """
    by one | evt3 | H5 L3 X1 H4 L4000 X2 H5 L9 X3 | 20483 20483 20489 | 1 times by up to 99
    over the end | evt3 | H4095 H0 L3 X1 H4095 L4090 X2 H0 L9 X3 H1 X4 \
| 16777219 16777219 16777225 16781312 | 1 times by up to 9
    before the first time | evt3 | H0 X1 H4095 L4095 X2 | 0 0 | 1 times by up to 1
    of EVT 2.0 | evt2 | H9 0:1:2:3 H8 0:60:2:3 0:61:2:3 H9 0:1:2:3 H10 0:0:2:3 \
| 577 577 577 577 640 | 2 times by up to 5
    of EVT 2.1 | evt21 | H9 0:1:2:3*1 H8 0:60:2:3*3 | 577 577 577 | 1 times by up to 5
    of DAT | dat | 9:1:1:1 5:1:1:1 7:1:1:1 11:1:1:1 | 9 9 9 11 | 2 times by up to 4
""".replace(" times by", " times of events step back, by")


@pytest.mark.parametrize(("name", "form", "words", "times", "says"), rows(STEPS_BACK))
def test_an_event_that_steps_back_a_little_is_raised_and_counted(
    tmp_path: Path, name: str, form: str, words: str, times: str, says: str
) -> None:
    path = write(tmp_path, form, encoded(form, words))
    found = read_prophesee(path, "a")
    assert [row[0] for row in listed(found)] == [*map(int, times.split())], name
    (line,) = found.notes()
    assert line.startswith(f"{says} us: ")
    result, (recording,) = taken(tmp_path / "store", path, "raw")
    assert recording.record.imported is not None
    assert recording.record.imported.warnings[0] == line
    assert result["warnings"][0] == f"{path.name}: {line}"


@given(st.lists(st.tuples(st.sampled_from([HIGH, LOW, ADDR_X]), st.integers(0, 4095)), max_size=60))
@settings(OTHER_LIBRARY)
def test_every_event_has_the_time_of_the_words_before_it(
    tmp_path: Path, words: list[tuple[int, int]]
) -> None:
    """Computed as the maker's decoder does: turns, high part and low part side by side."""
    high_part, low, turns, times = 2000, 0, 0, []
    made = [(HIGH, high_part)]
    for kind, value in words:
        if kind == HIGH:
            value = (high_part + value % 40 - 10) % 4096  # steps ahead, and a little back
            turns += high_part >= 2048 + value
            low, high_part = low if high_part == value else 0, value
        elif kind == LOW:
            low = value
        else:
            value %= 640
            times.append(turns << 24 | high_part << 12 | low)
        made.append((kind, value))
    found = [row[0] for row in events(write(tmp_path, "evt3", evt3(*made)))]
    assert found == np.maximum.accumulate(times).tolist() if times else found == []


def _timed(form: str, times: Any, x: Any) -> bytes:
    """An event at each time, us, and column, in row 0."""
    pairs = list(zip(times.tolist(), x.tolist(), strict=True))
    if form == "evt2":
        return evt2(*(w for t, a in pairs for w in (high(t >> 6), cd(1, t & 63, a, 0))))
    if form == "evt21":
        words = (w for t, a in pairs for w in ((high(t >> 6), 0), (cd(1, t & 63, a, 0), 1)))
        return evt21(*words)
    if form == "dat":
        return dat(*((t, a, 0, 1) for t, a in pairs))
    each = ((HIGH, t >> 12, LOW, t & 0xFFF, ADDR_X, a) for t, a in pairs)
    return evt3(*(pair for w in each for pair in (w[:2], w[2:4], w[4:])))


@pytest.mark.parametrize("form", ["evt2", "evt21", "evt3", "dat"])
@pytest.mark.parametrize("fault", ["stale at the start", "stale at the end", "a pixel"])
def test_a_wrong_word_of_1000_costs_its_events_alone(tmp_path: Path, form: str, fault: str) -> None:
    right = 200_000 + np.arange(3000) * 100
    times, x = right, np.arange(3000) % 640
    dropped = {"events whose times run back": 20}
    if fault == "stale at the start":
        times, x = np.r_[right[:20] + 3_000_000, right], np.r_[x[:20], x]
    elif fault == "stale at the end":
        times, x = np.r_[right, right[:20] - 100_000], np.r_[x, x[:20]]
    else:
        x[7], right = 640, np.delete(right, 7)
        dropped = {"events outside of the sensor": 1}
    path = write(tmp_path, form, _timed(form, times, x))
    _, (found,) = taken(tmp_path / "store", path, "raw")
    np.testing.assert_array_equal(found.events().t_us, right)
    assert found.record.imported is not None
    assert found.record.imported.dropped == dropped


def test_a_vector_that_is_left_out_moves_the_base_on(tmp_path: Path) -> None:
    words = [(HIGH, 0), *[(ADDR_X, 1)] * 1000, (BASE_X, 634), (VECT_12, 0xFFF), (BASE_X, 630)]
    words += [(ADDR_Y, 480), (VECT_8, 3), (ADDR_Y, 7), (VECT_8, 2), *[(ADDR_X, 1)] * 2000]
    chunks = list(read_prophesee(write(tmp_path, "evt3", evt3(*words)), "a").events())
    assert sum(sum(left_out_of(chunk).values()) for chunk in chunks) == 14
    assert [row[1:3] for row in listed_of(chunks) if row[1] != 1] == [(639, 7)]


# what is wrong | form | words | index of the wrong one | reason
FAULTS = """
    the clock falls | evt3 | H19 X1 H8 X2 | 2 | HIGH falls from 19 to 8
    the clock falls by less than half | evt3 | H2047 X1 H0 | 2 | HIGH falls from 2047 to 0
    the clock of EVT 2.0 falls | evt2 | H19 0:1:2:3 H8 | 2 | HIGH falls from 19 to 8
    the clock of EVT 2.1 falls | evt21 | H19 0:1:2:3*1 H8 | 2 | HIGH falls from 19 to 8
    a column | evt3 | H0 Y479 X639 X640 | 3 \
| AT column 640, row 479, outside of the 640 x 480 pixels in its header
    a row | evt3 | H0 X1 Y480 X4 | 3 | AT column 4, row 480, outside
    a vector beyond the camera | evt3 | H0 B630 V0x3FF B630 V0xC00 | 4 \
| AT column 641, row 0, outside
    a vector in a row that is not there | evt3 | H0 Y480 V0 v1 | 3 | AT column 12, row 480, outside
    a pixel of EVT 2.0 | evt2 | H9 0:1:639:479 0:1:640:3 | 2 | AT column 640, row 3, outside
    a pixel of EVT 2.1 | evt21 | H9 0:1:608:3*0xFFFFFFFF 0:1:609:3*0x80000000 | 2 \
| AT column 640, row 3, outside
    a pixel of DAT | dat | 5:1:2:1 6:639:479:0 7:3:480:1 8:3:4:1 | 2 \
| AT column 3, row 480, outside
""".replace("HIGH", "the high part of the time").replace("AT", "an event at")


@pytest.mark.parametrize(("name", "form", "words", "index", "reason"), rows(FAULTS))
def test_salvage_ends_at_the_damaged_word(
    tmp_path: Path, name: str, form: str, words: str, index: str, reason: str
) -> None:
    data = encoded(form, words)
    path = write(tmp_path, form, data)
    header = read_header(path)
    at = header.begin + int(index) * np.dtype(header.encoding.dtype).itemsize
    whole = read_prophesee(path, "a")
    with pytest.raises(Damage, match=f"^is damaged at byte {at}: {reason}"):
        list(whole.events())
    saved = salvage_prophesee(path, "a")
    assert saved.lost is not None
    assert (saved.lost.at_byte, saved.lost.unread_bytes) == (at, path.stat().st_size - at)
    assert "\n" not in saved.lost.reason
    before = listed(whole)
    assert listed(saved) == before
    path.write_bytes(path.read_bytes()[:at])
    assert events(path) == before


def test_what_is_outside_without_an_event_is_no_damage(tmp_path: Path) -> None:
    data = evt3((HIGH, 0), (ADDR_Y, 480), (ADDR_Y, 479), (BASE_X, 700), (VECT_12, 0), (ADDR_X, 1))
    assert events(write(tmp_path, "evt3", data)) == [(0, 1, 479, 0)]


@pytest.mark.parametrize(
    ("form", "data", "most"),
    [
        ("evt3", evt3((HIGH, 0), (ADDR_Y, 2047), (BASE_X, 2040), (VECT_8, 0x80)), 2048),
        ("evt2", evt2(high(0), cd(0, 0, 2047, 2047)), 2048),
        ("dat", dat((0, 16383, 16383, 1)), 16384),
    ],
)
def test_without_a_size_a_pixel_may_be_anywhere_in_its_bits(
    tmp_path: Path, form: str, data: bytes, most: int
) -> None:
    head = {"evt3": b"% evt 3.0\n", "evt2": b"% evt 2.0\n", "dat": b"% Version 2\n\x0c\x08"}[form]
    trial = read_prophesee(write(tmp_path, form, data, head), "a")
    assert trial.event_px() is None
    ((_, x, y, _),) = listed(trial)
    assert (x, y) == (most - 1, most - 1)


def test_times_that_are_none_are_refused(tmp_path: Path) -> None:
    head = b"%% Version 2\n%% T0 %d\n\x0c\x08"
    path = write(tmp_path, "dat", dat((0, 1, 2, 1)), head % LAST_TURN_US)
    with pytest.raises(FormatError, match="counts times from"):
        read_prophesee(path, "a")
    turns = dat((0, 1, 2, 1), ((1 << 32) - 1, 1, 2, 1), (0, 1, 2, 1), ((1 << 32) - 1, 1, 2, 1))
    path = write(tmp_path, "dat", turns + dat((0, 1, 2, 1)), head % (LAST_TURN_US - 1))
    with pytest.raises(Damage, match="a time that is out of range"):
        list(read_prophesee(path, "a").events())
    assert len(listed(salvage_prophesee(path, "a"))) == 4
    head = b"%% evt 2.0\n%% t0 %d\n%% end\n" % (LAST_TURN_US - 1)
    path = write(tmp_path, "evt2", evt2(high(1 << 27), cd(0, 0, 1, 1), high(0), high(1)), head)
    with pytest.raises(Damage, match="a time that is out of range"):
        list(read_prophesee(path, "a").events())


# -- headers -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("head", "size", "t0_us"),
    [
        (b"% evt 3.0\n% geometry 640x480\n", (640, 480), 0),
        (b"% evt 3.0 \n% geometry 640x480 \n% t0 7\n", (640, 480), 7),
        (b"% format EVT3;height=480;width=640\r\n% end\r\n", (640, 480), 0),
        (b"% format EVT3;width=640;height=480;endianness=little\n% end\n", (640, 480), 0),
        (b"% Evt 3.0\n% Height 480\n% Width 640\n% end\n", (640, 480), 0),
        (b"% evt 3.0\n% geometry 640xno\n% T0 x\n", None, 0),
        (b"% evt 3.0\n% geometry 0x480\n", None, 0),
        (b"% evt 3.0\n% Width 640\n", None, 0),
        (b"% evt 3.0\n% geometry 640x" + b"9" * 5000 + b"\n", None, 0),
        ("% evt 3.0\n% integrator_name Société\n% end\n".encode(), None, 0),
    ],
)
def test_headers_of_all_styles(
    tmp_path: Path, head: bytes, size: tuple[int, int] | None, t0_us: int
) -> None:
    path = write(tmp_path, "evt3", evt3((HIGH, 1), (ADDR_X, 5)), head)
    found = read_header(path)
    assert (found.begin, found.size, found.t0_us) == (len(head), size, t0_us)
    assert events(path) == [(4096 + t0_us, 5, 0, 0)]


@pytest.mark.parametrize(
    ("end", "words"),
    [
        # `% end`, and words that could be a further line: `% %geometry 9x9\n`
        (b"% end\n", b"% geometry 9x9\n\x00"),
        (b"% end\n", b"% end\n"),
        # without it: a line that is none of text, or has no blank after the percent sign
        (b"", b"%`\x01\x20\n\x00"),
        (b"", b"% \x01\x20\n\x00"),
        (b"", b"% \xff\x2f\n\x00"),
    ],
)
def test_words_that_begin_as_a_line_are_no_header(tmp_path: Path, end: bytes, words: bytes) -> None:
    head = b"% evt 3.0\n% geometry 2047x2047\n" + end
    found = read_header(write(tmp_path, "evt3", words, head))
    assert found.begin == len(head)
    assert found.size == (2047, 2047)


@pytest.mark.parametrize(
    ("form", "head", "says"),
    [
        ("evt3", b"% evt 4.0\n% end\n", r"is of EVT 4\.0; read are"),
        ("evt3", b"% format EVT3;endianness=big\n% end\n", "is big-endian"),
        ("evt3", b"% date today\n", "gives no format"),
        ("evt3", b"text\n", "gives no format"),
        ("dat", b"% Version 3\n\x0c\x08", "is of DAT version 3"),
        ("dat", b"% Version 2\n\x0e\x08", "holds DAT events of type 14 with 8 bytes"),
        ("dat", b"% Version 2\n\x0c\x04", "holds DAT events of type 12 with 4 bytes"),
        ("dat", b"% Version 2\n% " + b"x" * (1 << 20) + b"\n", "has a line of more than"),
    ],
)
def test_other_headers_are_refused(tmp_path: Path, form: str, head: bytes, says: str) -> None:
    with pytest.raises(FormatError, match=says) as caught:
        read_prophesee(write(tmp_path, form, bytes(8), head), "a")
    assert not isinstance(caught.value, Damage)


@pytest.mark.parametrize(
    "head", [b"", b"%", b"% evt 3.0", b"% evt 3.0\n% geo", b"% Version 2\n\x0c"]
)
def test_a_header_that_is_cut_is_damage(tmp_path: Path, head: bytes) -> None:
    path = write(tmp_path, "evt3", b"", head)
    for read in (read_prophesee, salvage_prophesee):
        with pytest.raises(Damage, match="is cut short in its header"):
            read(path, "a")


# -- cuts ----------------------------------------------------------------------------------


@pytest.mark.parametrize("form", STREAMS)
def test_a_cut_at_any_byte_leaves_a_prefix(tmp_path: Path, form: str) -> None:
    data, expected = STREAMS[form]
    path = write(tmp_path, form, data)
    whole, header = path.read_bytes(), read_header(path)
    item = np.dtype(header.encoding.dtype).itemsize
    counts = []
    for at in range(header.begin, len(whole) + 1):
        path.write_bytes(whole[:at])
        saved = salvage_prophesee(path, "a")
        found = listed(saved)
        assert found == expected[: len(found)]
        counts.append(len(found))
        rest = (at - header.begin) % item
        if not rest:
            assert saved.lost is None
            assert events(path) == found
            continue
        assert saved.lost is not None
        assert (saved.lost.at_byte, saved.lost.unread_bytes) == (at - rest, rest)
        with pytest.raises(Damage, match=f"its last {rest} bytes, from byte {at - rest} on"):
            read_prophesee(path, "a")
    assert counts == sorted(counts)
    assert counts[-1] == len(expected)


# -- triggers ------------------------------------------------------------------------------

EDGES = {
    "evt2": "T1 H1 T0x800001 0:3:1:1 T0x1000601 T0x1400000",
    "evt21": "T1 H1 T0x800001 0:3:1:1*1 T0x1000601 T0x1400000",
    "evt3": "T1 H0 L66 T1 L67 X1 L68 T0x601 L69 T0",
}


@pytest.mark.parametrize("form", EDGES)
def test_edges_of_the_first_input_are_triggers(tmp_path: Path, form: str) -> None:
    path = write(tmp_path, form, encoded(form, EDGES[form]))
    trial = read_prophesee(path, "a")
    assert trial.triggers is not None
    assert trial.triggers.t_us.tolist() == [66, 69]
    assert trial.triggers.kind.tolist() == [1, 2]
    assert "triggers" not in trial.unknown
    assert trial.about["left_out"] == ["trigger input 6"]
    _, (recording,) = taken(tmp_path / "store", path, "raw")
    with recording.open() as reader:
        assert reader.pulses("event_pulses").tolist() == [66_000]


@pytest.mark.parametrize(
    ("form", "data"),
    [
        ("evt3", evt3((TRIGGER, 1), (HIGH, 0), (ADDR_X, 1))),  # at no time
        ("evt3", evt3((HIGH, 0), (ADDR_X, 1))),
        ("dat", dat((1, 2, 3, 1))),
    ],
)
def test_triggers_are_unknown_where_there_are_none(tmp_path: Path, form: str, data: bytes) -> None:
    trial = read_prophesee(write(tmp_path, form, data), "a")
    assert trial.triggers is None
    assert "triggers" in trial.unknown


def test_triggers_behind_the_damage_are_lost(tmp_path: Path) -> None:
    tail = evt2(cd(0, 6, 640, 1), TRIGGER << 28 | 7 << 22 | 1)
    path = write(tmp_path, "evt2", encoded("evt2", EDGES["evt2"]) + tail)
    with pytest.raises(Damage, match="outside of the 640 x 480"):
        read_prophesee(path, "a")
    saved = salvage_prophesee(path, "a")
    assert saved.triggers is not None
    assert saved.triggers.t_us.tolist() == [66, 69]


# -- other programs ------------------------------------------------------------------------

BY_EXPELLIARMUS = {
    "a.raw": b"% Date 1970-12-25 07:51:03 \n% evt 3.0 \n% firmware_version 0.0.0 \n"
    b"% integrator_name Prophesee \n% plugin_name hal_plugin_gen41_evk3 \n"
    b"% serial_number 00000307 \n% system_ID 48 \n"
    + evt3((ADDR_Y, 7), (HIGH, 1), (LOW, 904), (ADDR_X, ON | 5), (LOW, 905), (ADDR_X, ON | 6)),
    "a.dat": b"% This DAT file has been generated through expelliarmus \n"
    b"% Data file containing CD events \n% Version 2 \n\x00\x08"
    + dat((5000, 5, 7, 1), (5001, 6, 7, 1)),
}


@pytest.mark.parametrize("name", BY_EXPELLIARMUS)
def test_files_that_expelliarmus_writes(tmp_path: Path, name: str) -> None:
    (path := tmp_path / name).write_bytes(BY_EXPELLIARMUS[name])
    assert events(path) == [(5000, 5, 7, 1), (5001, 6, 7, 1)]


@pytest.mark.parametrize(("form", "version"), [("evt2", "evt2"), ("evt3", "evt3"), ("dat", "dat2")])
def test_files_that_faery_writes(tmp_path: Path, form: str, version: str) -> None:
    rng = np.random.default_rng(3)
    count = 20_000
    rows: Any = np.empty(count, faery.EVENTS_DTYPE)
    rows["t"] = 1_000_000 + np.cumsum(rng.integers(0, 5, count))
    rows["x"] = np.where(
        rng.random(count) < 0.5, np.arange(count) % 640, rng.integers(0, 640, count)
    )
    rows["y"], rows["on"] = rng.integers(0, 3, count), rng.random(count) < 0.5
    path = tmp_path / ("a.dat" if form == "dat" else "a.raw")
    faery.events_stream_from_array(rows, (640, 480)).to_file(
        path, version=version, file_type="dat" if form == "dat" else "evt"
    )
    found = events(path)
    assert found == by_faery(path, form)
    assert found == [tuple(row) for row in rows.tolist()]


@pytest.mark.parametrize("seed", range(3))
def test_what_is_out_of_the_ordinary_in_a_long_file(tmp_path: Path, seed: int) -> None:
    """Words that are decoded together, with a fall, a turn of the clock or an edge in some."""
    rng = np.random.default_rng(seed)
    count = 30_000
    t = (1 << 32) - 100_000 + np.cumsum(rng.integers(0, 9, count))
    t[rng.integers(0, count, 5)] -= 50
    x, y, p = rng.integers(0, 640, count), rng.integers(0, 480, count), rng.integers(0, 2, count)
    path = write(tmp_path, "dat", dat(*zip(*(c.tolist() for c in (t, x, y, p)), strict=True)))
    assert events(path) == by_faery(path, "dat")
    words, last = [], -1
    for time, column, row, on in zip(*(c.tolist() for c in (np.sort(t), x, y, p)), strict=True):
        if time >> 6 != last:
            last = time >> 6
            words.append(high(last % (1 << 28)))
        words.append(cd(on, time & 63, column, row))
    words[rng.integers(9_000)] = TRIGGER << 28 | 1
    words[20_000:20_000] = [high((1 << 28) - 1), high(0), cd(1, 5, 3, 4), cd(1, 4, 3, 4)]
    words[20_004:] = [word if word >> 28 != HIGH else high(7) for word in words[20_004:]]
    path = write(tmp_path, "evt2", evt2(*words))
    assert events(path) == by_faery(path, "evt2")


def test_a_pause_longer_than_the_clock_as_faery_writes_it(tmp_path: Path) -> None:
    """faery writes it so that its own reader does not see the clock begin anew."""
    rows: Any = np.zeros(2, faery.EVENTS_DTYPE)
    rows["t"] = 0, 40_000_000
    path = tmp_path / "a.raw"
    faery.events_stream_from_array(rows, (640, 480)).to_file(path, version="evt3", file_type="evt")
    assert [row[0] for row in events(path)] == [0, 40_000_000]


@st.composite
def words3(draw: st.DrawFn) -> bytes:
    """Any words but those at which faery deviates from the maker: see the tests above."""
    found = [(HIGH, 0), (BASE_X, 0)]
    now, vector, low = draw(st.integers(0, 4000)), 0, 0
    for kind in draw(st.lists(st.integers(0, 15), max_size=80)):
        value = draw(st.integers(0, 4095))
        if kind == HIGH:
            step = draw(st.sampled_from([0, 1, 1, 7, 4095 - now % 4096]))
            now, low = now + step, 0 if step else low
            value = now % 4096
        elif kind == LOW:
            value = low = max(low, value)
        elif kind == BASE_X:
            value, vector = value & (ON | 0x3FF), 0
        elif kind in (VECT_12, VECT_8):
            if vector > 40:
                continue
            vector += 1
        found.append((kind, value))
        if kind == ADDR_X:
            found.append((BASE_X, value & (ON | 0x3FF)))
            vector = 0
    return evt3(*found)


@st.composite
def words2(draw: st.DrawFn) -> bytes:
    """Any words, with high parts that do not fall, or begin anew."""
    now = draw(st.sampled_from([0, 5, (1 << 28) - 3]))
    found = [high(now)]
    for word in draw(st.lists(st.integers(0, (1 << 32) - 1), max_size=60)):
        if word >> 28 == HIGH:
            now += word % 4
            word = high(now % (1 << 28))
        found.append(word)
    return evt2(*found)


def words_dat() -> st.SearchStrategy[bytes]:
    """Any times, also such as fall by so little that they are raised, or begin anew."""
    near = st.integers(0, 20) | st.integers((1 << 32) - 20, (1 << 32) - 1) | st.integers(0, 40_000)
    row = st.tuples(near, st.integers(0, 2047), st.integers(0, 2047), st.integers(0, 15))
    return st.lists(row, max_size=60).map(lambda rows: dat(*rows))


@pytest.fixture
def small_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(prophesee, "_BLOCK", 24)
    monkeypatch.setattr(prophesee, "_CHUNK", ROOM + 8)


@pytest.mark.usefixtures("small_blocks")
@pytest.mark.parametrize(
    ("form", "head"),
    [("evt3", b"% evt 3.0\n"), ("evt2", b"% evt 2.0\n"), ("dat", b"% Version 2\n\x0c\x08")],
)
def test_the_same_events_as_faery_reads(tmp_path: Path, form: str, head: bytes) -> None:
    words = {"evt3": words3(), "evt2": words2(), "dat": words_dat()}[form]

    @OTHER_LIBRARY
    @given(words)
    def compare(data: bytes) -> None:
        path = write(tmp_path, form, data, head)
        assert events(path) == by_faery(path, form)

    compare()


@given(st.sampled_from(["evt2", "evt21", "evt3", "dat"]), st.binary(max_size=300))
@settings(OTHER_LIBRARY, max_examples=150)
def test_any_bytes_give_events_up_to_a_damage(tmp_path: Path, form: str, data: bytes) -> None:
    path = write(tmp_path, form, data)
    saved = salvage_prophesee(path, "a")
    found = listed(saved)
    if form != "dat":
        assert [row[0] for row in found] == sorted(row[0] for row in found)
    assert all(x < 640 and y < 480 and p < 2 for _, x, y, p in found)
    if saved.lost is not None:
        assert saved.lost.at_byte + saved.lost.unread_bytes == path.stat().st_size
        path.write_bytes(path.read_bytes()[: saved.lost.at_byte])
        assert events(path) == found
