"""Requests from other terminals: complete, in order, answered once; nothing is deleted by them."""

from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from sliplab.storage import process
from sliplab.storage.files import read_json
from sliplab.storage.trials import control
from sliplab.storage.trials.control import SKIPPED, again, skip, skipped
from sliplab.storage.trials.store import Campaign, StoreError, TrialStore
from sliplab.storage.trials.verify import verify
from tests.storage.trial_files import commit, fail


def test_requests_keep_who_when_why_and_their_order(tmp_path: Path) -> None:
    store = TrialStore.create(tmp_path / "s")
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


def test_two_who_ask_at_once_are_both_heard(tmp_path: Path) -> None:
    store = TrialStore.create(tmp_path / "s")
    with ThreadPoolExecutor(8) as pool:
        made = list(pool.map(lambda n: control.ask(store, "skip", why=str(n)), range(40)))
    assert sorted(item.number for item in made) == list(range(1, 41))
    assert {item.why for item in control.requests(store)} == {str(n) for n in range(40)}


def test_what_is_no_request_is_passed_over(tmp_path: Path) -> None:
    store = TrialStore.create(tmp_path / "s")
    made = control.ask(store, "pause")
    folder = store.folder / control.FOLDER
    for name, text in (
        ("000002.json", "{"),
        ("000003.json", "[]"),
        ("000004.json", '{"kind": "dance"}'),
        ("000005.json", json.dumps({"kind": "dance", "who": "x", "when": "y"})),
        ("note.txt", "x"),
    ):
        (folder / name).write_text(text)
    assert control.requests(store) == [made]
    assert control.ask(store, "resume").number == 6


BY = {"who": "anna", "when": "2026-01-02T03:04:05+00:00", "why": "skin was dirty"}


def test_a_committed_trial_that_is_wanted_again_is_kept_aside(where: Any, tmp_path: Path) -> None:
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
    assert verify(TrialStore.open(tmp_path / "s")) == []


def test_failed_attempts_are_forgiven_once_and_stay(where: Campaign) -> None:
    for attempt in range(2):
        fail(where, "t", attempt)
    assert again(where, ["t"], BY) == {
        "t": "2 failed attempts count no longer; will be taken again"
    }
    assert (where.failed_attempts(), where.attempts()) == ({}, {"t": 2})
    assert [item["cause"] for item in where.quarantined()] == ["gate: frames_lost = 3"] * 2
    assert all(item["forgiven"] == BY for item in where.quarantined())


def test_skipping_and_thinking_better_of_it(where: Campaign) -> None:
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
