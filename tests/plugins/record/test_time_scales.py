"""Stamps of TAI, UTC and GPS time, declared as TAI or UTC, where the kernel knows TAI or not."""

from __future__ import annotations

import threading
import time
from pathlib import Path

import pytest

from sliplab.plugins.record import shared_clock
from sliplab.plugins.record.recorder import record
from sliplab.plugins.record.sources import push
from sliplab.storage.trials.store import TrialStore

S = 1_000_000_000
AHEAD_S = {"TAI": 37, "UTC": 0, "GPS time": 18, "no scale": 3600}
"""Of UTC."""
DECLARED = {"ptp": "TAI", "utc": "UTC"}
NAMED = {"TAI": "ptp", "UTC": "utc", "GPS time": "own"}


@pytest.mark.realtime
@pytest.mark.parametrize("table", ["there", "missing", "damaged"])
@pytest.mark.parametrize("kernel_s", [0, 10, 37])
def test_only_stamps_of_the_declared_scale_are_believed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kernel_s: int, table: str
) -> None:
    monkeypatch.setattr(shared_clock, "kernel_s", lambda: kernel_s)
    leap = tmp_path / "leap-seconds.list"
    if table != "missing":
        leap.write_text("# s 1900\n3692217600 37 # 1 Jan 2017\n" if table == "there" else "x\n")
    monkeypatch.setattr(shared_clock, "TABLE", leap)
    shared_clock._by_table_s.cache_clear()
    cases = {
        f"c{index}": (clock, scale)
        for index, (clock, scale) in enumerate((c, s) for c in DECLARED for s in AHEAD_S)
    }
    sources = [
        push(name, {"a": "N"}, clock=clock, uncertainty_ms=2) for name, (clock, _) in cases.items()
    ]
    with record(sources, tmp_path / "s", "scales") as recorder, recorder.trial() as trial:
        for _ in range(12):
            threading.Event().wait(0.01)  # the sensor's period
            for name, (_, scale) in cases.items():
                trial.push(name, time.time_ns() + AHEAD_S[scale] * S, 1.0)
    (recording,) = TrialStore.open(tmp_path / "s").campaign("scales").recordings()
    clocks, about = recording.clocks, recording.record.imported
    for name, (clock, scale) in cases.items():
        declared = DECLARED[clock]
        assert (name in clocks.streams) == (declared == scale), (clock, scale)
        if declared != scale:
            by_s = AHEAD_S[scale] - AHEAD_S[declared]
            found = clocks.refused[name]
            assert f"{abs(by_s)}.0" in found or f"{abs(by_s) - 1}.9" in found, found
            assert ("ahead of" if by_s > 0 else "behind") + f" {declared}" in found
            right = f"Declare its clock as {NAMED[scale]}" if scale in NAMED else "is the host's"
            assert right in found
        doubts = [note for note in about.warnings if note.startswith(f"{name}: the host's kernel")]
        assert len(doubts) == (clock == "ptp" and kernel_s < 37)
    shared_clock._by_table_s.cache_clear()


def test_a_further_leap_second_is_read(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    leap, now = tmp_path / "leap-seconds.list", time.time_ns() // S + 2_208_988_800
    leap.write_text(f"3692217600 37\n{now - 9} 38\n{now + 900} 39\n")
    monkeypatch.setattr(shared_clock, "TABLE", leap)
    monkeypatch.setattr(shared_clock, "kernel_s", lambda: 0)
    shared_clock._by_table_s.cache_clear()
    assert shared_clock.tai_s() == 38
    shared_clock._by_table_s.cache_clear()
