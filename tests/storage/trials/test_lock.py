"""Locks: freed when their holder is killed, and refused on file systems that keep none."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import signal
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from sliplab.rigs.core.capabilities import RigError
from sliplab.rigs.rig_file import load_rig_file
from sliplab.rigs.rig_lock import ENVIRONMENT, held
from sliplab.storage import process
from sliplab.storage.errors import StoreError
from sliplab.storage.trials import lock
from sliplab.storage.trials.lock import STORE_LOCK, Locked, NoLocks, exclusive
from sliplab.storage.trials.store import TrialStore
from tests.command_line import here
from tests.conftest import ROOT
from tests.storage.holders import holder_of

REFUSED = [errno.ENOLCK, errno.ENOTSUP, errno.ENOSYS, errno.EINVAL]
SILENT = 0
"""No error either: `flock` succeeds and locks nothing, as on some network mounts."""


def without_locks(monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    """Replace `flock` by that of a file system without locks."""

    def flock(handle: int, how: int) -> None:
        if number != SILENT:
            raise OSError(number, os.strerror(number))

    monkeypatch.setattr(fcntl, "flock", flock)


@pytest.mark.parametrize("number", [SILENT, *REFUSED])
def test_a_file_system_without_locks_is_refused(
    number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    without_locks(monkeypatch, number)
    said = f"{tmp_path}: its file system does not support file locks .*: put the store on one that"
    with pytest.raises(NoLocks, match=said), exclusive(tmp_path / ".lock", "the store"):
        raise AssertionError("nobody else was kept out")
    assert issubclass(NoLocks, StoreError)


@pytest.mark.parametrize("number", [SILENT, errno.ENOLCK])
def test_a_collection_there_takes_no_trial(number: int, tmp_path: Path, monkeypatch: Any) -> None:
    """Two of them would run into each other: the first is refused like the second."""
    without_locks(monkeypatch, number)
    store = tmp_path / "s"
    words = (ROOT / "protocols" / "pilot.yaml", "--rig", "rehearsal", "--store", store)
    done = here("collect", *words, "--trials", 1, "--json")
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    error = json.loads(done.stdout)["error"]
    assert error["file"] == str(store)
    assert "does not support file locks" in error["message"]
    assert not list(store.glob("campaigns/*/trials/*"))
    assert not list(store.glob("campaigns/*/incoming/*"))
    for command in ("migrate", "stop"):
        done = here(command, store)
        assert (done.returncode, "does not support file locks" in done.stderr) == (1, True)
    assert here("trials", store).returncode == 0  # readers need no lock


@pytest.mark.parametrize("number", [SILENT, *REFUSED])
def test_a_rig_is_not_driven_without_a_lock(number: int, tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setenv(ENVIRONMENT, str(tmp_path / "locks"))
    without_locks(monkeypatch, number)
    file, _ = load_rig_file(Path("ur5"))
    with pytest.raises(RigError, match=f"cannot be locked .* {ENVIRONMENT}"), held(file):
        raise AssertionError("driven")


def test_a_failing_disk_is_not_taken_for_one_without_locks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    without_locks(monkeypatch, errno.EIO)
    with pytest.raises(OSError, match="Input/output error"), exclusive(tmp_path / "l", "it"):
        raise AssertionError("held")


MOUNTS = "36 25 {} / /mnt/share rw,relatime shared:1 - {} anna@nas:/data rw,{}\n"


@pytest.mark.parametrize(
    ("kind", "options", "alone"),
    [
        ("fuse.sshfs", "user_id=0", True),
        ("9p", "trans=virtio", True),
        ("nfs", "vers=3,local_lock=flock", True),
        ("nfs4", "vers=4.2,local_lock=none", False),
        ("cifs", "vers=3.1.1,nobrl", True),
        ("cifs", "vers=3.1.1", False),
        ("fuseblk", "user_id=0", False),
        ("ext4", "discard", False),
    ],
)
def test_locks_that_other_machines_do_not_see(
    kind: str, options: str, alone: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A holder on another machine is known by its note alone; one of this machine is gone."""
    path = tmp_path / STORE_LOCK
    device = tmp_path.stat().st_dev
    mounts = tmp_path / "mounts"
    mounts.write_text(MOUNTS.format(f"{os.major(device)}:{os.minor(device)}", kind, options))
    monkeypatch.setattr(lock, "MOUNTS", mounts)
    note = {"pid": 12, "host": "elsewhere", "user": "anna", "boot": "another"}
    path.write_text(json.dumps(note))
    if not alone:
        with exclusive(path, "the store"):
            pass
        return
    with (
        pytest.raises(Locked, match=f"pid 12 of anna on elsewhere.*{kind}.*delete {path}") as found,
        exclusive(path, "the store"),
    ):
        raise AssertionError("two holders")
    assert found.value.holder == note
    path.write_text(json.dumps({**note, "host": lock.this_process()["host"]}))  # before a reboot
    with exclusive(path, "the store"):
        pass
    path.unlink()
    with exclusive(path, "the store"):
        pass


def test_a_store_on_such_a_share_says_whose_it_is(tmp_path: Path, monkeypatch: Any) -> None:
    store = TrialStore.create(tmp_path / "s")
    monkeypatch.setattr(lock, "_alone", lambda _: "fuse.sshfs")
    (store.folder / STORE_LOCK).write_text(json.dumps({"pid": 12, "host": "nas", "boot": "b"}))
    done = here("migrate", store.folder)
    assert done.returncode == 1
    assert "pid 12 on nas" in done.stderr


HOLDER = """
import sys
from pathlib import Path
from sliplab.storage.trials.lock import exclusive
with exclusive(Path(sys.argv[1]), "the rig", about={"store": "somewhere"}):
    print("held", flush=True)
    sys.stdin.read()
"""


def test_a_lock_of_a_killed_holder_is_free_and_a_live_one_is_named(tmp_path: Path) -> None:
    path = tmp_path / "lock"
    with holder_of(HOLDER, path) as holder:
        with pytest.raises(Locked) as refused, exclusive(path, "the rig"):
            pass
        who = refused.value.holder
        assert who["pid"] == holder.pid
        said = f"is in use by another program (pid {holder.pid} of {process.user_name()} on "
        assert f"the rig {said}" in str(refused)
        assert "for the store somewhere, since 20" in str(refused.value)
        assert process.is_here(who)
        # another start with this number is another process, and gets no signal
        assert not process.send({**who, "ticks": who["ticks"] + 1}, signal.SIGTERM)
        assert not process.send({**who, "boot": "another"}, signal.SIGTERM)
        assert holder.poll() is None
        assert process.send(who, signal.SIGKILL)
        assert holder.wait(timeout=60) == -signal.SIGKILL
    assert not process.is_here(who)
    assert not process.send(who, signal.SIGTERM)
    with exclusive(path, "the rig"):
        assert json.loads(path.read_text())["pid"] == os.getpid()
    assert path.read_text() == ""


def test_who_is_done_at_once_is_waited_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sliplab.storage.trials.lock.PATIENCE_S", 0.2)
    path = tmp_path / "lock"
    with (
        exclusive(path, "it", brief=True),
        pytest.raises(Locked, match="it is in use"),
        exclusive(path, "it"),
    ):
        pass
    with ThreadPoolExecutor(1) as pool:
        monkeypatch.setattr("sliplab.storage.trials.lock.PATIENCE_S", 60.0)
        with exclusive(path, "it", brief=True):

            def second() -> str:
                with exclusive(path, "it"):
                    return "held"

            waiting = pool.submit(second)
        assert waiting.result(timeout=60) == "held"
