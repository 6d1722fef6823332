"""Setting trials aside and wanting them again: nothing is deleted, and who and why is kept."""

from __future__ import annotations

from pathlib import Path

import pytest

from sliplab.storage.files import read_json
from sliplab.storage.trials.decisions import SKIPPED, again, skip, skipped
from sliplab.storage.trials.store import Store, StoreError
from sliplab.storage.trials.verify import verify
from tests.storage.trial_files import campaign, commit, fail

BY = {"who": "anna", "when": "2026-01-02T03:04:05+00:00", "why": "skin was dirty"}


def test_a_committed_trial_that_is_wanted_again_is_kept_aside(tmp_path: Path) -> None:
    where = campaign(tmp_path / "s")
    sums = read_json(commit(where, "t") / "checksums.json")
    assert again(where, ["t"], BY) == {"t": "moved to quarantine/t.1; will be taken again"}
    assert where.committed() == set()
    (kept,) = where.quarantined()
    assert kept["cause"] == "again: skin was dirty"
    assert kept["asked"] == BY
    assert read_json(where.folder / "quarantine" / "t.1" / "checksums.json") == sums
    assert (where.attempts(), where.failed_attempts()) == ({"t": 1}, {})
    assert again(where, ["t"], BY) == {"t": "was pending already"}
    commit(where, "t")
    assert verify(Store.open(tmp_path / "s")) == []


def test_failed_attempts_are_forgiven_once_and_stay(tmp_path: Path) -> None:
    where = campaign(tmp_path / "s")
    for attempt in range(2):
        fail(where, "t", attempt)
    assert again(where, ["t"], BY) == {
        "t": "2 failed attempts count no longer; will be taken again"
    }
    assert (where.failed_attempts(), where.attempts()) == ({}, {"t": 2})
    assert [item["cause"] for item in where.quarantined()] == ["gate: frames_lost = 3"] * 2
    assert all(item["forgiven"] == BY for item in where.quarantined())


def test_skipping_and_thinking_better_of_it(tmp_path: Path) -> None:
    where = campaign(tmp_path / "s")
    commit(where, "t")
    did = skip(where, ["t", "u", "v"], BY)
    assert did == {"t": "is committed: left as it is", "u": "set aside", "v": "set aside"}
    assert skip(where, ["u"], {**BY, "who": "ben"}) == {"u": "was set aside already"}
    assert skipped(where) == {"u": BY, "v": BY}
    assert again(where, ["u"], BY) == {"u": "no longer set aside; will be taken again"}
    assert skipped(where) == {"v": BY}
    (where.folder / SKIPPED).write_text("{")
    with pytest.raises(StoreError, match="is damaged"):
        skipped(where)
