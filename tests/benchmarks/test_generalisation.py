"""The program on generalisation keeps what it has, and its table says what was left out."""

from pathlib import Path

import numpy as np

from benchmarks.generalisation import Bench, Result, scored, table


class Kept(Bench):
    """Only what keeps results: no store is opened."""

    def __init__(self, out: Path, inputs: list[str]) -> None:
        self.out, self.inputs = out, inputs
        self.store = type("Simulated", (), {"simulated": True})()


def test_a_result_is_made_once_and_again_when_an_input_changed(tmp_path: Path) -> None:
    made: list[str] = []

    def work(key: str) -> Result:
        made.append(key)
        return {"share": 0.5}

    for inputs in (["a"], ["a"], ["b"], ["b"]):
        bench = Kept(tmp_path, inputs)
        assert bench.once("depth 2 mm", None, work)["share"] == 0.5
        assert bench.once("depth 3 mm", None, work)["share"] == 0.5
    assert len(made) == 4
    assert set(bench.results()) == {"depth 2 mm", "depth 3 mm"}


def test_the_table_has_a_row_for_each_result() -> None:
    counts = np.array([[3, 0, 0], [0, 3, 0], [0, 0, 0], [0, 0, 5]])
    row = scored(counts, np.array([0, 1, 1, 2]), np.array([0, 0, 1, 1]))
    assert (row["share"], row["trials"], row["n"]) == (0.75, 2, 4)
    text = table({"depth 2 mm": {**row, "seen": 0.9}, "speed 1": {"left out": "no trials"}}, True)
    assert "(simulated)" in text
    assert "| depth 2 mm | 2 | 4 | 75.0 | 50.0 to 100.0 | 83.3 | 90.0 |" in text
    assert "| speed 1 | no trials |" in text
