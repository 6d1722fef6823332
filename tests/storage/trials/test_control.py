"""Requests from other terminals: whole files, in order, answered once."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from sliplab.storage import process
from sliplab.storage.trials import control
from sliplab.storage.trials.lock import Locked, exclusive
from sliplab.storage.trials.store import Store
from tests.conftest import ROOT


def test_requests_keep_who_when_why_and_their_order(tmp_path: Path) -> None:
    store = Store.create(tmp_path / "s")
    assert control.requests(store) == []
    assert control.paused(store) is None
    first = control.ask(store, "pause", who="anna", why="lunch")
    assert control.paused(store) == first
    second = control.ask(store, "skip", campaign="tiny", trials=("a", "b"))
    assert control.requests(store) == [first, second]
    assert (second.number, second.who) == (2, process.user_name())
    control.ask(store, "resume")
    assert control.paused(store) is None
    assert control.answer(store, first, {"paused": True})["did"] == {"paused": True}
    assert control.answer(store, first, {"paused": False})["did"] == {"paused": True}
    assert [item.kind for item in control.open_requests(store)] == ["skip", "resume"]
    assert [item.kind for item in control.requests(store, after=2)] == ["resume"]


def test_two_who_ask_at_once_are_both_heard(tmp_path: Path) -> None:
    store = Store.create(tmp_path / "s")
    with ThreadPoolExecutor(8) as pool:
        made = list(pool.map(lambda n: control.ask(store, "skip", why=str(n)), range(40)))
    assert sorted(item.number for item in made) == list(range(1, 41))
    assert {item.why for item in control.requests(store)} == {str(n) for n in range(40)}


def test_what_is_no_request_is_passed_over(tmp_path: Path) -> None:
    store = Store.create(tmp_path / "s")
    made = control.ask(store, "pause")
    folder = store.folder / control.FOLDER
    for name, text in (
        ("000002.json", "{"), ("000003.json", "[]"), ("000004.json", '{"kind": "dance"}'),
        ("000005.json", json.dumps({"kind": "dance", "who": "x", "when": "y"})), ("note.txt", "x"),
    ):  # fmt: skip
        (folder / name).write_text(text)
    assert control.requests(store) == [made]
    assert control.ask(store, "resume").number == 6


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
    holder = subprocess.Popen(
        [sys.executable, "-c", HOLDER, path], cwd=ROOT, text=True,
        stdin=subprocess.PIPE, stdout=subprocess.PIPE,
    )  # fmt: skip
    assert holder.stdout is not None
    assert holder.stdin is not None
    try:
        assert holder.stdout.readline() == "held\n"
        with pytest.raises(Locked) as refused, exclusive(path, "the rig"):
            pass
        who = refused.value.holder
        assert who["pid"] == holder.pid
        assert (
            f"the rig is in use by another program (pid {holder.pid} of {process.user_name()} on "
            in str(refused)
        )
        assert "for the store somewhere, since 20" in str(refused.value)
        assert process.is_here(who)
        # another start with this number is another process, and gets no signal
        assert not process.send({**who, "ticks": who["ticks"] + 1}, signal.SIGTERM)
        assert not process.send({**who, "boot": "another"}, signal.SIGTERM)
        assert holder.poll() is None
        assert process.send(who, signal.SIGKILL)
        assert holder.wait(timeout=60) == -signal.SIGKILL
    finally:
        holder.kill()
        holder.wait(timeout=60)
        holder.stdin.close()
        holder.stdout.close()
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
