"""What killed programs leave is deleted by the next one, and by nothing that may be wrong."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from sliplab.flows.imports import import_data
from sliplab.plugins.publish.publication import staged
from sliplab.storage import files
from sliplab.storage.files import replacing, scratch_folder, temporary_path, write_bytes, write_text
from sliplab.storage.remote.objects import Remote
from sliplab.storage.remote.push import push
from sliplab.storage.trials.store import TrialStore
from sliplab.storage.trials.verify import verify
from tests.storage.formats.recordings import write_dsec
from tests.storage.trial_files import campaign, commit, fill

KILLED = """
import os, signal, sys
from pathlib import Path
from sliplab.storage import files
path = Path(sys.argv[2])
def die():
    os.kill(os.getpid(), signal.SIGKILL)
def blocks():
    yield b"x"
    die()
if sys.argv[1] == "file":
    files.write_blocks(path, blocks())
elif sys.argv[1] == "folder":
    with files.replacing(path) as made:
        (made / "deep").mkdir(parents=True)
        (made / "deep" / "x").write_bytes(b"x")
        die()
elif sys.argv[1] == "scratch":
    with files.scratch_folder() as made:
        (made / "x").write_bytes(b"x")
        die()
else:
    from sliplab.storage.remote.objects import Remote
    from sliplab.storage.remote.push import push
    from sliplab.storage.trials.store import Store
    def cut(*names):
        die()
    files.os.replace = cut
    push(Store.open(path), Remote(sys.argv[3]))
"""


@pytest.fixture(autouse=True)
def new_program(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing was swept yet."""
    monkeypatch.setattr(files, "_SWEPT", set())


def killed(*arguments: str | Path, temporary: Path | None = None) -> int:
    """Run a program that is killed while it writes; its number."""
    environment = os.environ if temporary is None else {**os.environ, "TMPDIR": str(temporary)}
    with subprocess.Popen(
        [sys.executable, "-c", KILLED, *map(str, arguments)], env=environment
    ) as program:
        assert program.wait(60) == -9
    return program.pid


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


@pytest.mark.parametrize("kind", ["file", "folder"])
def test_next_write_in_a_folder_sweeps_it(kind: str, tmp_path: Path) -> None:
    pid = killed(kind, tmp_path / "a")
    (left,) = names(tmp_path)
    assert left.startswith(".a.sliplab-")
    assert left.endswith(f".{pid}.tmp")
    write_text(tmp_path / "b", "b")
    assert names(tmp_path) == {"b"}


def test_scratch_folder_of_killed_program_is_deleted(tmp_path: Path, monkeypatch: Any) -> None:
    killed("scratch", "none", temporary=tmp_path)
    (left,) = tmp_path.iterdir()
    assert names(left) == {"x"}
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with scratch_folder() as found:
        assert names(tmp_path) == {found.name}
        assert found.stat().st_mode & 0o777 == 0o700
    assert names(tmp_path) == set()


def test_killed_push_leaves_nothing_after_the_next(tmp_path: Path) -> None:
    where = campaign(tmp_path / "store")
    url = f"file://{tmp_path}/shared"
    for trial in ("t", "u"):  # in an empty place, and in one that this process has written to
        commit(where, trial)
        killed("push", tmp_path / "store", url)
        assert list((tmp_path / "shared").rglob("*.tmp"))
        assert push(TrialStore.open(tmp_path / "store"), Remote(url)).problems == []
        assert not list((tmp_path / "shared").rglob("*.tmp"))


def test_killed_publication_is_deleted_by_the_next(tmp_path: Path) -> None:
    killed("folder", tmp_path / "out")
    with staged(tmp_path / "other") as folder:
        (folder / "a").write_text("a")
        assert names(tmp_path) == {folder.name}
    assert names(tmp_path) == {"other"}
    with pytest.raises(FileNotFoundError), staged(tmp_path / "third") as folder:
        (folder / "none").read_text()
    assert names(tmp_path) == {"other"}


def test_sweep_leaves_what_may_be_of_a_living_program(tmp_path: Path) -> None:
    here = temporary_path(tmp_path / "x").name.split(".")[2]
    alive, dead = os.getppid(), killed("file", tmp_path / "y")
    write_bytes(tmp_path / "y", b"")
    files._SWEPT.clear()
    kept = {
        f".a.{here}.{alive}.tmp",  # of a program that runs
        f".a.{here}.{os.getpid()}.tmp",  # of another thread
        f".a.sliplab-0123abcd.{dead}.tmp",  # of another machine, just written
        f".a.{dead}.tmp",  # of anybody, or of an older version
        f".a.sliplab-xyz.{dead}.tmp",
        f"a.{here}.{dead}.tmp",
        ".a.tmp",
    }
    for name in kept:
        (tmp_path / name).write_text("")
    for name in (f".a.{here}.{dead}.tmp", f".b.sliplab-0123abcd.{alive}.tmp"):
        (tmp_path / name).write_text("")
    old = time.time() - 2 * files._STALE_S
    os.utime(tmp_path / f".b.sliplab-0123abcd.{alive}.tmp", (old, old))
    (tmp_path / f".link.{here}.{dead}.tmp").symlink_to(tmp_path)
    write_text(tmp_path / "b", "b")
    assert names(tmp_path) == {*kept, "b", "y", f".link.{here}.{dead}.tmp"}


def test_sweep_counts_the_age_by_the_clock_of_the_folder(tmp_path: Path, monkeypatch: Any) -> None:
    """The clock of a server may be days behind this machine's."""
    (tmp_path / ".a.sliplab-0123abcd.1.tmp").write_text("")
    here = time.time
    monkeypatch.setattr(time, "time", lambda: here() + 3 * files._STALE_S)
    write_text(tmp_path / "b", "b")
    assert names(tmp_path) == {".a.sliplab-0123abcd.1.tmp", "b"}


def test_sweep_deletes_no_file_of_another_user(tmp_path: Path, monkeypatch: Any) -> None:
    killed("file", tmp_path / "a")
    before = names(tmp_path)
    user = os.getuid() + 1
    monkeypatch.setattr(os, "getuid", lambda: user)
    write_text(tmp_path / "b", "b")
    assert names(tmp_path) == {*before, "b"}


def test_replacing_keeps_the_file_where_the_block_fails(tmp_path: Path) -> None:
    write_text(tmp_path / "a", "old")
    with pytest.raises(FileNotFoundError), replacing(tmp_path / "a") as made:
        made.read_text()
    assert (tmp_path / "a").read_text() == "old"
    with replacing(tmp_path / "a") as made:
        made.write_text("new")
    assert (tmp_path / "a").read_text() == "new"
    assert names(tmp_path) == {"a"}


def test_what_a_killed_import_left_is_cleared_up_by_the_same_import(tmp_path: Path) -> None:
    """No collection looks into an imported campaign, so `verify` must not refer to one."""
    file, store = tmp_path / "one.h5", tmp_path / "s"
    write_dsec(file)
    import_data(file, store, name="theirs")
    file = file.rename(tmp_path / "two.h5")
    theirs = TrialStore.open(store).campaign("theirs")
    writer = theirs.begin("two", None, 100)
    fill(writer)
    writer.abandon()
    (theirs.folder / "checksums.json").unlink()
    by = "the same import, or the next recording,"
    assert [problem.what for problem in verify(TrialStore.open(store))] == [
        f"is missing; {by} writes it",
        f"is an unfinished trial; {by} quarantines it",
    ]
    assert import_data(file, store, name="theirs")["imported"] == ["two"]
    assert verify(TrialStore.open(store)) == []
