"""The program that serves for hours, for two short windows: all that it accounts for is there."""

from __future__ import annotations

import csv
from datetime import UTC, datetime
from pathlib import Path

import pytest

from benchmarks import nights


def test_windows_begin_at_whole_minutes_one_after_the_other() -> None:
    found = nights.windows(datetime(2030, 1, 1, 23, 58, 30, tzinfo=UTC), 20, 8, 2)
    times = [f"{w.begins:%H:%M} {w.ends:%H:%M}" for w in found]
    assert times == ["23:59 00:07", "00:09 00:17"]


@pytest.mark.programs
@pytest.mark.long
def test_two_windows_are_accounted_for(tmp_path: Path) -> None:
    assert nights.measure(tmp_path, 8, 3, 1, browser=False) == 0
    with (tmp_path / "samples.csv").open() as file:
        programs = {row["program"] for row in csv.DictReader(file)}
    assert programs == {"service", "page", "alerts", "prefect", "run"}
