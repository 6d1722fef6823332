"""Derived results are fresh by their key and by nothing else."""

from pathlib import Path

import numpy as np
import pytest

from sliplab.storage.files import make_folder, write_json
from sliplab.storage.trials.derived import Derived, make_key
from sliplab.storage.trials.store import TrialStore


def test_a_result_is_stale_by_inputs_parameters_and_version(tmp_path: Path) -> None:
    results = Derived.of(TrialStore.create(tmp_path), "labels", "c")
    key = make_key("labels", 1, ["a"], {"threshold": 2})
    assert not results.fresh("t", key)
    results.write("t", key, {"onset": 5}, {"x": np.arange(3)})
    assert results.fresh("t", key)
    assert results.read("t")["onset"] == 5
    assert np.array_equal(results.arrays("t")["x"], np.arange(3))
    for other in (
        make_key("labels", 2, ["a"], {"threshold": 2}),
        make_key("labels", 1, ["b"], {"threshold": 2}),
        make_key("labels", 1, ["a"], {"threshold": 3}),
        make_key("counts", 1, ["a"], {"threshold": 2}),
    ):
        assert not results.fresh("t", other)


def test_a_damaged_result_is_stale(tmp_path: Path) -> None:
    results = Derived.of(TrialStore.create(tmp_path), "labels", "c")
    results.write("t", "k", {})
    (results.folder / "t.json").write_text("{")
    assert not results.fresh("t", "k")


@pytest.mark.parametrize(
    ("campaign", "simulated"), [("mock", True), ("real", False), (None, True), ("other", False)]
)
def test_a_result_of_simulated_trials_says_so(
    tmp_path: Path, campaign: str | None, simulated: bool
) -> None:
    store = TrialStore.create(tmp_path)
    for name in ("mock", "real"):
        make_folder(tmp_path / "campaigns" / name)
        info = {"name": name, "simulated": name == "mock"}
        write_json(tmp_path / "campaigns" / name / "campaign.json", info)
    results = Derived.of(store, "labels", campaign)
    results.write("t", "k", {"onset": 5})
    assert results.read("t") == {"key": "k", "onset": 5, "simulated": simulated}
    results.write("t", "k", {"simulated": None})
    assert results.read("t")["simulated"] is None, "its own word counts"
