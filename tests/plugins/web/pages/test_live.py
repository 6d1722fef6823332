"""The live page: one reader for all viewers, controls with who and why."""

from __future__ import annotations

import asyncio
import json
import os
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
from starlette.testclient import TestClient

from sliplab.flows.collecting.live_feed import STATE, WAITING, LiveFolder
from sliplab.flows.log import log_entries
from sliplab.plugins.web.pages import live
from sliplab.plugins.web.pages.live import Hub, event
from sliplab.plugins.web.pages.web import Web
from sliplab.storage.process import this_process
from sliplab.storage.trials import control
from sliplab.storage.trials.lock import STORE_LOCK, exclusive
from sliplab.storage.trials.store import TrialStore
from tests.plugins.web.pages.opened import ACCESS, csrf, opened


@pytest.fixture
def store(tmp_path: Path) -> TrialStore:
    return TrialStore.create(tmp_path / "store")


def act(found: TestClient, action: str, **fields: str) -> int:
    """Send a form of the page; return the answer's status."""
    answer = found.post(f"/control/{action}", data={"csrf": csrf(found), **fields})
    return answer.status_code


async def first(stream: AsyncIterator[str], kind: str) -> str:
    """The first event of a kind in a stream."""
    async with asyncio.timeout(60):
        async for text in stream:
            if text.startswith(f"event: {kind}\n"):
                return text
    raise AssertionError(f"no {kind}")


def test_one_reader_serves_all_viewers_and_ends_with_the_last(
    store: TrialStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live, "TICK_S", 0.05)
    hub = Hub(Web(store, ACCESS))
    reads = []
    read = hub._reader.read
    monkeypatch.setattr(hub._reader, "read", lambda: reads.append(1) or read())

    async def watch() -> None:
        streams = [hub.stream() for _ in range(3)]
        texts = await asyncio.gather(*(first(stream, "status") for stream in streams))
        assert "No campaign yet" in texts[0]
        assert texts == [texts[0]] * 3
        assert len(reads) == 1
        for stream in streams:
            await stream.aclose()
        assert hub._task is not None
        async with asyncio.timeout(30):
            await hub._task

    asyncio.run(watch())
    assert not hub._viewers


def test_page_says_what_is_wrong_with_the_store(
    store: TrialStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    hub = Hub(Web(store, ACCESS))

    def broken() -> None:
        raise OSError("the disk is away")

    monkeypatch.setattr(hub._reader, "read", broken)

    async def watch() -> str:
        stream = hub.stream()
        try:
            return await first(stream, "problem")
        finally:
            await stream.aclose()

    assert "the disk is away" in asyncio.run(watch())


def test_runs_that_wait_for_their_turn_are_shown(store: TrialStore) -> None:
    due = "2026-11-21T22:00:00+00:00"
    runs = [{"flow": flow, "due": due, "begun": flow == "study"} for flow in ("study", "collect")]
    content = {"process": this_process(), "runs": runs}
    LiveFolder(store.folder).write(WAITING, json.dumps(content))
    shown = Hub(Web(store, ACCESS))._tick(0.0)["status"]
    assert f'Waits for its turn</strong>: collect, due <time datetime="{due}">' in shown
    assert "Has begun, takes no trial now</strong>: study" in shown
    gone = {"process": {**this_process(), "ticks": 1}, "runs": runs}
    LiveFolder(store.folder).write(
        WAITING, json.dumps(gone)
    )  # as a service that was killed left it
    assert "collect" not in Hub(Web(store, ACCESS))._tick(0.0)["status"]


def test_event_keeps_lines() -> None:
    assert event("now", "a\nb") == "event: now\ndata: a\ndata: b\n\n"


def test_pause_and_resume_by_two_people_are_in_the_log(store: TrialStore) -> None:
    anna, ben = opened(store), opened(store)
    assert act(anna, "pause", why="lens dirty") == 422  # without a name
    assert act(anna, "pause", who="Anna", why="lens dirty") == 303
    paused = control.paused(store)
    assert paused is not None
    assert (paused.who, paused.why) == ("Anna", "lens dirty")
    assert "Anna" in anna.get("/").text  # the browser keeps the name
    assert act(ben, "resume", who="Ben") == 303
    assert control.paused(store) is None
    assert [(e.who, e.what, e.text) for e in log_entries(store)] == [
        ("Anna", "pause", "lens dirty"),
        ("Ben", "resume", ""),
    ]


def test_request_to_a_running_collection_does_not_wait(store: TrialStore) -> None:
    with exclusive(store.folder / STORE_LOCK, "the store"):
        assert act(opened(store), "pause", who="Anna") == 303
        assert len(control.open_requests(store)) == 1


def test_stop_needs_no_name_and_is_in_the_log(store: TrialStore) -> None:
    assert act(opened(store), "stop") == 303
    (entry,) = log_entries(store)
    assert (entry.what, entry.who) == ("stop", "the page, operator's link")


def test_start_without_a_service_says_the_command(store: TrialStore) -> None:
    operator = opened(store)
    assert "sliplab collect PROTOCOL" in operator.get("/").text
    assert act(operator, "collect", who="Anna", protocol="pilot.yaml") == 422


def test_schedules_show_next_runs(store: TrialStore, tmp_path: Path) -> None:
    file = tmp_path / "schedules.yaml"
    file.write_text(
        "timezone: Europe/Rome\nschedules:\n  - {name: morning, flow: report, cron: '30 7 * * *'}\n"
    )
    from sliplab.plugins.web.pages.app import application

    found = TestClient(application(Web(store, ACCESS, schedules=file)))
    found.get(f"/enter?token={ACCESS.tokens['reader']}")
    text = found.get("/schedules").text
    assert text.count("07:30 CE") == 5
    file.write_text("timezone: nowhere\nschedules: []\n")
    assert "is not a time zone" in found.get("/schedules").text


def test_killed_collection_is_not_shown_as_running(store: TrialStore) -> None:
    folder = LiveFolder(store.folder)
    folder.watch()
    state = {"trial": "gone", "attempt": 1, "phase": "hold", "number": 1, "campaign": "pilot"}
    state |= {"simulated": True, "rig": "mock", "operator": "", "began": 1.0, "seconds": 9.0}
    (folder.folder / STATE).write_text(json.dumps({**state, "condition": {}, "lines": []}))
    hub = Hub(Web(store, ACCESS))
    with exclusive(store.folder / STORE_LOCK, "the store"):
        assert "gone" in hub._tick(100.0)["now"]
    os.utime(folder.folder / STATE, (1.0, 1.0))
    assert "Nothing runs" in hub._tick(200.0)["now"]
