"""Prophesee's formats in the example package; tests/plugins/formats has the words' meaning."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import faery
import numpy as np
import pytest
from sliplab_prophesee.evt import (
    ADDR_X,
    ADDR_Y,
    EXT_TRIGGER,
    TIME_HIGH,
    TIME_LOW,
    Decoder,
    Evt3Encoder,
    FormatFault,
    Header,
)

from sliplab.storage.streams import EventChunk

SIZE = 640, 480
ON = 1 << 11
BASE_X, VECT_12, VECT_8 = 0x3, 0x4, 0x5


def words(*typed: tuple[int, int]) -> bytes:
    """EVT 3.0 words of (type, payload)."""
    return np.array([kind << 12 | value for kind, value in typed], "<u2").tobytes()


def rows(decoder: Decoder, *parts: bytes) -> list[tuple[int, int, int, int]]:
    """Events as (t, x, y, p)."""
    chunks = [decoder.decode(part).events for part in parts]
    return [
        tuple(int(value) for value in row)  # type: ignore[misc]
        for chunk in chunks
        for row in zip(chunk.t_us, chunk.x, chunk.y, chunk.p, strict=True)
    ]


STREAM = words(
    *((ADDR_Y, 9), (ADDR_X, 1), (TIME_HIGH, 2), (ADDR_Y, 100), (ADDR_X, 5), (TIME_LOW, 7)),
    *((ADDR_X, ON | 6), (BASE_X, ON | 20), (VECT_12, 0b1000_0000_0001), (VECT_12, 0b10)),
    *((ADDR_X, 700), (VECT_8, 0b1000_0000), (TIME_HIGH, 3), (ADDR_Y, 101), (VECT_8, 0b1)),
)
"""What comes before any time, and what lies outside of the camera, is dropped."""
EVENTS = [(8192, 5, 100, 0), *((8199, x, 100, 1) for x in (6, 20, 31, 33, 51)), (12288, 52, 101, 1)]


@pytest.mark.parametrize("size", [1, 2, 3, 5, 7])
def test_a_stream_may_be_cut_anywhere(size: int) -> None:
    parts = [STREAM[at : at + size] for at in range(0, len(STREAM), size)]
    assert rows(Decoder(Header(3, SIZE)), *parts) == EVENTS


def test_triggers_have_an_input_an_edge_and_a_time() -> None:
    found = Decoder(Header(3, SIZE)).decode(
        words((TIME_HIGH, 1), (TIME_LOW, 5), (EXT_TRIGGER, 1), (TIME_LOW, 9), (EXT_TRIGGER, 6 << 8))
    )
    assert found.trigger_us.tolist() == [4101, 4105]
    assert found.trigger_id.tolist() == [0, 6]
    assert found.trigger_up.tolist() == [True, False]
    cd = [1 << 28 | 3 << 22 | 40 << 11 | 50, TIME_HIGH << 28 | 11, 10 << 28 | 2 << 22 | 4 << 8 | 1]
    data = np.array([TIME_HIGH << 28 | 10, *cd], "<u4").tobytes()
    two = Decoder(Header(2, SIZE)).decode(data)
    assert [two.events.t_us[0], two.events.x[0], two.events.y[0]] == [643, 40, 50]
    assert len(two.events) == 1
    assert (two.trigger_us.tolist(), two.trigger_id.tolist()) == ([706], [4])
    assert two.trigger_up.tolist() == [True]


def test_a_clock_that_falls_back_is_no_new_turn() -> None:
    decoder = Decoder(Header(3, SIZE))
    decoder.decode(words((TIME_HIGH, 1000)))
    with pytest.raises(FormatFault, match="its clock fell back"):
        decoder.decode(words((TIME_HIGH, 500)))


# -- against another library ---------------------------------------------------------------


def by_faery(path: Path) -> list[tuple[int, int, int, int]]:
    whole = np.concatenate(list(faery.events_stream_from_file(path, file_type="evt")))
    columns = (whole[name].astype(int).tolist() for name in ("t", "x", "y", "on"))
    return list(zip(*columns, strict=True))


def random_events(rng: np.random.Generator, count: int, first_us: int) -> EventChunk:
    """Events in bursts, with pauses of more than the low part of the time between them."""
    steps = rng.choice([0, 0, 0, 1, 5, 300, 20_000], count)
    return EventChunk(
        rng.integers(0, SIZE[0], count).astype(np.uint16),
        rng.integers(0, SIZE[1], count).astype(np.uint16),
        rng.integers(0, 2, count).astype(np.uint8),
        first_us + np.cumsum(steps).astype(np.int64),
    )


def test_what_is_encoded_is_read_by_another_library(tmp_path: Path) -> None:
    events = random_events(np.random.default_rng(7), 4000, 1_000_000)
    kept = events.t_us < 1 << 24
    events = events[kept]
    data = Evt3Encoder().encode(events, np.empty(0, np.int64))
    (path := tmp_path / "a.raw").write_bytes(Header(3, SIZE, "1").text() + data)
    columns = (getattr(events, name).tolist() for name in ("t_us", "x", "y", "p"))
    assert by_faery(path) == list(zip(*columns, strict=True))


def test_what_is_encoded_is_decoded_in_any_parts_and_over_turns_of_the_clock() -> None:
    rng = np.random.default_rng(8)
    encoder, decoder = Evt3Encoder(), Decoder(Header(3, SIZE))
    first_us, turns, sent, came = 12 * 3_600_000_000, [], [], []
    for _ in range(20):
        events = random_events(rng, 700, first_us)
        edges = np.sort(rng.integers(events.t_us[0], events.t_us[-1] + 1, 30))
        first_us = int(events.t_us[-1])
        found = decoder.decode(encoder.encode(events, edges, trigger=2))
        assert np.all(found.trigger_id == 2)
        turns.append(found.trigger_us - edges)
        sent.append(events)
        came.append(found.events)
    whole, back = EventChunk.concatenate(sent), EventChunk.joined(came)
    for name in ("x", "y", "p"):
        assert np.array_equal(getattr(whole, name), getattr(back, name))
    # 24 bits of 12 hours are known; the rest counts from the beginning
    (off,) = set((whole.t_us - back.t_us).tolist())
    assert off % (1 << 24) == 0
    assert set(np.concatenate(turns).tolist()) == {-off}
    assert np.ptp(whole.t_us) > 2 * (1 << 24)


# -- headers -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "evt", "size"),
    [
        (b"% evt 3.0\n% geometry 1280x720\n", 3, (1280, 720)),
        (b"% camera_integrator_name Prophesee\n% evt 2.0\n% geometry 640x480\n", 2, (640, 480)),
        (b"% format EVT3;height=720;width=1280\n% serial_number 000512\n", 3, (1280, 720)),
        (b"% format EVT2;width=320;height=320\n", 2, (320, 320)),
        (Header(3, SIZE, "7").text(), 3, SIZE),
    ],
)
def test_headers_of_both_styles(text: bytes, evt: int, size: tuple[int, int]) -> None:
    found = Header.parse(text)
    assert (found.evt, found.size) == (evt, size)
    assert found.serial == {b"000512": "000512", b"7\n": "7"}.get(text[-7:-1].strip(), found.serial)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (b"% evt 2.1\n% geometry 640x480\n", "names no format of EVT 2.0 and 3.0"),
        (b"% format EVT21;height=1;width=1\n", "EVT21"),
        (b"% Date 2024-01-01\n", "names no format"),
        (b"% evt 3.0\n", "neither `geometry WxH` nor a size"),
    ],
)
def test_other_headers_are_refused(text: bytes, said: str) -> None:
    with pytest.raises(FormatFault, match=said):
        Header.parse(text)


def test_no_words_are_nothing() -> None:
    none: Any = np.empty(0, np.int64)
    assert Evt3Encoder().encode(EventChunk.empty(), none) == b""
    assert len(Decoder(Header(3, SIZE)).decode(b"").events) == 0
    assert len(Decoder(Header(2, SIZE)).decode(b"\x00\x00").events) == 0
