"""Stamps of a clock that the host has too, by PTP or NTP: their error, and what arrivals refuse."""

from __future__ import annotations

import random
import threading
import time
from pathlib import Path

import pytest

from sliplab.plugins.record.columns import ColumnsSettings
from sliplab.plugins.record.recorder import RecordedTrial, record
from sliplab.plugins.record.shared_clock import now_ns
from sliplab.plugins.record.sources import push
from sliplab.protocols.errors import InputError
from sliplab.protocols.yaml_file import validate
from sliplab.storage.trials.store import TrialStore
from tests.patching import loose

STATED_MS = 2.0
TOGETHER_NS = 50_000
RECORDINGS = (6, 200)


@pytest.mark.quick(1)
@pytest.mark.realtime
@pytest.mark.parametrize("clock", ["ptp", "utc"])
@pytest.mark.parametrize(
    "count", [RECORDINGS[0], pytest.param(RECORDINGS[1], marks=pytest.mark.long)], ids=str
)
def test_times_of_a_shared_clock_lie_within_what_is_stated(
    tmp_path: Path, clock: str, count: int
) -> None:
    chance = random.Random(count)
    source = push("glove", {"pull": "N"}, clock=clock, uncertainty_ms=STATED_MS)
    true: list[tuple[int, int]] = []
    with record([source], tmp_path, "shared") as recorder:
        for _ in range(count):
            error_ns = round(chance.uniform(-STATED_MS, STATED_MS) * 1e6)
            with recorder.trial() as trial:
                true.append(pushed(trial, clock, error_ns))
    recordings = list(TrialStore.open(tmp_path).campaign("shared").recordings())
    held = 0
    for (stamp_ns, true_ns), recording in zip(true, recordings, strict=True):
        found = recording.clocks.streams["glove"]
        assert found.grade == clock
        assert found.uncertainty_ns < 1.5 * STATED_MS * 1e6
        held += abs(found.map.to_reference(stamp_ns) - true_ns) <= found.uncertainty_ns
    assert held >= 0.95 * count


@pytest.mark.parametrize("error_s", [37.0, -37.0, 0.2, -0.2], ids=str)
def test_stamps_that_their_arrival_contradicts_are_refused(tmp_path: Path, error_s: float) -> None:
    source = push("glove", {"pull": "N"}, clock="utc", uncertainty_ms=STATED_MS)
    with record([source], tmp_path, "shared") as recorder, recorder.trial() as trial:
        pushed(trial, "utc", round(error_s * 1e9))
    (recording,) = TrialStore.open(tmp_path).campaign("shared").recordings()
    assert "glove" not in recording.clocks.streams
    whys = {37.0: "as TAI is", -37.0: "s behind UTC"}
    assert whys.get(error_s, "no clock that drifts") in recording.clocks.refused["glove"]


def pushed(trial: RecordedTrial, clock: str, error_ns: int) -> tuple[int, int]:
    """Push some rows; return the stamp of the last one, and its true time on the host's clock."""
    for _ in range(4):
        before_ns, now_ns, after_ns = _both(clock)
        while after_ns - before_ns > TOGETHER_NS:  # this process did not run in between
            before_ns, now_ns, after_ns = _both(clock)
        stamp_ns, rows = now_ns + error_ns, trial.rows()["glove"]
        trial.push("glove", stamp_ns, 1.0)
        end, pause = time.monotonic() + 10, threading.Event()
        while trial.rows()["glove"] == rows and time.monotonic() < end:
            pause.wait(0.001)
    return stamp_ns, (before_ns + after_ns) // 2


def _both(clock: str) -> tuple[int, int, int]:
    """Read the host's clock, the shared one, and the host's again, ns."""
    return time.monotonic_ns(), now_ns(clock), time.monotonic_ns()


@pytest.mark.parametrize("wrong", [-1, float("nan"), float("inf"), True, "a"], ids=str)
@pytest.mark.parametrize("clock", ["host", "utc"])
def test_a_stated_error_is_a_finite_number(clock: str, wrong: object) -> None:
    with pytest.raises(InputError, match="must be a finite number of milliseconds"):
        loose(push)("glove", {"pull": "N"}, clock=clock, uncertainty_ms=wrong)


def test_an_error_must_be_stated() -> None:
    with pytest.raises(InputError, match="uncertainty_ms"):
        push("glove", {"pull": "N"}, clock="ptp")
    given = {"place": "/dev/x", "columns": {"t_us": "us", "a": "N"}, "time_column": "t_us"}
    with pytest.raises(InputError, match="needs time_column and uncertainty_ms"):
        validate(ColumnsSettings, {**given, "shared_clock": "ptp"}, "streams.yaml")
