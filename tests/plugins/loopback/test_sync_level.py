"""The sync line's level as an arm's input sees it, and the trains that a box tells of."""

from __future__ import annotations

import time

import numpy as np
import pytest

from sliplab.plugins.devices.sync_box.driver import SerialSyncBox
from sliplab.plugins.devices.sync_box.fake import FakeSyncBox
from sliplab.plugins.devices.sync_box.settings import SyncBoxSettings
from sliplab.plugins.loopback.simulation_server import SyncLevel
from sliplab.protocols.timing import Code
from sliplab.rigs.core.driver import PulseTrain
from sliplab.rigs.core.pulse_code import PULSE_NS, code_bits
from sliplab.storage.clockmap import ClockMap
from tests.rigs.waiting import until

FIRST_NS, PERIOD_NS = 3_000_000_000, 10_000_000
BOX = ClockMap.line(0, 0, 40_000)
CODES: tuple[Code, ...] = ("lfsr", "irregular", "regular")


def true_ns(box_ns: int) -> int:
    return int(BOX.to_device(box_ns))


@pytest.mark.parametrize("code", CODES)
def test_the_line_is_high_for_a_pulse_where_the_code_has_a_1(code: Code) -> None:
    level = SyncLevel(BOX)
    assert not level.high(true_ns(FIRST_NS))
    level.follow(PulseTrain(FIRST_NS, 100.0, 77, code), 0)
    bits = code_bits(77, 5000, code)
    # 4,999 is beyond the bits that are made at first
    for tick in (*range(40), 4_094, 4_999):
        begin = FIRST_NS + tick * PERIOD_NS
        expected = [False, bool(bits[tick]), bool(bits[tick]), False]
        moments = (-1_000, 1_000, PULSE_NS - 1_000, PULSE_NS + 1_000)
        assert [level.high(true_ns(begin + moment)) for moment in moments] == expected


def test_before_and_after_its_train_it_is_low() -> None:
    level = SyncLevel(BOX)
    level.follow(PulseTrain(FIRST_NS, 100.0, 77, "regular"), 0)
    assert not level.high(true_ns(FIRST_NS - 1_000))
    assert level.high(true_ns(FIRST_NS + 1_000))
    ones = np.flatnonzero(code_bits(77, 1000, "regular"))
    last = int(ones[20])
    level.follow(None, last)  # so many ticks were sent: this one was not
    assert not level.high(true_ns(FIRST_NS + last * PERIOD_NS + 1_000))
    assert level.high(true_ns(FIRST_NS + int(ones[19]) * PERIOD_NS + 1_000))
    level.follow(PulseTrain(5 * FIRST_NS, 100.0, 78, "regular"), 0)
    assert not level.high(true_ns(FIRST_NS + 1_000))


def test_a_fast_train_has_pulses_of_half_a_tick() -> None:
    level = SyncLevel(BOX)
    level.follow(PulseTrain(FIRST_NS, 500.0, 77, "regular"), 0)
    assert level.high(true_ns(FIRST_NS + 999_000))
    assert not level.high(true_ns(FIRST_NS + 1_001_000))


@pytest.mark.realtime
@pytest.mark.parametrize("code", CODES)
def test_a_box_tells_of_its_trains_before_they_begin_and_of_their_end(code: Code) -> None:
    reported: list[tuple[PulseTrain | None, int, int]] = []

    def on_train(train: PulseTrain | None, sent: int) -> None:
        reported.append((train, sent, time.monotonic_ns()))

    with FakeSyncBox(on_train=on_train) as wire:
        box = SerialSyncBox(SyncBoxSettings(port=wire.address))
        box.start(200.0, 99, code)
        until(lambda: wire.pulses >= 20, 5.0)
        box.stop()
        stored = len(box.read_pulses().t_ns)
        box.start(100.0, 7, code)
        wire.reset()
        box.close()
    (first, none, at_ns), (end, sent, _), (second, _, _), (cut, _, _) = reported
    assert first is not None
    assert (first.rate_hz, first.seed, first.code, none) == (200.0, 99, code, 0)
    assert at_ns < first.first_ns
    assert end is None
    assert int(code_bits(99, sent, code).sum()) == stored >= 20
    assert second is not None
    assert second.seed == 7
    assert cut is None  # a board that begins anew has no train


@pytest.mark.realtime
def test_an_unplugged_box_ticks_no_more() -> None:
    reported: list[PulseTrain | None] = []
    wire = FakeSyncBox(on_train=lambda train, sent: reported.append(train))
    box = SerialSyncBox(SyncBoxSettings(port=wire.address))
    box.start(100.0, 5)
    wire.close()
    wire.close()
    box.close()
    assert reported[0] is not None
    assert reported[1:] == [None]
