"""A stop that comes while a run starts or waits: no signal can reach it, and it must not move."""

from __future__ import annotations

import errno
import json
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from sliplab.flows.collect import collect
from sliplab.flows.collecting import requests, session
from sliplab.flows.collecting.live_feed import WAITING, LiveFolder
from sliplab.flows.planning.run_request import RunRequest
from sliplab.flows.running import run_records, stopping
from sliplab.storage.process import this_process
from sliplab.storage.trials import control, journal, lock
from sliplab.storage.trials.store import Campaign, TrialStore
from tests.crash import campaign as crash
from tests.storage.holders import holder_of


@pytest.fixture(autouse=True)
def unrequested() -> Iterator[None]:
    """Leave no stop to the tests that follow in this process."""
    yield
    stopping._requested.clear()


COLLECTION = """
import sys
from pathlib import Path
from sliplab.storage.trials.lock import exclusive
with exclusive(Path(sys.argv[1]), "the store", about={"collects": "tiny"}):
    print("held", flush=True)
    sys.stdin.read()
"""


def taken(store: TrialStore) -> int:
    return len(store.campaign(crash.NAME).committed())


def test_a_run_that_is_stopped_while_it_starts_moves_nothing(tmp_path: Path) -> None:
    wanted = crash.run_request(tmp_path, 2)
    store = TrialStore.create(wanted.store)
    outcome = requests.stop_collection(store, who="anna")  # answered at once: nothing collects
    assert outcome.answer is not None
    with pytest.raises(KeyboardInterrupt):
        collect(wanted)
    assert taken(store) == 0
    wanted = crash.run_request(tmp_path, 2)
    asked = control.ask(store, "stop")  # and its requester was killed
    with pytest.raises(KeyboardInterrupt):
        collect(wanted)
    assert control.answered(store, asked)["did"] == {"stopped": True, "running": False}
    stopping._requested.clear()
    crash.collect(crash.run_request(tmp_path, 2))  # a later one is not meant
    assert taken(store) == 2


def test_a_stop_that_comes_while_the_store_is_cleaned_up_is_not_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No one held the store when it was to be signalled; by then the run has looked for it."""
    wanted, recover = crash.run_request(tmp_path, 2), session._recover

    def late(store: TrialStore, run_request: RunRequest) -> Campaign:
        control.ask(store, "stop")
        return recover(store, run_request)

    monkeypatch.setattr(session, "_recover", late)
    with pytest.raises(KeyboardInterrupt):
        collect(wanted)
    assert taken(TrialStore.open(wanted.store)) == 0


def test_stop_names_the_runs_that_it_ends(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    store = TrialStore.create(tmp_path / "s")
    for number, flow in enumerate(("collect", "label")):
        run = f"{number}0000000-0000-0000-0000-000000000000"
        run_records.begin(store.folder, run, flow, run_records.EMBEDDED, "lab")
    runs = [
        {"flow": flow, "due": "now", "begun": flow == "collect"} for flow in ("collect", "study")
    ]
    content = {"process": this_process(), "runs": runs}
    LiveFolder(store.folder).write(WAITING, json.dumps(content))  # by the service
    outcome = requests.stop_collection(store)
    assert outcome.holder is None
    named, queued = outcome.answer["did"]["waiting"]
    assert named.startswith("collect of lab, since ")
    assert queued == "study, due now"
    assert "ends before it moves the arm" in capsys.readouterr().err


def test_a_collection_is_stopped_whose_store_cannot_be_written_to(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The signal goes out first; that it could not be logged is said."""
    store = TrialStore.create(tmp_path / "s")

    def read_only(*_: object, **__: object) -> None:
        raise OSError(errno.EROFS, "Read-only file system", str(store.folder))

    with holder_of(COLLECTION, store.folder / ".lock") as process:
        monkeypatch.setattr(lock, "_open", read_only)
        monkeypatch.setattr(journal, "write_new_json", read_only)
        outcome = requests.stop_collection(store, limit_s=20.0)
        assert outcome.answer == {"did": {"stopped": True, "running": True}}
        assert process.wait(timeout=60) == -signal.SIGTERM
    assert "could not be logged: [Errno 30] Read-only file system" in capsys.readouterr().err
    with pytest.raises(OSError, match="Read-only"):  # nothing was signalled
        requests.stop_collection(store)
