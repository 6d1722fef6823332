"""The ledger of a study: what is done, what it cost, how long is left; over stops, too."""

from __future__ import annotations

from pathlib import Path

import pytest

from sliplab.flows.study_ledger import DONE, RUNNING, STOPPED, TO_DO, Ledger, read


class Clock:
    """Seconds that pass when they are told to."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


EXPECTED = {"collect": 100.0, "label": 50.0, "train": 200.0}


def spend(folder: Path, clock: Clock, seconds: float, worked: bool = True) -> Ledger:
    """A ledger whose first step took that long."""
    ledger = Ledger(folder, EXPECTED, clock)
    with ledger.step("collect", "trials taken") as on_done:
        clock.now += seconds
        on_done(int(worked))
    return ledger


def test_a_study_from_its_beginning_to_its_end(tmp_path: Path) -> None:
    clock = Clock()
    ledger = Ledger(tmp_path, EXPECTED, clock)
    assert ledger.left_s() == 350.0
    with ledger.step("collect", "trials taken") as on_done:
        assert [row.state for row in read(tmp_path)] == [RUNNING, TO_DO, TO_DO]
        clock.now += 50.0  # twice as fast as expected
        on_done(10)
    assert ledger.left_s() == pytest.approx(250.0 * (50 + 60) / (100 + 60))
    with ledger.step("label", "trials") as on_done:
        clock.now += 25.0
        on_done(10)
    with ledger.step("train", "networks") as on_done:
        clock.now += 75.0
        on_done(1)
    assert ledger.left_s() == 0.0
    rows = read(tmp_path)
    assert [row.state for row in rows] == [DONE] * 3
    assert [row.seconds for row in rows] == [50.0, 25.0, 75.0]
    assert [row.note for row in rows] == ["10 trials taken", "10 trials", "1 network"]


@pytest.mark.parametrize(
    ("done", "unit", "note"),
    [
        (0, "trials", "nothing to do"),
        (1, "trials taken", "1 trial taken"),
        (1, "results", "1 result"),
        (1, "searches", "1 search"),
        (1, "pages", "1 page"),
        (2, "searches", "2 searches"),
    ],
)
def test_what_a_step_did_is_counted_in_words(
    tmp_path: Path, done: int, unit: str, note: str
) -> None:
    ledger = Ledger(tmp_path, EXPECTED, Clock())
    with ledger.step("collect", unit) as on_done:
        on_done(done)
    assert ledger.rows()[0].note == note


def test_a_step_that_was_stopped_adds_up(tmp_path: Path) -> None:
    clock = Clock()

    def work() -> None:
        with Ledger(tmp_path, EXPECTED, clock).step("collect", "trials taken"):
            clock.now += 30.0
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        work()
    assert read(tmp_path)[0].state == STOPPED
    again = Ledger(tmp_path, EXPECTED, clock)
    assert again.left_s() == 70.0 + 50.0 + 200.0
    with again.step("collect", "trials taken") as on_done:
        clock.now += 90.0
        on_done(6)
    assert read(tmp_path)[0].seconds == 120.0
    assert again.left_s() == pytest.approx(250.0 * (120 + 60) / (100 + 60))


def test_a_step_with_nothing_to_do_costs_nothing_and_keeps_what_it_cost(tmp_path: Path) -> None:
    clock = Clock()
    for worked in (True, False):
        ledger = spend(tmp_path, clock, 40.0, worked)
        assert read(tmp_path)[0].seconds == 40.0
    assert ledger.left_s() == pytest.approx(250.0 * (40 + 60) / (100 + 60))


def test_what_is_left_is_never_beyond_reason(tmp_path: Path) -> None:
    ledger = spend(tmp_path, Clock(), 1e6)
    assert ledger.left_s() == 5 * 250.0


def test_a_short_first_step_says_little_about_the_rest(tmp_path: Path) -> None:
    clock = Clock()
    ledger = Ledger(tmp_path, {"collect": 15.0, "train": 60.0}, clock)
    with ledger.step("collect", "trials taken") as on_done:
        clock.now += 75.0  # a minute of it compiled what is compiled once
        on_done(36)
    assert ledger.left_s() == pytest.approx(60.0 * (75 + 60) / (15 + 60))
    long = Ledger(tmp_path / "long", {"collect": 15000.0, "train": 60.0}, clock)
    (tmp_path / "long").mkdir()
    with long.step("collect", "trials taken") as on_done:
        clock.now += 30000.0
        on_done(864)
    assert long.left_s() == pytest.approx(120.0, rel=0.01)


def test_no_study_no_rows(tmp_path: Path) -> None:
    assert read(tmp_path) == []
