"""A folder that another program writes into."""

from __future__ import annotations

import json
import os
import signal
import subprocess
from pathlib import Path

import pytest

from sliplab.flows.collecting.requests import STORE_LOCK
from sliplab.flows.folder_watch import FolderWatch, is_written, watch
from sliplab.protocols.errors import InputError
from sliplab.storage.errors import StoreError
from sliplab.storage.trials.lock import exclusive
from sliplab.storage.trials.store import TrialStore
from tests.command_line import SLIPLAB, here
from tests.conftest import ROOT
from tests.storage.formats.files import lab_hdf5


class _Clock:
    now = 0.0

    def __call__(self) -> float:
        self.now += 10.0
        return self.now


def _watched(tmp_path: Path) -> FolderWatch:
    (tmp_path / "in").mkdir(exist_ok=True)
    return FolderWatch(tmp_path / "in", tmp_path / "store", "habit", clock=_Clock())


def test_files_are_imported_once_they_have_settled(tmp_path: Path) -> None:
    watched = _watched(tmp_path)
    lab_hdf5(tmp_path / "in" / "a.h5")
    watched.look()
    assert watched.imported == []
    watched.look()
    assert watched.imported == ["a"]
    lab_hdf5(tmp_path / "in" / "b.h5")
    watched.look()
    watched.look()
    assert watched.imported == ["a", "b"]


def test_a_file_open_for_writing_waits(tmp_path: Path) -> None:
    watched = _watched(tmp_path)
    lab_hdf5(path := tmp_path / "in" / "a.h5")
    with path.open("ab"):
        assert is_written(path)
        assert is_written(path.parent)
        watched.look()
        watched.look()
        assert watched.imported == []
    with path.open("rb"):
        assert not is_written(path)
        watched.look()
    assert watched.imported == ["a"]


def test_a_broken_file_is_named_once_and_tried_again_when_it_changes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    watched = _watched(tmp_path)
    lab_hdf5(path := tmp_path / "in" / "a.h5")
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    lab_hdf5(tmp_path / "in" / "b.h5")
    (tmp_path / "in" / "notes.txt").write_text("good grip\n")
    for _ in range(4):
        watched.look()
    said = capsys.readouterr().err
    assert said.count("not imported: a.h5") == 1
    assert said.count("skipped: notes.txt") == 1
    assert watched.imported == ["b"]
    assert list(watched.failed) == ["a.h5"]
    path.write_bytes(whole)
    for _ in range(2):
        watched.look()
    assert watched.imported == ["b", "a"]
    assert watched.failed == {}


def test_a_restart_skips_what_is_there(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    lab_hdf5(tmp_path / "in" / "a.h5")
    for expected in (["a"], []):
        watched = _watched(tmp_path)
        for _ in range(3):
            watched.look()
        assert watched.imported == expected
    assert TrialStore.open(tmp_path / "store").campaign("habit").committed() == {"a"}


def test_another_writer_of_the_store_delays_the_import(tmp_path: Path) -> None:
    watched = _watched(tmp_path)
    lab_hdf5(tmp_path / "in" / "a.h5")
    store = TrialStore.create(tmp_path / "store")
    watched.look()
    with exclusive(store.folder / STORE_LOCK, "the store"):
        watched.look()
    assert watched.imported == []
    watched.look()
    assert watched.imported == ["a"]


def test_two_files_of_one_name_are_refused(tmp_path: Path) -> None:
    watched = _watched(tmp_path)
    lab_hdf5(tmp_path / "in" / "a.h5")
    lab_hdf5(tmp_path / "in" / "a.hdf5")
    for _ in range(2):
        watched.look()
    assert watched.imported == []
    assert "holds 2 files for the trial a" in next(iter(watched.failed.values()))


def test_wrong_arguments(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="must be a folder"):
        watch(tmp_path / "none", tmp_path / "store", "a", None)
    with pytest.raises(InputError, match="its own files would be imported"):
        watch(tmp_path, tmp_path / "store", "a", None)
    (tmp_path / "in").mkdir()
    with pytest.raises(StoreError, match="cannot be the name"):
        watch(tmp_path / "in", tmp_path / "store", "../a", None)
    done = here(
        "import", tmp_path, "--store", tmp_path / "s", "--name", "a", "--watch", "--dry-run"
    )
    assert done.returncode == 2
    assert "--watch: cannot be given with" in done.stderr


def test_ctrl_c_ends_with_what_was_imported(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    lab_hdf5(tmp_path / "in" / "a.h5")
    command = ["import", tmp_path / "in", "--store", tmp_path / "store", "--name", "habit"]
    with subprocess.Popen(
        [*SLIPLAB, *map(str, command), "--watch", "--json"],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stderr is not None
        for line in process.stderr:
            if line.startswith("imported: a"):
                process.send_signal(signal.SIGINT)
                break
        out, said = process.communicate(timeout=60)
    assert process.returncode == 0, said
    assert json.loads(out)["imported"] == ["a"]
