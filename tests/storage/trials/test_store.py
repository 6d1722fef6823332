"""A trial is there whole or not at all, and verify sees every damage."""

from pathlib import Path
from typing import Any

import pytest

from sliplab.storage.files import write_json
from sliplab.storage.schema.trial import Provenance
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import Campaign, StoreError, TrialStore
from sliplab.storage.trials.verify import verify
from tests.storage.trial_files import FRAME, commit, fail, fill, record


def test_a_committed_trial_reads_as_it_was_written(where: Campaign, tmp_path: Path) -> None:
    recording = Recording(commit(where, "a=1mm,r=1"))
    assert where.committed() == {"a=1mm,r=1"}
    assert recording.record.counts.events == 1000
    assert len(recording.events()) == 1000
    assert len(list(recording.frames())) == 12
    assert verify(TrialStore.open(tmp_path / "s")) == []


def test_spooled_frames_are_the_same_video(where: Campaign) -> None:
    folders = []
    for name, spool in (("live", False), ("spooled", True)):
        writer = where.begin(name, FRAME, 100, spool=spool)
        fill(writer)
        folders.append(writer.commit(record(name), Provenance()))
    videos = [(folder / "frames.mkv").read_bytes() for folder in folders]
    assert videos[0] == videos[1]
    assert not (folders[1] / "frames.raw").exists()


def test_what_was_not_committed_is_quarantined_with_its_cause(where: Any, tmp_path: Path) -> None:
    writer = where.begin("t", FRAME, 100)
    fill(writer)
    writer.abandon()
    assert where.committed() == set()
    assert [p.what for p in verify(TrialStore.open(tmp_path / "s"))] == [
        "is an unfinished trial; the next `sliplab collect` quarantines it"
    ]
    assert where.sweep() == 1
    assert [item["cause"] for item in where.quarantined()] == ["interrupted"]
    assert where.failed_attempts() == {}
    commit(where, "t")
    assert verify(TrialStore.open(tmp_path / "s")) == []


def test_a_failed_attempt_keeps_its_data_and_counts(where: Campaign) -> None:
    for attempt in range(2):
        fail(where, "t", attempt)
    assert where.failed_attempts() == {"t": 2}
    assert (where.folder / "quarantine" / "t.2" / "data.h5").exists()


def test_a_trial_is_never_committed_twice(where: Campaign) -> None:
    commit(where, "t")
    writer = where.begin("t", FRAME, 100)
    fill(writer)
    with pytest.raises(FileExistsError, match="already committed"):
        writer.commit(record("t"), Provenance())


def test_verify_sees_a_record_that_does_not_fit_its_data(where: Campaign, tmp_path: Path) -> None:
    writer = where.begin("t", FRAME, 100)
    fill(writer, count=900)
    writer.commit(record("t"), Provenance())
    (problem,) = verify(TrialStore.open(tmp_path / "s"))
    assert problem.what == "900 events, the record says 1000"


def test_a_folder_that_is_no_store_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("x")
    with pytest.raises(StoreError, match="holds other files"):
        TrialStore.create(tmp_path)
    with pytest.raises(StoreError, match="is not a store"):
        TrialStore.open(tmp_path)
    other = tmp_path / "new"
    TrialStore.create(other)
    write_json(other / "store.json", {"format": 99})
    with pytest.raises(StoreError, match="format = 99"):
        TrialStore.open(other)
