"""Trials recorded beside a program of its own: what they hold, and what they say."""

from __future__ import annotations

import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sliplab
from sliplab.plugins.record.recorder import RecordedTrial, levels, record
from sliplab.plugins.record.sources import push
from sliplab.protocols.errors import InputError
from sliplab.storage.trials.lock import Locked
from sliplab.storage.trials.store import TrialStore
from tests.plugins.record.recordings import SIZE, check_rows, feed, sources


def test_a_trial_has_rows_condition_and_onsets_of_marks(tmp_path: Path) -> None:
    with (
        sliplab.record(sources(), tmp_path, "grasps", operator="Ada") as recording,
        recording.trial(object="blue mug", grip_n=2.0) as trial,
    ):
        feed(trial, 0)
        trial.mark("contact")
        trial.mark("slip", trial.begin_ns - 1)
        trial.mark("slip", trial.begin_ns + 5_000, uncertainty_ms=2)
        feed(trial, 1)
        trial.mark("gross", trial.begin_ns + 9_000, uncertainty_ms=3)
    store = sliplab.open_store(tmp_path)
    assert store.verify()["ok"]
    found = store.trial(trial.id)
    about = found.recording.record
    check_rows(found.recording)
    assert about.condition == {"object": "blue_mug", "grip": "2.0 N"}
    assert about.counts.events == 4000
    assert about.streams["side"].rows == 2
    given = about.imported.given
    assert given.incipient_ns == trial.begin_ns + 5_000
    assert given.gross_ns == trial.begin_ns + 9_000
    assert given.uncertainty_ns == 3e6
    assert [mark.name for mark in about.imported.marks] == [
        "slip",
        "slip",
        "gross",
        "contact",
    ]
    assert "mark slip lies outside of the trial" in about.imported.warnings
    assert not (found.recording.folder / "journal.jsonl").exists()


def test_a_block_that_raises_commits_its_trial_and_says_so(tmp_path: Path) -> None:
    with record(sources(), tmp_path, "grasps") as recording:
        trial = recording.trial()
        with pytest.raises(ZeroDivisionError, match="no grip"), trial:
            grasp_without_grip(trial)
        with recording.trial() as second:
            feed(second, 0)
    found = sliplab.open_store(tmp_path).trial(trial.id).recording.record
    assert "ended by ZeroDivisionError: no grip" in found.imported.warnings
    assert recording.committed == [trial.id, second.id]


def grasp_without_grip(trial: RecordedTrial) -> None:
    feed(trial, 0)
    raise ZeroDivisionError("no grip")


def test_blocks_at_100_khz_from_several_threads_are_all_there(tmp_path: Path) -> None:
    blocks, rows = 50, 1000
    with (
        record([push("pull", {"fx": "N", "fy": "N"})], tmp_path, "fast") as recording,
        recording.trial() as trial,
    ):

        def work() -> None:
            for _ in range(blocks):
                t_ns = time.monotonic_ns() + np.arange(rows) * 10_000
                trial.push("pull", t_ns, np.arange(float(rows)), fy=np.zeros(rows))

        threads = [threading.Thread(target=work) for _ in range(2)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(60)
    found = sliplab.open_store(tmp_path).trial(trial.id).recording
    assert found.record.streams["pull"].rows == 2 * blocks * rows
    assert not found.record.imported.dropped
    assert (np.diff(found.samples("pull")["t"]) >= 0).all()


def test_more_than_the_buffer_holds_is_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sliplab.plugins.record.pushed.MOST_BYTES", 10_000)
    with (
        record([push("pull", {"fx": "N"})], tmp_path, "lost") as recording,
        recording.trial() as trial,
    ):
        trial.push("pull", time.monotonic_ns() + np.arange(1000), np.zeros(1000))
        assert trial.lost() == {"pull": 1000}
    found = sliplab.open_store(tmp_path).trial(trial.id).recording.record
    assert found.imported.dropped == {"rows of pull that were lost": 1000}


def test_own_clocks_are_bounded_by_the_times_of_pushes(tmp_path: Path) -> None:
    """Times of a clock that began elsewhere come within the stated bound of the host's."""
    origin = time.monotonic_ns() - 7_000_000_000
    with (
        record(
            [
                push("temperature", {"t": "degC"}, clock="own"),
                push("events", events_px=SIZE, clock="own"),
            ],
            tmp_path,
            "own",
        ) as recording,
        recording.trial() as trial,
    ):
        for _ in range(40):
            own = time.monotonic_ns() - origin
            trial.push("temperature", own, 20.0)
            trial.push("events", own // 1000 + np.arange(3), [1, 2, 3], [1, 2, 3], [0, 1, 0])
            time.sleep(0.01)  # the sensor's period
    found = sliplab.open_store(tmp_path).trial(trial.id).recording
    clocks = found.clocks
    for name, clock in (("temperature", clocks.streams["temperature"]), ("events", clocks.events)):
        middle = (trial.begin_ns + trial._end_ns) // 2
        error = clock.map.to_reference(middle - origin) - middle
        assert abs(error) <= clock.uncertainty_ns < 60e6, name


@pytest.mark.parametrize(
    ("pushed", "key"),
    [
        ((None,), ""),
        ((1.5, 1.0, 2.0), "t"),
        ((time.time_ns(), 1.0, 2.0), "t"),
        ((None, [1.0, 2.0], 1.0), "fx"),
        ((None, 1.0, 2.0, 3.0), ""),
    ],
    ids=["none", "float", "wall clock", "lengths", "too many"],
)
def test_wrong_rows_are_refused(tmp_path: Path, pushed: tuple[object, ...], key: str) -> None:
    with (
        record([push("pull", {"fx": "N", "fy": "N"})], tmp_path, "wrong") as recording,
        recording.trial() as trial,
    ):
        with pytest.raises(InputError) as raised:
            trial.push("pull", *pushed)
        assert raised.value.key == key
        with pytest.raises(InputError):
            trial.push("nothing", None, 1.0)
    with pytest.raises(RuntimeError, match="no trial"):
        trial.push("pull", None, 1.0, 2.0)
    with pytest.raises(RuntimeError, match="within the block"):
        recording.trial()


def test_times_of_events_in_nanoseconds_are_named(tmp_path: Path) -> None:
    with (
        record([push("events", events_px=(8, 4))], tmp_path, "wrong") as recording,
        recording.trial() as trial,
        pytest.raises(InputError, match="times of events are in us"),
    ):
        trial.push("events", time.monotonic_ns(), 1, 1, 1)


@pytest.mark.parametrize(
    ("declared", "key"),
    [
        ({"columns": {"v": 5}}, "columns"),
        ({"columns": ["v"]}, "columns"),
        ({"columns": {}}, "columns"),
        ({"events_px": 5}, "events_px"),
        ({"events_px": (0, 1)}, "events_px"),
        ({"frames_px": (64, 4.5)}, "frames_px"),
    ],
    ids=str,
)
def test_wrong_declarations_are_refused(declared: Any, key: str) -> None:
    with pytest.raises(InputError) as raised:
        push("x", **declared)
    assert raised.value.key == key


def test_one_trial_is_recorded_at_a_time(tmp_path: Path) -> None:
    with record([push("pull", {"fx": "N"})], tmp_path, "two") as recording:
        first, second = recording.trial(), recording.trial()
        with first, pytest.raises(RuntimeError, match="end it first"), second:
            pass


def test_one_program_at_a_time_and_one_kind_of_campaign(tmp_path: Path) -> None:
    with record(sources(), tmp_path, "grasps"), pytest.raises(Locked):
        record(sources(), tmp_path, "grasps").__enter__()
    with pytest.raises(InputError, match="simulated"):
        record(sources(), tmp_path, "grasps", simulated=True).__enter__()


def test_settings_of_the_analysis_are_those_of_an_adapter(tmp_path: Path) -> None:
    file = tmp_path / "analysis.yaml"
    file.write_text("title: Grasps\nanalysis: {training: {epochs: 3}}\n")
    with record(sources(), tmp_path / "store", "grasps", analysis=file):
        pass
    file.write_text("streams: {}\n")
    with pytest.raises(InputError, match="must be one of"):
        record(sources(), tmp_path / "store", "grasps", analysis=file).__enter__()
    text = (tmp_path / "store" / "campaigns" / "grasps" / "protocol.yaml").read_text()
    assert "Grasps" in text


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("grip_n", 2.0, ("grip", "2.0 N")),
        ("speed_mm_s", 10, ("speed", "10 mm/s")),
        ("object", "blue mug", ("object", "blue_mug")),
        ("n", 3, ("n", "3")),
    ],
)
def test_a_condition_has_its_unit_in_its_name(
    name: str, value: object, expected: tuple[str, str]
) -> None:
    assert levels({name: value}) == dict([expected])


@pytest.mark.parametrize(
    "condition",
    [
        *({"": 1}, {"a b": 1}, {"x/y": 1}, {"grip_n": 2, "grip": 3}, {"x": 10**400}, {"x": None}),
        *({"x": "\u00e4"}, {"x": ""}, {"x": "a/b"}),
    ],
    ids=str,
)
def test_conditions_that_say_nothing_or_two_things_are_refused(condition: Any) -> None:
    with pytest.raises(InputError):
        levels(condition)


def test_values_are_those_of_the_moment_they_were_pushed(tmp_path: Path) -> None:
    """A program may use its buffers again."""
    t_ns, values = np.zeros(10, np.int64), np.zeros(10)
    with (
        record([push("pull", {"fx": "N", "fy": "N"})], tmp_path, "same") as recording,
        recording.trial(),
    ):
        for step in range(20):
            t_ns[:], values[:] = time.monotonic_ns(), step
            recording.sources[0].device.push(t_ns, values, values)
    (found,) = TrialStore.open(tmp_path).campaign("same").recordings()
    np.testing.assert_array_equal(found.samples("pull")["fx"], np.repeat(np.arange(20.0), 10))


@pytest.mark.parametrize(
    "value", [None, True, "x", b"3", 1 + 2j, 2**60 + 1, -(2**60), 10**400, [[1], [1, 2]]], ids=str
)
def test_values_that_are_no_numbers_or_would_be_rounded_are_refused(value: object) -> None:
    source = push("pull", {"fx": "N", "fy": "N"})
    with pytest.raises(InputError, match="fx"):
        source.device.push(None, value, 1.0)


@pytest.mark.parametrize("pixel", [1.5, float("nan"), float("inf"), "1", None])
def test_pixels_of_events_are_whole_numbers(pixel: object) -> None:
    source = push("events", events_px=(8, 4))
    with pytest.raises(InputError, match="events: x"):
        source.device.push(None, pixel, 1, 1)


@pytest.mark.parametrize(
    "wrong",
    [{"t_ns": 1.5}, {"t_ns": True}, {"t_ns": "5"}, {"t_ns": 2**70}]
    + [{"uncertainty_ms": value} for value in (-1, float("nan"), float("inf"), "x")]
    + [{"name": 3}, {"name": ""}],
    ids=str,
)
def test_wrong_marks_are_refused(tmp_path: Path, wrong: Any) -> None:
    with (
        record([push("pull", {"fx": "N"})], tmp_path, "marks") as recording,
        recording.trial() as trial,
        pytest.raises(InputError, match="^mark.*" + next(iter(wrong)).replace("name", "text")),
    ):
        trial.mark(**{"name": "slip", **wrong})
    (found,) = TrialStore.open(tmp_path).campaign("marks").recordings()
    assert not found.record.imported.marks


def test_a_stream_is_recorded_once_and_has_a_name_of_its_own(tmp_path: Path) -> None:
    pull = push("pull", {"fx": "N"}, clock="ptp", uncertainty_ms=1)
    with (
        record([pull], tmp_path / "a", "one"),
        pytest.raises(InputError, match="is being recorded already"),
    ):
        record([pull], tmp_path / "b", "two").__enter__()
    with pytest.raises(InputError, match="readings of the clock of pull"):
        record([pull, push("pull_clock", {"a": ""})], tmp_path / "b", "two").__enter__()
    with record([pull], tmp_path / "b", "two"):
        pass


def test_a_stream_of_which_nothing_came_is_there_after_export_and_import(tmp_path: Path) -> None:
    streams = [
        push("pull", {"fx": "N"}),
        push("grip", {"v": "mm"}),
        push("imu", {"x": "", "y": ""}),
    ]
    with record(streams, tmp_path / "a", "c") as recording, recording.trial() as trial:
        trial.push("pull", None, 1.5)
    sliplab.export(tmp_path / "a", "mcap", tmp_path / "m", licence="CC0-1.0", creator=["Ada"])
    sliplab.import_data(tmp_path / "m", tmp_path / "b", name="again")
    found = sliplab.open_store(tmp_path / "b")
    assert found.verify()["ok"]
    streams_of = found.trial(trial.id).recording.record.streams
    assert {name: each.rows for name, each in streams_of.items()} == {
        "pull": 1,
        "grip": 0,
        "imu": 0,
    }
