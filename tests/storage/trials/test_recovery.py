"""Trials whose program was killed after their record was written."""

from __future__ import annotations

import os
import re
import shutil
from pathlib import Path
from typing import Any

import pytest

from sliplab.storage.schema.trial import Provenance
from sliplab.storage.trials.recovery import recover
from sliplab.storage.trials.store import Campaign, TrialStore
from sliplab.storage.trials.verify import verify
from tests.storage.trial_files import FRAME, campaign, commit, fail, fill, record


def killed(where: Campaign, trial: str = "t", **changes: object) -> Path:
    """Write a trial up to its last rename."""
    target = commit(where, trial, **changes)
    folder = where.folder / "incoming" / trial
    os.rename(target, folder)
    return folder


def torn(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:20])


def damage(folder: Path, how: str) -> None:
    """Delete, tear or add files, as in ``-record.json ~data.h5 +x.json``."""
    for word in how.split():
        path = folder / word[1:]
        if word[0] == "+":
            path.write_text("{}")
        else:
            {"-": Path.unlink, "~": torn}[word[0]](path)


@pytest.mark.parametrize("how", ["", "-checksums.json", "~checksums.json"])
def test_killed_commit_is_completed(where: Campaign, tmp_path: Path, how: str) -> None:
    whole = commit(where, "u")
    damage(folder := killed(where), how)
    for path in folder.iterdir():
        path.chmod(0o644)  # as it is until all are written
    (problem,) = verify(TrialStore.open(tmp_path / "s"))
    assert problem.kind == "unfinished"
    assert problem.path.endswith("incoming/t")
    assert recover(where) == ["t"]
    assert where.sweep() == 0
    assert verify(TrialStore.open(tmp_path / "s")) == []
    assert where.committed() == {"t", "u"}
    for path in (where.folder / "trials" / "t").iterdir():
        assert path.stat().st_mode & 0o222 == 0
    for name in ("data.h5", "frames.mkv"):
        assert (where.folder / "trials" / "t" / name).read_bytes() == (whole / name).read_bytes()


INCOMPLETE = """-record.json; ~record.json; ~data.h5; ~data.h5 -checksums.json
-frames.mkv -checksums.json; -provenance.json; +elsewhere.json; +frames.raw"""


@pytest.mark.parametrize("how", re.split(r"; |\n", INCOMPLETE))
def test_incomplete_trial_is_quarantined(where: Campaign, how: str) -> None:
    damage(killed(where), how)
    assert recover(where) == []
    assert where.sweep() == 1
    assert where.committed() == set()
    assert [item["cause"] for item in where.quarantined()] == ["interrupted"]


def test_trial_of_another_name_or_of_a_failed_gate_is_not_committed(where: Campaign) -> None:
    killed(where, "t", quality={"passed": False, "gates": {}})
    killed(where, "u")
    shutil.move(where.folder / "incoming" / "u", where.folder / "incoming" / "v")
    assert recover(where) == []


def test_failed_attempt_killed_before_its_rename_keeps_its_cause(where: Campaign) -> None:
    fail(where, "t", 0)
    os.rename(where.folder / "quarantine" / "t.1", where.folder / "incoming" / "t")
    assert recover(where) == []
    assert where.sweep() == 1
    assert where.failed_attempts() == {"t": 1}


def test_trial_killed_on_its_way_to_quarantine_is_unfinished_and_moved(tmp_path: Path) -> None:
    where = campaign(tmp_path / "s")
    commit(where, "t")
    target = where.quarantine(where.folder / "trials" / "t", "again: dust")
    os.rename(target, where.folder / "trials" / "t")
    assert [item.kind for item in verify(TrialStore.open(tmp_path / "s"))] == ["unfinished"]
    assert where.sweep() == 1
    assert [item["cause"] for item in where.quarantined()] == ["again: dust"]
    assert verify(TrialStore.open(tmp_path / "s")) == []


def test_committed_trial_is_not_replaced(where: Campaign) -> None:
    killed(where)
    commit(where, "u")
    os.rename(where.folder / "trials" / "u", where.folder / "trials" / "t")
    before = (where.folder / "trials" / "t" / "record.json").read_bytes()
    assert recover(where) == []
    assert (where.folder / "trials" / "t" / "record.json").read_bytes() == before


def test_data_are_flushed_before_the_record_is_written(tmp_path: Path, monkeypatch: Any) -> None:
    """A record on the disk says that the data are, too."""
    order: list[str] = []
    real = os.fsync

    def fsync(handle: int) -> None:
        order.append(Path(os.readlink(f"/proc/self/fd/{handle}")).name)
        real(handle)

    where = campaign(tmp_path / "s")
    writer = where.begin("t", FRAME, 100)
    fill(writer)
    writer.seal()
    monkeypatch.setattr(os, "fsync", fsync)
    writer.commit(record("t"), Provenance())
    names = {name: order.index(name) for name in ("data.h5", "frames.mkv", "record.json")}
    assert max(names["data.h5"], names["frames.mkv"]) < names["record.json"]
    # the folder, too: a power cut may take the entry of an earlier file and leave a later one
    assert order.index("provenance.json") < order.index("t") < names["record.json"]
    assert names["record.json"] < order.index("checksums.json")
