"""Foreign data sets by adapters: what is imported, and what is refused."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from sliplab.analysis.campaigns import Collected
from sliplab.protocols.adapter import load_adapter
from sliplab.protocols.errors import InputError
from sliplab.storage.formats.adapted import import_adapted
from sliplab.storage.formats.adapted_trials import find_trials
from sliplab.storage.formats.data_folder import DataFolder
from sliplab.storage.trials.store import Campaign, Store
from sliplab.storage.trials.verify import verify
from tests.conftest import ROOT

COUNTS: dict[str, Any] = {
    "adapter": 1,
    "name": "touch",
    "experiment": "classes",
    "trials": {"files": "**/{part:train|test}/*{object:number}*.npy", "id": "{part}-{stem}"},
    "streams": {
        "events": {"format": "counts", "axes": ["taxel", "polarity", "step"], "step_ms": 20}
    },
    "labels": {"class": "{object}"},
    "split": {"given": "part"},
}


def bring(adapter: dict[str, Any], path: Path, store: Path, text: str | None = None) -> Campaign:
    """Import `path` by an adapter into `store`, and return the campaign."""
    file = store.parent / "adapter.yaml"
    file.write_text(yaml.safe_dump(adapter) if text is None else text)
    read = load_adapter(file)
    found = find_trials(read, file, DataFolder(path))
    opened = Store.create(store)
    import_adapted(opened, read.name, found, file.read_text())
    assert not verify(opened)
    return opened.campaign(read.name)


def touches(folder: Path, name: Callable[[int], str], classes: int = 3) -> dict[str, Any]:
    """Write a small data set of counts; return the arrays by name."""
    rng = np.random.default_rng(4)
    made = {}
    for number in range(2 * classes):
        part = "train" if number < classes else "test"
        counts = rng.poisson(0.4, (5, 2, 8)).astype(np.float32)
        counts[:, :, -1] = 0
        path = folder / part / name(number)
        path.parent.mkdir(parents=True, exist_ok=True)
        np.save(path, counts)
        made[f"{part}-{path.stem}"] = counts
    return made


def test_counts_become_events_that_bin_to_the_counts(tmp_path: Path) -> None:
    made = touches(tmp_path / "set", lambda n: f"sample_{n}_label_{n % 3}.npy")
    np.save(tmp_path / "set" / "train" / "sample_9_label_1.npy", np.zeros((5, 2, 8)))
    campaign = bring(COUNTS, tmp_path / "set", tmp_path / "store")
    for id_, counts in made.items():
        recording = campaign.recording(id_)
        events = recording.events()
        again = np.zeros_like(counts)
        np.add.at(again, (events.x, events.p, events.t_us // 20_000), 1)
        np.testing.assert_array_equal(again, counts)
        assert recording.event_px == (5, 1)
        assert recording.record.imported.span_ns == (0, 160_000_000)
    assert not len(campaign.recording("train-sample_9_label_1").events())
    plan = Collected(campaign).planned
    assert plan.classes == ("0", "1", "2")
    assert {trial.id: trial.split for trial in plan}["test-sample_4_label_1"] == "test"


@pytest.mark.parametrize("below", ["", "Ev-Other", "Ev-Other/train"])
def test_the_shipped_adapter_fits_other_names_and_other_places(below: str, tmp_path: Path) -> None:
    text = (ROOT / "examples" / "ev-objects" / "adapter.yaml").read_text()
    touches(tmp_path / "set" / "Ev-Other", lambda n: f"touch-{n}.object{n % 3:02d}_x.npy")
    campaign = bring({}, tmp_path / "set" / below, tmp_path / "store", text)
    assert len(campaign.committed()) == (3 if below.endswith("train") else 6)
    assert Collected(campaign).planned.classes == ("00", "01", "02")
    given = campaign.recording("train-touch-2.object02_x").record.imported.given
    assert [span.name for span in given.spans] == ["02"]


def test_a_pattern_that_fits_nothing_says_what_is_there(tmp_path: Path) -> None:
    touches(tmp_path / "set", lambda n: f"sample_{n}.bin.npy")
    wrong = {**COUNTS, "trials": {"files": "*.mat"}}
    with pytest.raises(InputError, match=r"trials.files = \*.mat: fits no file .* 6 files: test/"):
        bring(wrong, tmp_path / "set", tmp_path / "store")
    assert not (tmp_path / "store").exists()
