"""Stamps of wrong clocks: every row is stored as it was stamped, and no clock is believed."""

from __future__ import annotations

import re
import socket
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from sliplab.flows.verify import verify
from sliplab.plugins.record.recorder import record
from sliplab.plugins.record.shared_clock import SHARED, now_ns
from sliplab.plugins.record.sources import columns, push
from sliplab.protocols.errors import InputError
from sliplab.storage.errors import StoreError
from sliplab.storage.streams import I64
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import TrialStore

STEPS, STEP_S, STATED_MS = 40, 0.01, 2.0
S = 1_000_000_000
STAMPS: dict[str, Callable[[int, int, int], int]] = {
    "right": lambda t, first, k: t,
    "pushed_late": lambda t, first, k: t - S // 4,
    "half_as_fast": lambda t, first, k: (t + first) // 2,
    "twice_as_fast": lambda t, first, k: 2 * t - first,
    "an_hour_ago": lambda t, first, k: t - 3600 * S,
    "in_an_hour": lambda t, first, k: t + 3600 * S,
    "back_in_mid_trial": lambda t, first, k: t - 5 * S * (k > STEPS // 2),
    "leap_second": lambda t, first, k: t - S * (k > STEPS // 2),
    "ahead_in_mid_trial": lambda t, first, k: t + 5 * S * (k > STEPS // 2),
    "one_ahead": lambda t, first, k: t + 5 * S * (k == STEPS // 2),
    "one_behind": lambda t, first, k: t - 5 * S * (k == STEPS // 2),
    "falling": lambda t, first, k: 2 * first - t - k * S,
    "constant": lambda t, first, k: first,
    "tai_for_utc": lambda t, first, k: t + 37 * S,
    "utc_for_tai": lambda t, first, k: t - 37 * S,
    "smeared": lambda t, first, k: t + S // 2 + (t - first) * 116 // 10**7,
    "another_epoch": lambda t, first, k: t - 3_000_000 * S,
    "from_zero": lambda t, first, k: t - first,
    "seconds_for_ns": lambda t, first, k: t // S,
    "us_for_ns": lambda t, first, k: t // 1000,
    "far_future": lambda t, first, k: 2**62 - 1 - S + k,
    "far_past": lambda t, first, k: 1 - 2**62 + k,
}
"""What a source may stamp at a time, from that, its first and the number of its step."""
BELIEVED = {
    # what is only another zero, or another rate below the allowed drift
    "own": {
        *("right", "tai_for_utc", "utc_for_tai", "smeared", "another_epoch", "from_zero"),
        *("pushed_late", "an_hour_ago", "in_an_hour"),
    },
    "ptp": {"right"},
    "utc": {"right"},
    "host": {"right", "pushed_late"},
}
DAY_NS = 86_400 * S
"""Stamps further than that from the host's clock are errors of `push`."""


def source_ns(clock: str) -> int:
    """A right clock of a source."""
    return now_ns(clock) if clock in SHARED else time.monotonic_ns()


def pushed(trial_push: Callable[..., None], clock: str) -> dict[str, list[int]]:
    """Push the rows of all streams in real time; return the stamps that were taken, by stream."""
    taken: dict[str, list[int]] = {name: [] for name in STAMPS}
    first = source_ns(clock)
    for k in range(STEPS):
        threading.Event().wait(STEP_S)  # the sensor's period
        for name, stamp in STAMPS.items():
            t_ns = stamp(source_ns(clock), first, k)
            off_ns = abs(t_ns - time.monotonic_ns())  # from zero, it is as long as the host is up
            try:
                trial_push(name, t_ns, float(k))
            except InputError:
                assert clock == "host"
                assert off_ns > DAY_NS - S
            else:
                assert clock != "host" or off_ns < DAY_NS + S
                taken[name].append(t_ns)
    return taken


def stored(recording: Recording, name: str) -> I64:
    with recording.open() as reader:
        column: I64 = reader.column(f"streams/{name}/t")
    return column


@pytest.mark.realtime
@pytest.mark.parametrize("clock", list(BELIEVED))
def test_rows_keep_the_stamps_they_came_with_and_wrong_clocks_are_refused(
    tmp_path: Path, clock: str
) -> None:
    stated = None if clock == "own" else STATED_MS
    streams = [push(name, {"a": "N"}, clock=clock, uncertainty_ms=stated) for name in STAMPS]
    with record(streams, tmp_path, "stamps") as recorder, recorder.trial() as trial:
        taken = pushed(trial.push, clock)
    assert verify(str(tmp_path))["ok"]
    (recording,) = TrialStore.open(tmp_path).campaign("stamps").recordings()
    clocks, about = recording.clocks, recording.record.imported
    there = {name for name, stamps in taken.items() if stamps}
    for name in there:
        np.testing.assert_array_equal(stored(recording, name), taken[name], err_msg=name)
    assert there >= BELIEVED[clock]
    assert not about.dropped
    assert {name for name in clocks.streams if not name.endswith("_clock")} == BELIEVED[clock]
    assert set(clocks.refused) == there - BELIEVED[clock]
    for name, why in clocks.refused.items():
        assert f"the clock of {name} is not known: {why}" in about.warnings
        assert "rig file" not in why
        assert "nan" not in why


@pytest.mark.parametrize("clock", list(BELIEVED))
def test_what_is_no_time_is_not_taken(tmp_path: Path, clock: str) -> None:
    stream = push("g", {"a": "N"}, clock=clock, uncertainty_ms=STATED_MS)
    with record([stream], tmp_path, "stamps") as recorder, recorder.trial() as trial:
        for wrong in (np.array([2**63], np.uint64), -(2**63), 2**62, 2**70, float("nan"), "1"):
            with pytest.raises(InputError):
                trial.push("g", wrong, 1.0)
        trial.push("g", 5 if clock != "host" else None, 1.0)
    assert verify(str(tmp_path))["ok"]


TEXTS: dict[str, Callable[[int, int], str]] = {
    "back": lambda t, k: f"{(t - 5 * S * (k > STEPS // 2)) / S:.9f}",
    "tai": lambda t, k: f"{t / S + 37:.9f}",
    "nan_once": lambda t, k: "nan" if k == STEPS // 2 else f"{t / S:.9f}",
    "infinite_once": lambda t, k: "inf" if k == STEPS // 2 else f"{t / S:.9f}",
    "ns_for_s": lambda t, k: f"{t}",
    "constant": lambda t, k: "1764547200",
}


@pytest.mark.realtime
@pytest.mark.parametrize("wrong", list(TEXTS))
def test_lines_with_wrong_stamps_of_a_shared_clock(tmp_path: Path, wrong: str) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    clock = {"time_column": "at", "time_unit": "s", "shared_clock": "utc", "uncertainty_ms": 5}
    source = columns("g", f"udp://127.0.0.1:{port}", {"at": "s", "a": "N"}, **clock)
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
        record([source], tmp_path, "stamps") as recorder,
        recorder.trial(),
    ):
        for k in range(STEPS):
            threading.Event().wait(STEP_S)  # the sensor's period
            line = f"{TEXTS[wrong](time.time_ns(), k)},{k}\n"
            sender.sendto(line.encode(), ("127.0.0.1", port))
    assert verify(str(tmp_path))["ok"]
    (recording,) = TrialStore.open(tmp_path).campaign("stamps").recordings()
    counts = recording.record.devices["g"]["counts"]
    malformed = {"nan_once": 1, "infinite_once": 1, "ns_for_s": STEPS}.get(wrong, 0)
    assert counts == {"received": STEPS - malformed, "malformed": malformed}
    assert recording.record.streams["g"].rows == STEPS - malformed
    assert ("g" in recording.clocks.streams) == (wrong in {"nan_once", "infinite_once"})
    if wrong in {"back", "tai", "constant"}:
        why = recording.clocks.refused["g"]
        with pytest.raises(StoreError, match=re.escape(f"no clock 'g', since {why}")):
            recording.clock("g")


@pytest.mark.realtime
@pytest.mark.parametrize("wrong", ["back_in_mid_trial", "ahead_in_mid_trial", "tai_for_utc"])
def test_events_that_fall_back_are_counted_and_wrong_clocks_refused(
    tmp_path: Path, wrong: str
) -> None:
    """A file of events is in the order of time, so that what falls back cannot be stored."""
    source = push("events", events_px=(64, 48), clock="ptp", uncertainty_ms=STATED_MS)
    first = now_ns("ptp")
    with record([source], tmp_path, "stamps") as recorder, recorder.trial() as trial:
        for k in range(STEPS):
            threading.Event().wait(STEP_S)  # the camera's period
            t_ns = STAMPS[wrong](now_ns("ptp"), first, k)
            trial.push("events", t_ns // 1000, 1, 2, 1)
    assert verify(str(tmp_path))["ok"]
    (recording,) = TrialStore.open(tmp_path).campaign("stamps").recordings()
    about = recording.record.imported
    lost = sum((about.dropped or {}).values())
    assert recording.record.counts.events + lost == STEPS
    if wrong == "back_in_mid_trial":
        assert lost == STEPS - STEPS // 2 - 1
    else:
        assert "events" in recording.clocks.refused
        assert not recording.record.quality.passed


@pytest.mark.realtime
def test_host_stamps_of_cameras_are_held_against_their_arrival(tmp_path: Path) -> None:
    wrong = ["an_hour_ago", "in_an_hour", "twice_as_fast", "half_as_fast", "ahead_in_mid_trial"]
    names = {"frames": wrong[0], "events": wrong[1], **{each: each for each in STAMPS}}
    names = {n: each for n, each in names.items() if each in {*wrong, "right", "pushed_late"}}
    image = np.zeros((4, 8), np.uint8)
    sources = [push("events", events_px=(8, 4))]
    sources += [push(name, frames_px=(8, 4)) for name in names if name != "events"]
    sources += [push(f"e_{name}", events_px=(8, 4)) for name in names if name in STAMPS]
    with record(sources, tmp_path, "stamps") as recorder, recorder.trial() as trial:
        first = time.monotonic_ns()
        for k in range(3 * STEPS):
            threading.Event().wait(STEP_S)  # the cameras' period
            for name, each in names.items():
                t_ns = STAMPS[each](time.monotonic_ns(), first, k)
                if name != "events":
                    trial.push(name, t_ns, image)
                if name not in {"events", "frames"}:
                    trial.push(f"e_{name}", t_ns // 1000, 1, 2, 1)
            trial.push(
                "events", STAMPS[names["events"]](time.monotonic_ns(), first, k) // 1000, 1, 2, 1
            )
    assert verify(str(tmp_path))["ok"]
    (recording,) = TrialStore.open(tmp_path).campaign("stamps").recordings()
    right = {"right", "pushed_late", "e_right", "e_pushed_late"}
    found = {name for name in recording.clocks.streams if not name.endswith("_clock")}
    assert found == right
    assert recording.clocks.refused.keys() == {source.name for source in sources} - right
    assert "fall behind their arrival by 5" in recording.clocks.refused["half_as_fast"]
    assert recording.record.quality.gates.keys() == {"clock_frames", "clock_events"}
