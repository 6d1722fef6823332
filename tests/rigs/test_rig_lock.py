"""One program at a time at a real rig, and none kept from a simulated one."""

from __future__ import annotations

import json
import os
import socket
import stat
import threading
from pathlib import Path

import pytest

from sliplab.rigs.core.capabilities import RigError
from sliplab.rigs.core.network import addresses, arm_lock
from sliplab.rigs.rig_file import RigFile, load_rig_file
from sliplab.rigs.rig_lock import ENVIRONMENT, held, lock_names
from sliplab.storage.trials.lock import Locked
from tests.conftest import ROOT
from tests.storage.holders import holder_of

HOLDER = """
import sys
from pathlib import Path
from sliplab.rigs.rig_file import load_rig_file
from sliplab.rigs.rig_lock import held
with held(load_rig_file(Path("ur5"))[0], Path("/data/study")):
    print("held", flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the folder of the locks during the test."""
    monkeypatch.setenv(ENVIRONMENT, str(tmp_path / "locks"))
    return tmp_path / "locks"


def real() -> RigFile:
    return load_rig_file(Path("ur5"))[0]


def with_port(file: RigFile, host: str, port: str) -> RigFile:
    """The same rig with another arm and sync box."""
    box = file.devices.sync_box.model_copy(update={"port": port})
    arm = file.devices.arm.model_copy(update={"host": host})
    devices = file.devices.model_copy(update={"arm": arm, "sync_box": box})
    return file.model_copy(update={"devices": devices})


def test_simulated_rigs_need_none(folder: Path) -> None:
    for name in ("mock", "rehearsal", "loopback"):
        file = load_rig_file(Path(name))[0]
        assert lock_names(file) == {}
        with held(file), held(file):
            pass
    assert not folder.exists()


def test_who_is_refused_is_told_who_holds_the_rig_until_it_dies(folder: Path) -> None:
    with holder_of(HOLDER, env={**os.environ, "PYTHONPATH": str(ROOT)}) as holder:
        with pytest.raises(Locked) as refused, held(real()):
            pass
        for part in (
            "the arm at 192.168.1.10 (rig ur5) is in use by another program ",
            f"(pid {holder.pid} of ",
            "`sliplab",
            "for the store /data/study, since 20",
        ):
            assert part in str(refused.value)
    with held(real()):
        pass


def test_an_arm_or_a_box_that_two_rig_files_share_is_one(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "ttyBOX").touch()
    (tmp_path / "by-id").symlink_to(tmp_path / "ttyBOX")
    file = with_port(real(), "UR.lab", str(tmp_path / "ttyBOX"))
    with held(file):
        with pytest.raises(Locked, match=r"the arm at ur\.lab"):
            held(with_port(file, "ur.LAB", "/dev/other")).__enter__()
        with pytest.raises(Locked, match=r"the sync box at .*ttyBOX"):
            held(with_port(file, "other", str(tmp_path / "by-id"))).__enter__()
        with held(with_port(file, "other", "/dev/other")):
            pass
    assert stat.S_IMODE(folder.stat().st_mode) == 0o1777  # every user may lock, none may unlink
    assert {stat.S_IMODE(path.stat().st_mode) for path in folder.iterdir()} == {0o666}


def test_an_arm_by_another_of_its_names_is_the_same(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    by_name = with_port(real(), "localhost", "/dev/ttyA")
    by_address = with_port(real(), "127.0.0.1", "/dev/ttyB")
    for first, second in ((by_name, by_address), (by_address, by_name)):
        with held(first), pytest.raises(Locked, match="the arm at "):
            held(second).__enter__()

    def unknown(*given: object, **more: object) -> None:
        raise socket.gaierror("no such host")

    monkeypatch.setattr(socket, "getaddrinfo", unknown)
    assert list(arm_lock(by_name.devices.arm)) == ["arm-localhost"]
    monkeypatch.setattr(socket, "getaddrinfo", lambda *given, **more: threading.Event().wait())
    assert addresses("localhost", 0.05) == []


def test_a_folder_that_is_none_is_said(folder: Path) -> None:
    folder.write_text("")
    with pytest.raises(RigError, match=f"cannot be locked .* {ENVIRONMENT}"):
        held(real()).__enter__()


@pytest.mark.parametrize("kind", ["link", "hard link", "pipe", "folder"])
def test_what_is_put_in_place_of_a_lock_is_not_written_to(
    folder: Path, tmp_path: Path, kind: str
) -> None:
    (tmp_path / "precious").write_text("thesis")
    with held(real()):
        pass
    for path in folder.iterdir():
        path.unlink()
        if kind == "link":
            path.symlink_to(tmp_path / "precious")
        elif kind == "hard link":
            path.hardlink_to(tmp_path / "precious")
        elif kind == "pipe":
            os.mkfifo(path)
        else:
            path.mkdir()
    with pytest.raises(RigError, match="cannot be locked"):
        held(real()).__enter__()
    assert (tmp_path / "precious").read_text() == "thesis"


def test_a_folder_whose_locks_anybody_may_delete_is_refused(folder: Path) -> None:
    folder.mkdir()
    folder.chmod(0o777)
    with pytest.raises(RigError, match=r"every user may delete the locks in it"):
        held(real()).__enter__()
    folder.chmod(0o1777)
    with held(real()):
        pass


def test_a_holders_words_reach_no_terminal_as_commands(folder: Path) -> None:
    with held(real()):
        (arm,) = folder.glob("arm-*.lock")
        arm.write_text(json.dumps({"pid": "\x1b]0;owned\x07", "user": ["\n"], "command": "a\x9bb"}))
        with pytest.raises(Locked, match=r"pid \?\]0;owned\?") as error:
            held(real()).__enter__()
    assert str(error.value).isprintable()
