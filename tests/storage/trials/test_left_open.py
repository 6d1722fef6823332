"""Trials whose data file another program opens, or opened for writing and did not close."""

from __future__ import annotations

import errno
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import pytest

from sliplab.plugins.publish.forms import publish
from sliplab.plugins.publish.publication import Publication, PublicationInfo
from sliplab.storage.remote.objects import Remote
from sliplab.storage.remote.pull import pull
from sliplab.storage.remote.push import push
from sliplab.storage.trials import superblock
from sliplab.storage.trials.hdf5_writer import blank
from sliplab.storage.trials.store import Campaign, TrialStore
from sliplab.storage.trials.verify import quarantine_damaged, verify
from tests.storage.remote.remotes import tree
from tests.storage.trial_files import campaign, commit, fail

HOLD = """
import sys, h5py
file = h5py.File(sys.argv[1], sys.argv[2], libver="latest" if sys.argv[3] else None)
if sys.argv[3] == "swmr":
    file.swmr_mode = True
print("open", flush=True)
sys.stdin.read()
"""
MODES = [("r", ""), ("r+", ""), ("r+", "swmr")]


@contextmanager
def held(path: Path, mode: str, how: str) -> Iterator[subprocess.Popen[str]]:
    """Another program has a file open; it is killed at the end."""
    command = [sys.executable, "-c", HOLD, str(path), mode, how]
    with subprocess.Popen(command, stdin=-1, stdout=-1, text=True) as program:
        try:
            assert program.stdout.readline() == "open\n"
            yield program
        finally:
            program.kill()


@pytest.fixture
def where(tmp_path: Path) -> Campaign:
    """A campaign with one trial."""
    found = campaign(tmp_path / "store")
    commit(found, "t")
    return found


def data_of(where: Campaign) -> Path:
    return where.folder / "trials" / "t" / "data.h5"


def store_of(where: Campaign) -> TrialStore:
    return TrialStore.open(where.folder.parents[1])


def leave_open(path: Path, mode: str = "r+", how: str = "") -> bytes:
    """Have a program die that has the file open for writing; the bytes as they were before."""
    before = path.read_bytes()
    with held(path, mode, how):
        pass
    assert path.read_bytes() != before
    return before


@pytest.mark.parametrize("how", ["", "swmr"])
def test_verify_closes_what_a_dead_program_left_open(how: str, where: Campaign) -> None:
    before = leave_open(data_of(where), "r+", how)
    mended: list[Path] = []
    assert verify(store_of(where), on_mended=mended.append) == []
    assert mended == [data_of(where)]
    assert data_of(where).read_bytes() == before
    assert data_of(where).stat().st_mode & 0o777 == 0o444
    assert not verify(store_of(where), on_mended=mended.append)
    assert len(mended) == 1


def test_left_open_and_changed_is_damage(where: Campaign) -> None:
    leave_open(data_of(where))
    data = bytearray(data_of(where).read_bytes())
    data[-1] ^= 1
    data_of(where).unlink()
    data_of(where).write_bytes(data)
    problems = verify(store_of(where))
    assert [(item.trial, item.what) for item in problems] == [("t", "does not match its checksum")]
    assert data_of(where).read_bytes() == data
    assert quarantine_damaged(store_of(where), problems) == ["t"]


def test_left_open_where_nothing_can_be_written_says_so(where: Campaign, monkeypatch: Any) -> None:
    leave_open(data_of(where))

    def refused(*_: object) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    monkeypatch.setattr(superblock, "write_blocks", refused)
    (problem,) = verify(store_of(where))
    assert "was left open by another program, and cannot be closed: Read-only" in problem.what


@pytest.mark.parametrize(("mode", "how"), MODES)
def test_trial_is_read_while_another_program_has_it_open(mode: str, how: str, where: Any) -> None:
    with held(data_of(where), mode, how) as program:
        assert len(where.recording("t").events()) == 1000
        assert verify(store_of(where)) == []
        assert program.poll() is None


@pytest.mark.parametrize(("mode", "how"), MODES)
def test_trial_is_read_while_this_program_has_it_open(mode: str, how: str, where: Campaign) -> None:
    whole = where.recording("t").events()
    with h5py.File(data_of(where), mode, libver="latest" if how else None) as file:
        if how == "swmr":
            file.swmr_mode = True
        found = where.recording("t").events()
        assert found.t_us.tolist() == whole.t_us.tolist()
        assert len(file["events/t"]) == 1000
        assert verify(store_of(where)) == []
    assert verify(store_of(where)) == []


def test_copies_of_what_was_left_open_are_as_committed(where: Campaign, tmp_path: Path) -> None:
    before = leave_open(data_of(where))
    about = PublicationInfo("Trials", ("somebody",), None, "2026-01-01")
    store = store_of(where)
    publish(Publication(store, (where,), about), tmp_path / "published", "croissant")
    assert (tmp_path / "published/campaigns/c/trials/t/data.h5").read_bytes() == before
    leave_open(data_of(where))
    remote = Remote(f"file://{tmp_path}/shared")
    assert push(store, remote).problems == []
    pull(remote, tmp_path / "back")
    assert tree(tmp_path / "back", "campaigns") == tree(store.folder, "campaigns")


def test_committed_files_are_read_only_and_can_be_moved(where: Campaign, tmp_path: Path) -> None:
    fail(where, "u", 0)
    remote = Remote(f"file://{tmp_path}/shared")
    push(store_of(where), remote)
    pull(remote, tmp_path / "back")
    for folder in (
        where.folder / "trials" / "t",
        where.folder / "quarantine" / "u.1",
        tmp_path / "back/campaigns/c/trials/t",
    ):
        modes = {path.name: path.stat().st_mode & 0o777 for path in folder.iterdir()}
        modes.pop("cause.json", None)
        assert set(modes.values()) == {0o444}, folder
        assert {"data.h5", "frames.mkv", "record.json", "checksums.json"} <= modes.keys()
    shutil.copytree(store_of(where).folder, tmp_path / "copy")
    where.quarantine(where.folder / "trials" / "t", "again: dust", asked={})
    commit(where, "t")
    assert verify(store_of(where)) == []
    writer = where.begin("v", (48, 32), 100)
    writer.discard()
    shutil.rmtree(tmp_path / "copy")


def test_commit_on_a_file_system_without_modes(tmp_path: Path, monkeypatch: Any) -> None:
    def refused(*_: object, **__: object) -> None:
        raise PermissionError(errno.EPERM, os.strerror(errno.EPERM))

    monkeypatch.setattr(Path, "chmod", refused)
    found = campaign(tmp_path / "store")
    commit(found, "t")
    assert verify(store_of(found)) == []


def test_lookup3_is_that_of_hdf5() -> None:
    assert superblock.lookup3(b"Four score and seven years ago") == 0x17770551
    assert superblock.lookup3(b"") == 0xDEADBEEF
    head = blank()[: superblock.HEAD_BYTES]
    assert superblock.lookup3(head[:44]) == int.from_bytes(head[44:], "little")
    assert superblock.closed(head) is None
    assert superblock.closed(head[:11] + b"\x05" + head[12:]) == head
    assert superblock.closed(b"") is None
