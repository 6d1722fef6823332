"""The sync box's driver against a box on a pty: what it hands over, and how each fault ends."""

from __future__ import annotations

import contextlib
import os
import threading
import time
import tty
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import serial

from sliplab.plugins.devices.sync_box.driver import ReportTrain, SerialSyncBox
from sliplab.plugins.devices.sync_box.fake import FakeSyncBox
from sliplab.plugins.devices.sync_box.line import NAME, LineReader, seal, unseal
from sliplab.plugins.devices.sync_box.port import JOIN_S, TRIES, SyncBoxFault
from sliplab.plugins.devices.sync_box.settings import SyncBoxSettings
from sliplab.protocols.timing import Code
from sliplab.rigs.core.capabilities import RigError
from sliplab.rigs.core.pulse_code import code_bits
from tests.patching import put
from tests.rigs.waiting import fault_of

pytestmark = pytest.mark.realtime

SEED = 0xACE1
CODES: tuple[Code, ...] = ("lfsr", "irregular", "regular")
ANSWER_S, SILENCE_S = 0.3, 0.4
SLACK_S = 0.5
"""Allowance for a busy machine in addition to a timeout, s."""


@pytest.fixture
def wire() -> Iterator[FakeSyncBox]:
    with FakeSyncBox(exposure_us=77) as wire:
        yield wire


@pytest.fixture
def box(wire: FakeSyncBox) -> Iterator[SerialSyncBox]:
    box = SerialSyncBox(settings(wire))
    yield box
    box.close()


def settings(wire: FakeSyncBox) -> SyncBoxSettings:
    return SyncBoxSettings(port=wire.address, answer_s=ANSWER_S, boot_s=1.0, silence_s=SILENCE_S)


def gather(read: Callable[[], np.ndarray], done: Callable[[np.ndarray], bool]) -> np.ndarray:
    """Call `read` until it has returned enough, for at most 5 s."""
    found, end = [read()], time.monotonic() + 5.0
    while not done(np.concatenate(found)) and time.monotonic() < end:
        threading.Event().wait(0.01)
        found.append(read())
    return np.concatenate(found)


def pulses_of(box: SerialSyncBox, enough: int) -> np.ndarray:
    return gather(lambda: box.read_pulses().t_ns, lambda found: len(found) >= enough)


def running(box: SerialSyncBox, rate_hz: float, pulses: int) -> None:
    """Start a train, and wait for some pulses."""
    box.start(rate_hz, SEED)
    pulses_of(box, pulses)


@pytest.mark.quick(3)
@pytest.mark.parametrize("code", CODES)
@pytest.mark.parametrize("rate_hz", [200.0, 1000.0, 333.333])
def test_its_pulses_are_the_codes(box: SerialSyncBox, code: Code, rate_hz: float) -> None:
    """Reported tick by tick up to 200 Hz, above only pulses: the same to the reader."""
    box.start(rate_hz, SEED, code)
    pulses = pulses_of(box, 40)
    box.stop()
    pulses = np.concatenate([pulses, box.read_pulses().t_ns])
    ticks = np.rint(pulses * rate_hz / 1e9).astype(np.int64)
    assert np.array_equal(ticks, np.flatnonzero(code_bits(SEED, int(ticks[-1]) + 1, code)))
    assert np.array_equal(pulses, ticks * 1_000_000_000 // round(rate_hz * 1000) * 1000)
    assert not box.losses


def test_nothing_comes_after_the_stop(box: SerialSyncBox) -> None:
    running(box, 200.0, 5)
    box.stop()
    box.read_pulses()
    clock = box.read_clock().device_ns[0]
    assert len(box.read_pulses()) == 0
    assert box.read_clock().device_ns[0] > clock, "the clock goes on"
    box.stop()


def test_exposures_are_stamped(box: SerialSyncBox) -> None:
    box.start(200.0, SEED)
    exposures = gather(lambda: box.read_exposures().t_ns, lambda found: len(found) >= 20)
    assert np.array_equal(exposures, np.arange(len(exposures)) * 5_000_000 + 77_000)


def test_clock_reads_bracket_the_boxs_clock(wire: FakeSyncBox, box: SerialSyncBox) -> None:
    """The fake's clock is the host's own, so what it showed must lie between the two."""
    box.start(100.0, SEED)
    reads = [box.read_clock() for _ in range(50)]
    device = np.array([read.device_ns[0] for read in reads])
    before = np.array([read.before_ns[0] for read in reads])
    after = np.array([read.after_ns[0] for read in reads])
    # the box's origin on the host's clock lies in every bracket at once
    assert (before - device).max() <= (after - device).min() + 1000
    assert np.median(after - before) < 20e6


def test_before_the_first_start_the_clock_counts_from_power_on(box: SerialSyncBox) -> None:
    assert 0 < box.read_clock().device_ns[0] < 10e9


def test_the_clock_may_be_anybodys() -> None:
    """A scene can drive it: nothing is sent until its time has come."""
    now = [5_000_000_000]
    with FakeSyncBox(lambda: now[0]) as wire:
        box = SerialSyncBox(settings(wire))
        box.start(10.0, 1, "regular")
        assert len(box.read_pulses()) == 0
        now[0] += 1_700_000_000
        assert pulses_of(box, 2).tolist() == [0, 1_600_000_000]
        box.close()


# -- faults ------------------------------------------------------------------------------------


def test_a_reset_is_told_at_once_and_the_next_start_works(wire: FakeSyncBox, box: Any) -> None:
    running(box, 100.0, 3)
    wire.reset()
    assert "restarted" in fault_of(box.read_pulses, 0.2 + SLACK_S)
    with pytest.raises(SyncBoxFault, match="restarted"):
        box.read_clock()
    box.stop()
    box.start(100.0, SEED)
    assert pulses_of(box, 1)[0] == 0


def test_a_reset_whose_word_is_lost_is_silence(wire: FakeSyncBox, box: SerialSyncBox) -> None:
    box.start(100.0, SEED)
    wire.reset(announced=False)
    assert "no pulse reported" in fault_of(box.read_pulses, 0.16 + SILENCE_S + SLACK_S)


def test_a_clock_that_falls_back_is_a_reset(wire: FakeSyncBox, box: SerialSyncBox) -> None:
    threading.Event().wait(0.05)
    box.read_clock()
    wire.corrupt(1)
    wire.reset()
    with pytest.raises(SyncBoxFault, match="jumped back"):
        box.read_clock()


def test_silence_ends_a_train(wire: FakeSyncBox, box: SerialSyncBox) -> None:
    running(box, 100.0, 3)
    wire.silence()
    assert "no pulse reported" in fault_of(box.read_pulses, 0.16 + SILENCE_S + SLACK_S)
    wire.silence(False)
    box.start(100.0, SEED)
    assert pulses_of(box, 1)[0] == 0


def test_a_host_that_was_busy_has_not_heard_a_silence(wire: FakeSyncBox, box: Any) -> None:
    running(box, 200.0, 3)
    port = box._port
    with port.news:  # the reading thread can take nothing meanwhile
        threading.Event().wait(0.08 + SILENCE_S + 0.3)
        box._check(port)
    assert len(pulses_of(box, 40)) >= 40
    assert not box.losses


@pytest.mark.parametrize("ask", ["read_clock", "stop"])
def test_no_answer_is_a_fault(wire: FakeSyncBox, box: SerialSyncBox, ask: str) -> None:
    box.start(100.0, SEED)
    wire.silence()
    text = fault_of(getattr(box, ask), TRIES * ANSWER_S + SLACK_S)
    assert "start the trial again" in text


def test_one_garbled_answer_is_asked_for_again(wire: FakeSyncBox, box: SerialSyncBox) -> None:
    box.connect()
    wire.corrupt(1)
    assert len(box.read_clock()) == 1
    wire.corrupt(1)
    running(box, 100.0, 3)
    wire.corrupt(3)
    assert len(box.read_clock()) == 1


def test_a_garbled_answer_to_go_loses_no_pulse(wire: FakeSyncBox, box: SerialSyncBox) -> None:
    say = wire._say

    def garble_go(body: str) -> None:
        if body.startswith("OK GO"):
            put(wire, "_say", say)
            wire.corrupt(1)
        say(body)

    box.connect()
    put(wire, "_say", garble_go)
    box.start(200.0, SEED)
    pulses = pulses_of(box, 30)
    ticks = pulses // 5_000_000
    assert np.array_equal(ticks, np.flatnonzero(code_bits(SEED, int(ticks[-1]) + 1)))
    assert box.losses.pulses == 0
    assert box.losses.lines == 1


def test_garbled_reports_are_missing_and_counted(wire: FakeSyncBox, box: SerialSyncBox) -> None:
    running(box, 200.0, 3)
    wire.corrupt(40)
    pulses_of(box, 10)
    box.stop()
    assert box.losses.lines == 40
    assert 0 < box.losses.pulses <= 40
    assert box.losses.reported_by_box == 0


def test_dropped_reports_are_counted(wire: FakeSyncBox, box: SerialSyncBox) -> None:
    running(box, 200.0, 3)
    wire.drop(40)
    pulses_of(box, 20)
    box.stop()
    losses = box.losses
    assert losses.reported_by_box == 40
    assert losses.exposures in range(19, 22)
    assert 0 < losses.pulses <= 21
    box.start(200.0, SEED)
    assert not box.losses, "a new train counts anew"


def test_reports_missing_at_the_end_are_counted(wire: FakeSyncBox, box: SerialSyncBox) -> None:
    box.start(200.0, 1, "regular")
    pulses_of(box, 3)
    wire.drop(1 << 20)
    threading.Event().wait(0.1)
    box.stop()
    assert box.losses.pulses >= 5


def test_what_nobody_reads_is_counted_and_not_kept(wire: Any, box: Any, monkeypatch: Any) -> None:
    monkeypatch.setattr("sliplab.plugins.devices.sync_box.driver.MOST_WAITING", 5)
    box.start(1000.0, SEED)
    end = time.monotonic() + 5.0
    while box.losses.unread < 10 and time.monotonic() < end:
        threading.Event().wait(0.01)
    box.stop()
    assert len(box.read_pulses()) == 5
    assert len(box.read_exposures()) == 5
    assert box.losses.unread >= 10
    assert box.losses.pulses == 0


def test_what_the_box_refuses_is_said(wire: FakeSyncBox, box: Any, monkeypatch: Any) -> None:
    monkeypatch.setattr("sliplab.plugins.devices.sync_box.fake.MOST_HZ", 50.0)
    with pytest.raises(SyncBoxFault, match="refuses ARM: rate must be"):
        box.start(100.0, SEED)


@pytest.mark.parametrize(
    "line",
    [
        b"ARM\n",
        seal("ARM 100"),
        seal("ARM x 1 0 lfsr"),
        seal("ARM 100 0 0 lfsr"),
        seal("ARM 100 4294967295 0 lfsr"),
        seal("FLY"),
        seal("T?"),
        seal("T? x"),
    ],
)
def test_the_stand_in_survives_nonsense(wire: FakeSyncBox, box: SerialSyncBox, line: bytes) -> None:
    with serial.Serial(wire.address, timeout=1.0) as port:
        port.write(line)
        assert port.readline().startswith(b"E ")
    box.connect()


def test_an_unplugged_box(wire: FakeSyncBox, box: SerialSyncBox) -> None:
    box.start(100.0, SEED)
    wire.close()
    assert "connection broke" in fault_of(box.read_pulses, 0.3 + SLACK_S)
    with pytest.raises(SyncBoxFault, match="cannot open"):
        box.start(100.0, SEED)


def test_no_such_port() -> None:
    with pytest.raises(SyncBoxFault, match="cannot open /dev/nothing: "):
        SerialSyncBox(SyncBoxSettings(port="/dev/nothing")).connect()


def test_nobody_answers(wire: FakeSyncBox, box: SerialSyncBox) -> None:
    wire.silence()
    assert "no answer on" in fault_of(box.connect, 1.0 + ANSWER_S + SLACK_S)


def test_another_device_answers(wire: FakeSyncBox, box: SerialSyncBox, monkeypatch: Any) -> None:
    monkeypatch.setattr("sliplab.plugins.devices.sync_box.fake.NAME", "sliplab-sync-box 99")
    with pytest.raises(SyncBoxFault, match="sliplab-sync-box 99"):
        box.connect()


@pytest.mark.parametrize(
    ("rate_hz", "seed", "word"),
    [(0.5, 1, "rate"), (1001.0, 1, "rate"), (100.0001, 1, "steps of 0.001"), (100.0, 0, "seed")],
)
def test_a_train_that_cannot_be_sent(box: Any, rate_hz: float, seed: int, word: str) -> None:
    with pytest.raises(RigError, match=word):
        box.start(rate_hz, seed)


CHATTER = {
    "bytes": os.urandom(997),
    "no line feed": b"x" * 997,
    "lines": b"$GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,545.4,M*47\r\n",
    "sealed lines": seal("P 1 1 10000") + seal("HELLO") + seal("E checksum"),
    "empty lines": b"\n" * 500,
}


@pytest.mark.parametrize("what", list(CHATTER))
def test_a_foreign_device_that_chatters_without_end_is_no_sync_box(what: str) -> None:
    """And gives its port back, within the bound that a silent one has."""
    master, slave = os.openpty()
    tty.setraw(slave)
    os.set_blocking(master, False)
    ending = threading.Event()

    def chatter() -> None:
        while not ending.wait(0.0005):
            with contextlib.suppress(BlockingIOError):
                os.write(master, CHATTER[what])
            with contextlib.suppress(BlockingIOError):
                os.read(master, 4096)

    thread = threading.Thread(target=chatter)
    thread.start()
    found = SyncBoxSettings(port=os.ttyname(slave), answer_s=ANSWER_S, boot_s=0.5)
    before = threading.active_count()
    try:
        begin = time.monotonic()
        with pytest.raises(SyncBoxFault, match="no answer on"):
            SerialSyncBox(found).connect()
        assert time.monotonic() - begin < 0.5 + ANSWER_S + JOIN_S + SLACK_S
        assert threading.active_count() == before
    finally:
        ending.set()
        thread.join(5.0)
        os.close(slave)
        os.close(master)


def test_chatter_in_the_middle_of_a_train_is_counted_and_ends_in_silence(
    wire: FakeSyncBox, box: SerialSyncBox
) -> None:
    running(box, 200.0, 5)
    put(wire, "_say", lambda body: os.write(wire._master, b"no line at all\n") and None)
    assert "no pulse reported" in fault_of(box.read_pulses, 0.08 + SILENCE_S + SLACK_S)
    assert box.losses.lines > 10


@pytest.mark.quick(5)
@pytest.mark.parametrize(
    "line",
    [
        "X 0 99999999999999999999",
        "X 1 ",
        "X 1 -5",
        "X 1 1_000",
        "X 0 9999999999",
        "P",
        "P 1 1",
        "P -1 1 10000",
        "D x",
        "D -3",
        "D 1 2",
        "OK STOP -1",
        "T 1 1e3",
        "X 0 0x10",
    ],
)
def test_a_line_that_is_garbled_and_passes_its_checksum_changes_nothing(
    wire: FakeSyncBox, box: SerialSyncBox, line: str
) -> None:
    running(box, 200.0, 3)
    wire._say(line)
    before = len(box.read_exposures())
    exposures = gather(lambda: box.read_exposures().t_ns, lambda found: len(found) >= 20)
    assert np.all(np.diff(exposures) == 5_000_000)
    assert exposures[0] == before * 5_000_000 + 77_000 or before == 0
    pulses_of(box, 10)
    box.stop()
    losses = box.losses
    assert (losses.pulses, losses.exposures, losses.reported_by_box, losses.lines) == (0, 0, 0, 1)


@pytest.mark.parametrize("us", ["999999999", "99999999999999", "99999999999999999999"])
def test_a_garbled_exposure_far_ahead_costs_one(wire: FakeSyncBox, box: Any, us: str) -> None:
    """Believed, it would come after all that follow, and none of them could be."""
    say = wire._say

    def garble_fifth(body: str) -> None:
        say(f"X 5 {us}" if body.startswith("X 5 ") else body)

    put(wire, "_say", garble_fifth)
    box.start(200.0, SEED)
    exposures = gather(lambda: box.read_exposures().t_ns, lambda found: len(found) >= 20)
    box.stop()
    numbers = (exposures - 77_000) // 5_000_000
    assert numbers.tolist() == [n for n in range(len(numbers) + 1) if n != 5]
    assert (box.losses.exposures, box.losses.lines) == (1, 1)


def test_a_clock_that_falls_back_in_a_train_ends_it(box: SerialSyncBox) -> None:
    """Of a board whose 32 bits of microseconds wrap after 71.6 min, say."""
    shift = [0]
    with FakeSyncBox(lambda: time.monotonic_ns() - shift[0]) as wire:
        box = SerialSyncBox(settings(wire))
        threading.Event().wait(0.3)
        running(box, 200.0, 5)
        box.read_clock()
        shift[0] = 250_000_000
        assert "jumped back by 0.2" in fault_of(box.read_clock, 0.1 + SLACK_S)
        assert "restarted" in fault_of(box.read_pulses, 0.1 + SLACK_S)
        shift[0] = 0
        running(box, 200.0, 5)
        shift[0] = 4_294_967_296_000  # nobody reads the clock: no tick is due any more
        assert "no pulse reported" in fault_of(box.read_pulses, 0.08 + SILENCE_S + SLACK_S)
        box.close()


# -- lines and trains --------------------------------------------------------------------------


def test_a_line_comes_back() -> None:
    assert seal("T? 7") == b"T? 7*E9\n"
    assert unseal(b"T? 7*E9") == "T? 7"
    for wrong in (b"T? 7*E8", b"T? 8*E9", b"T? 7", b"", b"*", b"\xff*00"):
        assert unseal(wrong) is None


def test_lines_are_cut_wherever_they_are_split() -> None:
    stream = b"".join(seal(f"P {n} 1 {n * 1000}") for n in range(20)) + b"x" * 200 + b"\n"
    for size in (1, 7, 64, 4096):
        reader = LineReader()
        parts = [stream[at : at + size] for at in range(0, len(stream), size)]
        bodies = [body for part in parts for body in reader.bodies(part)]
        assert bodies == [f"P {n} 1 {n * 1000}" for n in range(20)]
        assert reader.wrong >= 1


def test_a_restart_in_the_middle_of_a_line_is_read() -> None:
    """The reset leaves the line without a line feed, sometimes with half a byte."""
    banner = seal(f"B {NAME}")
    for cut in (b"P 12 1 3", b"P 12 1 3\xf8", b"\x00", b""):
        assert LineReader().bodies(cut + banner) == [f"B {NAME}"]
    assert LineReader().bodies(b"P 12" + banner.replace(b"2*", b"3*")) == []


@pytest.mark.parametrize(
    ("number", "bit", "us"), [(3, 0, 30_000), (5, 1, 50_001), (1, 0, 10_000), (1 << 40, 1, 0)]
)
def test_a_garbled_report_that_passes_the_checksum_is_no_tick(
    number: int, bit: int, us: int
) -> None:
    train = ReportTrain(100_000, 0b1111_1101_1111_1011, "lfsr")
    train.first_us = 0
    train.tick(0, 1, 0)
    train.tick(2, 0, 20_000)
    with pytest.raises(ValueError, match="tick"):
        train.tick(number, bit, us)
    assert train.losses.pulses == 1


def test_tick_in_the_future_is_refused() -> None:
    """All of it fits, but the ticks that follow would come too late."""
    train = ReportTrain(100_000, 0b1111_1101_1111_1011, "lfsr")
    train.first_us = 1000
    assert train.tick(0, 1, 1000, 5000) == 0
    bit = int(code_bits(0b1111_1101_1111_1011, 50_001, "lfsr")[50_000])
    with pytest.raises(ValueError, match="tick 50000 at 500001000 us lies in the future"):
        train.tick(50_000, bit, 500_001_000, 25_000)
    assert train.tick(2, 0, 21_000, 25_000) is None
    assert train.losses.pulses == 1


def test_exposures_out_of_order_are_refused() -> None:
    train = ReportTrain(100_000, 1, "lfsr")
    train.first_us = 1000
    assert train.exposure(0, 900, 5000) == -100
    assert train.exposure(3, 2000, 5000) == 1000
    assert train.losses.exposures == 2
    for number, us in ((3, 2001), (4, 1999), (50_000, 2001), (4, 6001)):
        with pytest.raises(ValueError, match="exposure"):
            train.exposure(number, us, 5000)
    assert train.exposure(4, 6000, 5000) == 5000
