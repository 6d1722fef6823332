"""The slip archive: one convention of onsets and streams, beside the trials."""

from __future__ import annotations

from pathlib import Path

import mlcroissant
import numpy as np
import pandas as pd
import pytest

from sliplab.plugins.publish.forms import publish
from sliplab.protocols.errors import InputError
from sliplab.storage.schema.label import ChangePoints, OnsetDoubts, OnsetIntervals, TrialLabel
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import TrialStore
from sliplab.storage.trials.verify import verify_trial
from tests.plugins.publish.test_croissant import publication
from tests.storage.trial_files import campaign, commit

pytestmark = [
    pytest.mark.filterwarnings("ignore:ConjunctiveGraph is deprecated"),
    pytest.mark.filterwarnings("ignore:The inplace keyword in DataFrame.reset_index"),
]
MS = 1_000_000
LABELS = {
    # what the label states, and the ends of the intervals of both onsets
    "own": (
        {"rule": "given", "intervals": OnsetIntervals(incipient_ns=(4, 6), gross_ns=None)},
        ((4, 6), None),
    ),
    "change_point": (
        {
            "rule": "change_point",
            "change_point": ChangePoints(
                incipient_ns=5,
                gross_ns=9 * MS,
                per_marker_ns=(9 * MS, 5),
                low_ns=(8 * MS, 3),
                high_ns=(11 * MS, 8),
            ),
        },
        ((3, 8), (8 * MS, 11 * MS)),
    ),
    "given": ({"rule": "given"}, (None, None)),
}


@pytest.fixture
def store(tmp_path: Path) -> TrialStore:
    where = campaign(tmp_path / "store")
    for number in range(3):
        commit(where, f"t{number}")
    return TrialStore.open(tmp_path / "store")


def labelled(store: TrialStore, trial: str, **stated: object) -> None:
    about = {"incipient_ns": 5, "gross_ns": 9 * MS, "end_ns": 20 * MS, "key": "k", **stated}
    saved = Derived.of(store, "labels", store.campaigns()[0].name)
    saved.write(trial, "k", TrialLabel.model_validate(about))


def onsets(folder: Path) -> pd.DataFrame:
    return pd.read_parquet(folder / "onsets.parquet").set_index(["trial", "onset"])


@pytest.mark.parametrize("name", LABELS)
def test_the_interval_is_the_labels_own_where_it_has_one(
    store: TrialStore, tmp_path: Path, name: str
) -> None:
    stated, expected = LABELS[name]
    labelled(store, "t0", **stated)
    publish(publication(store), tmp_path / "out", "archive")
    found = onsets(tmp_path / "out")
    for kind, ends in zip(("incipient", "gross"), expected, strict=True):
        row = found.loc[("t0", kind)]
        if ends is None:
            assert pd.isna(row.low_ns)
            assert pd.isna(row.high_ns)
            assert pd.isna(row.interval)
        else:
            assert (row.low_ns, row.high_ns, row.interval) == (*ends, "label")


def test_without_one_it_is_a_frames_period_and_its_clock(store: TrialStore, tmp_path: Path) -> None:
    labelled(store, "t1")
    where = store.campaigns()[0]
    publish(publication(store), tmp_path / "out", "archive")
    row = onsets(tmp_path / "out").loc[("t1", "gross")]
    recording = next(one for one in where.recordings() if one.folder.name == "t1")
    period = float(np.median(np.diff(recording.frame_times())))
    clock = recording.clocks.devices()["frames"].uncertainty_ns
    assert row.high_ns - row.t_ns == row.t_ns - row.low_ns == round(period + clock)
    assert row.interval == "period and clock"


def test_an_onset_in_doubt_has_a_reason_and_no_time(store: TrialStore, tmp_path: Path) -> None:
    labelled(store, "t2", incipient_ns=None, doubts=OnsetDoubts(incipient="the plate is lost"))
    publish(publication(store), tmp_path / "out", "archive")
    row = onsets(tmp_path / "out").loc[("t2", "incipient")]
    assert pd.isna(row.t_ns)
    assert row.doubt == "the plate is lost"


def test_it_is_a_store_with_one_manifest_that_others_read(
    store: TrialStore, tmp_path: Path
) -> None:
    labelled(store, "t0")
    out = tmp_path / "out"
    publish(publication(store), out, "archive")
    data = mlcroissant.Dataset(out / "croissant.json")
    assert len(list(data.records("onsets"))) == 2
    streams = pd.read_parquet(out / "streams.parquet")
    recording = Recording(next((out / "campaigns").glob("*/trials/t0")))
    assert streams[streams.trial == "t0"].stream.tolist() == recording.streams()
    assert (streams.clock_uncertainty_us.dropna() >= 0).all()
    again = TrialStore.open(out)
    assert not [
        fault for one in again.campaigns()[0].recordings() for fault in verify_trial(one.folder)
    ]


def test_without_any_label_it_says_what_to_do(store: TrialStore, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="needs onsets: run `sliplab label`"):
        publish(publication(store), tmp_path / "out", "archive")
    assert not (tmp_path / "out").exists()
