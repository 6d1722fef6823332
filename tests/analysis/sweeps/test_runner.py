"""The runner of sweeps: each point is measured once, kept at once, and gone on with."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import pytest

from sliplab.analysis.sweeps.runner import Advance, Arrays, ResultFile, Sweep, SweepTask, task_sweep
from sliplab.storage.errors import StoreError
from sliplab.storage.files import write_json
from sliplab.storage.schema.document import Document
from sliplab.storage.trials.derived import Derived


@dataclass(frozen=True)
class Square:
    """A point of the tests."""

    number: int
    version: int = 1

    @property
    def name(self) -> str:
        """Its name."""
        return f"square_{self.number}"

    @property
    def key(self) -> str:
        """Its key."""
        return f"{self.number} {self.version}"

    @property
    def title(self) -> str:
        """The name."""
        return self.name


class Value(Document):
    """A result of the tests."""

    key: str = ""
    value: int


class Squares(Document):
    """All results of the tests."""

    squares: dict[str, Value]


def measure(point: Square, advance: Advance) -> tuple[Value, Arrays | None]:
    """Do two parts, of which the first says that it is done half, then whole."""
    advance("train", 0.5, "half")
    advance("train", 0.5, "whole")
    if point.number == 13:
        raise KeyboardInterrupt
    return Value(value=point.number**2), None


def estimate(point: Square) -> Mapping[str, float]:
    """Train ten seconds, count as many as the number."""
    return {"train": 10.0, "count": float(point.number)}


def results(folder: Path, kind: str) -> Derived | ResultFile[Squares]:
    """One of the two places for results."""
    if kind == "derived":
        return Derived(folder)
    return ResultFile(folder / "results.json", Squares, "squares", {"simulated": True})


def read(kept: Derived | ResultFile[Squares], name: str) -> Value:
    """The result of that name."""
    return kept.load(name, Value) if isinstance(kept, Derived) else kept.load().squares[name]


@pytest.mark.parametrize("kind", ["derived", "file"])
def test_a_stopped_sweep_goes_on_and_grows(tmp_path: Path, kind: str) -> None:
    kept = results(tmp_path / "new", kind)
    points = [Square(2), Square(13), Square(3)]
    sweep = Sweep(points, kept, measure, estimate)
    with pytest.raises(KeyboardInterrupt):
        sweep.run()
    assert sweep.pending == points[1:]
    larger = Sweep([Square(2), Square(3), Square(4)], kept, measure)
    assert larger.run() == 2
    assert (larger.run(), larger.pending) == (0, [])
    assert read(kept, "square_4").to_json() == {"key": "4 1", "value": 16}
    # another key is another result, in the same place
    other = Sweep([Square(2, version=2)], kept, measure)
    assert other.run() == 1
    assert read(kept, "square_2").key == "2 2"


def test_progress_adds_up_to_what_was_expected(tmp_path: Path) -> None:
    sweep = Sweep([Square(2), Square(3)], Derived(tmp_path), measure, estimate)
    looked: list[int] = []
    expected = sweep.expected(lambda: looked.append(1))
    assert len(looked) == 2
    assert expected == {
        "square_2": {"train": 10, "count": 2},
        "square_3": {"train": 10, "count": 3},
    }
    steps: list[tuple[float, str]] = []
    assert sweep.run(lambda amount, note: steps.append((amount, note)), expected) == 2
    assert steps[:3] == [(5, "half"), (5, "whole"), (2, "square_2")]
    assert sum(amount for amount, _ in steps) == 25
    assert sweep.expected() == {}


def test_no_point_is_begun_when_the_time_is_over(tmp_path: Path) -> None:
    begun: list[tuple[int, int, str]] = []
    sweep = Sweep([Square(k) for k in range(4)], Derived(tmp_path), measure)
    made = sweep.run(
        over=lambda: len(begun) == 2,
        begin=lambda number, count, point: begun.append((number, count, point.name)),
    )
    assert made == 2
    assert begun == [(1, 4, "square_0"), (2, 4, "square_1")]
    assert [point.number for point in sweep.pending] == [2, 3]


def test_a_file_of_results_keeps_its_head(tmp_path: Path) -> None:
    kept = ResultFile(tmp_path / "results.json", Squares, "squares", {"change": 0.2})
    assert not kept.fresh("a", "k")
    with pytest.raises(FileNotFoundError):
        kept.load()
    task_sweep([SweepTask(name, "k", lambda: Value(value=1)) for name in "ba"], kept).run()
    task_sweep([SweepTask("b", "other", lambda: Value(value=2))], kept).run()
    assert json.loads(kept.path.read_text()) == {
        "change": 0.2,
        "squares": {"b": {"key": "other", "value": 2}, "a": {"key": "k", "value": 1}},
    }


def test_a_stale_result_of_another_shape_is_made_again_and_a_damaged_one_is_named(
    tmp_path: Path,
) -> None:
    kept = ResultFile(tmp_path / "results.json", Squares, "squares", {})
    write_json(kept.path, {"squares": {"a": {"key": "old", "values": [1]}}})
    with pytest.raises(StoreError, match=r"results\.json: squares\.a\.value: is missing.*delete"):
        kept.load()
    assert task_sweep([SweepTask("a", "new", lambda: Value(value=3))], kept).run() == 1
    assert kept.load().squares["a"].value == 3
