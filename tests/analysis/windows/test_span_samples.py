"""Samples of recordings that show classes: windows inside their parts, and no others."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sliplab.analysis.campaigns import Collected, class_names, collected, of_classes
from sliplab.analysis.labels.reviewed import StoreLabels
from sliplab.analysis.windows.sample_sets import load_samples
from sliplab.flows.label import label
from sliplab.protocols import InputError
from sliplab.storage.trials.store import StoreError, TrialStore
from tests.analysis.foreign import chunk, foreign_campaign

MS = 1_000_000
ADAPTER = """adapter: 1
name: touch
experiment: classes
split: {given: part}
analysis:
  windows: {length_ms: 100, step_ms: 50, taxels: 4, polarity: both}
  samples: {per_class: 3}
"""


@pytest.fixture
def item(tmp_path: Path) -> Collected:
    """Three recordings of a second: one of a class, one of two, and an empty one."""
    events = chunk(np.arange(0, 1_000_000, 10_000), np.arange(100) % 4, 0, np.arange(100) % 2)

    def about(part: str, *spans: tuple[int, int, str]) -> dict[str, object]:
        given = [{"start_ns": a * MS, "end_ns": b * MS, "name": name} for a, b, name in spans]
        return {"fields": {"part": part}, "given": {"source": "file name", "spans": given}}

    trials = {
        "one": (events, about("train", (0, 1000, "10"))),
        "two": (events, about("train", (0, 150, "9"), (150, 420, "10"))),
        "none": (events, about("test", (900, 990, "9"))),
    }
    return foreign_campaign(tmp_path / "store", ADAPTER, trials)


def test_windows_lie_in_their_part_and_are_drawn_where_there_are_more(item: Collected) -> None:
    store = TrialStore.open(item.campaign.folder.parents[1])
    campaigns = collected(store)
    assert of_classes(campaigns)
    assert class_names(campaigns) == ("9", "10")
    assert label(store, campaigns)["done"] == 3
    labels = StoreLabels(store)
    train = load_samples(labels, campaigns, "train", classes=("9", "10"))
    by_name = {
        (train.trials[k].trial, int(y)): np.sort(
            train.start_ns[(train.trial == k) & (train.y == y)]
        )
        for k in range(len(train.trials))
        for y in (0, 1)
    }
    assert by_name["two", 0].tolist() == [0]  # 150 ms hold one window of 100
    assert by_name["two", 1].tolist() == [150 * MS, 250 * MS]
    drawn = by_name["one", 1]
    assert len(drawn) == 3
    assert set(drawn.tolist()) <= set(range(0, 1000 * MS, 100 * MS))
    assert train.windows.shape == (2, 8, 1, 1)
    assert train.windows.totals.tolist() == [10] * len(train)
    again = load_samples(labels, campaigns, "train", classes=("9", "10"))
    np.testing.assert_array_equal(again.start_ns, train.start_ns)
    # 90 ms hold no window: the trial is there, without samples
    test = load_samples(labels, campaigns, "test", classes=("9", "10"))
    assert (len(test), [name.trial for name in test.trials]) == (0, ["none"])


def test_slip_and_classes_are_analysed_apart(item: Collected, tmp_path: Path) -> None:
    slip = "adapter: 1\nname: slips\nexperiment: kinematic\n"
    other = foreign_campaign(
        tmp_path / "store", slip, {"a": (chunk([1]), {})}, experiment="kinematic", name="slips"
    )
    with pytest.raises(InputError, match=r"'touch' is of classes and 'slips' of slip"):
        of_classes([item, other])
    assert not of_classes([other])
    with pytest.raises(StoreError, match="at least two are needed"):
        class_names([other])
