"""Ctrl-C at exact places of a collection: what was recorded completely is committed."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from sliplab.flows.planning.run_request import RunRequest
from sliplab.flows.running import stopping
from sliplab.rigs.core.rig import Rig
from sliplab.storage.trials import checksums, store, writer
from sliplab.storage.trials.lock import STORE_LOCK, exclusive
from sliplab.storage.trials.store import Campaign, TrialStore
from sliplab.storage.trials.verify import verify
from sliplab.storage.trials.writer import TrialWriter
from tests.command_line import here
from tests.crash.campaign import NAME, collect, run_request

TRIALS = 3
TIMES = [1, pytest.param(2, marks=pytest.mark.long), 10]


@pytest.fixture
def wanted(tmp_path: Path) -> RunRequest:
    return run_request(tmp_path, TRIALS)


def signal_after(
    patch: pytest.MonkeyPatch, owner: Any, name: str, *, at: int = 1, times: int = 1
) -> None:
    """Send Ctrl-C when a function has returned for the `at`-th time."""
    function, calls = getattr(owner, name), [0]

    def wrapped(*arguments: Any, **options: Any) -> Any:
        result = function(*arguments, **options)
        calls[0] += 1
        for _ in range(times if calls[0] == at else 0):
            os.kill(os.getpid(), signal.SIGINT)
        return result

    patch.setattr(owner, name, wrapped)


def interrupted(wanted: RunRequest) -> Campaign:
    """Collect until the signal; what is left is clean."""
    with pytest.raises(KeyboardInterrupt), stopping.signals():
        collect(wanted)
    assert verify(TrialStore.open(wanted.store)) == []
    return TrialStore.open(wanted.store).campaign(NAME)


@pytest.mark.quick(2)
@pytest.mark.parametrize("times", TIMES)
@pytest.mark.parametrize(
    ("owner", "name", "at"),
    [
        (Rig, "run_trial", 1),
        (TrialWriter, "seal", 1),
        (writer, "write_json_aside", 1),
        (writer, "write_json_aside", 2),
        (writer, "write_json_aside", 3),
        (TrialWriter, "_finish_folder", 1),
        (writer, "make_visible", 1),
        (TrialWriter, "commit", 1),
    ],
)
def test_signal_in_commit_keeps_the_trial(
    owner: Any, name: str, at: int, times: int, wanted: RunRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    signal_after(monkeypatch, owner, name, at=at, times=times)
    campaign = interrupted(wanted)
    assert len(campaign.committed()) + len(campaign.failed_attempts()) == 1
    assert all(str(item["cause"]).startswith("gate") for item in campaign.quarantined())


@pytest.mark.parametrize("times", TIMES)
def test_signal_in_begin_leaves_no_open_trial(
    times: int, wanted: RunRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    signal_after(monkeypatch, Campaign, "begin", times=times)
    monkeypatch.setattr(Rig, "run_trial", lambda *_: pytest.fail("the arm was moved"))
    campaign = interrupted(wanted)
    assert campaign.committed() == set()
    assert list((campaign.folder / "incoming").iterdir()) == []


def test_second_signal_in_the_clean_up_leaves_no_open_trial(
    wanted: RunRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    signal_after(monkeypatch, Rig, "start_streams")
    signal_after(monkeypatch, TrialWriter, "abandon")
    campaign = interrupted(wanted)
    assert [item["cause"] for item in campaign.quarantined()] == ["stopped by a person"]


@pytest.mark.parametrize(
    ("owner", "name"), [(store, "write_bytes"), (checksums, "sha256"), (store, "make_folder")]
)
@pytest.mark.parametrize("at", [1, 2, 3])
def test_signal_in_campaign_files_leaves_them_whole(
    owner: Any, name: str, at: int, wanted: RunRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    signal_after(monkeypatch, owner, name, at=at)
    interrupted(wanted)


def test_signal_in_a_motion_stops_it_at_once(
    wanted: RunRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    moved: list[str] = []
    stop: Callable[..., None] = Rig.stop_streams
    monkeypatch.setattr(Rig, "stop_streams", lambda *_: [moved.append("on"), stop(*_)])
    signal_after(monkeypatch, Rig, "start_streams")
    interrupted(wanted)
    assert moved == []


def test_disk_full_in_commit_leaves_a_complete_trial_to_the_next_session(
    wanted: RunRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(writer, "finish_folder", full)
        with pytest.raises(Exception, match="disk"):
            collect(wanted)
    folder = wanted.store / "campaigns" / NAME / "incoming"
    (left,) = folder.iterdir()
    before = (left / "data.h5").stat().st_ino
    collect(wanted)
    assert list(folder.iterdir()) == []
    kept = [*folder.parent.glob("trials/*/data.h5"), *folder.parent.glob("quarantine/*/data.h5")]
    assert before in {path.stat().st_ino for path in kept}


def test_verify_names_the_trial_that_is_being_recorded(
    wanted: RunRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[Any] = []
    original = Rig.run_trial

    def run_trial(*arguments: Any, **options: Any) -> Any:
        seen.append((verify(TrialStore.open(wanted.store)), here("verify", wanted.store)))
        return original(*arguments, **options)

    monkeypatch.setattr(Rig, "run_trial", run_trial)
    collect(wanted)
    ((problem,), done), *_ = seen
    assert problem.kind == "recording"
    assert f"is being recorded by pid {os.getpid()}" in problem.what
    assert done.returncode == 0
    assert "is being recorded" in done.stderr
    assert verify(TrialStore.open(wanted.store)) == []


def test_verify_counts_an_unfinished_trial_as_no_damage(wanted: RunRequest) -> None:
    collect(wanted)
    folder = wanted.store / "campaigns" / NAME
    left = folder / "incoming" / "open"
    left.mkdir()
    done = here("verify", wanted.store)
    assert (done.returncode, done.stdout.strip()) == (0, f"{TRIALS} trials, all intact")
    assert f"{left}: is an unfinished trial" in done.stderr
    with exclusive(wanted.store / STORE_LOCK, "the store", about={"collects": "another"}):
        assert [item.kind for item in verify(TrialStore.open(wanted.store))] == ["unfinished"]
    next(folder.glob("trials/*/data.h5")).write_bytes(b"")
    assert here("verify", wanted.store).returncode == 1
