"""Reports of quick tasks to the embedded server, and the origin of its tables."""

from __future__ import annotations

import asyncio
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import httpx
import pytest
from prefect import flow, task
from prefect.cache_policies import NO_CACHE
from prefect.client.orchestration import get_client
from prefect.runtime import flow_run
from prefect.settings import temporary_settings

from benchmarks.orchestration import _drained
from sliplab.flows.running import embedded_server, orchestration
from sliplab.flows.running.orchestration import (
    BEGIN_S,
    END_S,
    LOST_S,
    ServerLink,
    embedded,
    run,
)

COUNT = 120


@task(name="quick", cache_policy=NO_CACHE, persist_result=False)
def quick(number: int) -> int:
    """One of many."""
    if number == COUNT - 1:
        raise ValueError("the last one fails")
    return number


@flow(name="many", validate_parameters=False, persist_result=False)
def many(reported: list[str]) -> None:
    """Many quick tasks, of which the last fails."""
    reported.append(str(flow_run.id))
    for number in range(COUNT):
        quick(number)


def test_every_quick_task_run_is_kept_with_its_end() -> None:
    reported: list[str] = []
    with pytest.raises(ValueError, match="the last one fails"):
        run(many, reported)
    _drained(reported[0], COUNT)
    found: list[dict[str, Any]] = []
    for offset in (0, 100):
        wanted = {"flow_runs": {"id": {"any_": reported}}, "limit": 100, "offset": offset}
        with temporary_settings(embedded().settings()), get_client(sync_client=True) as client:
            found += client.request("POST", "/task_runs/filter", json=wanted).json()
    assert len(found) == COUNT
    assert {each["run_count"] for each in found} == {1}
    assert all(each["start_time"] <= each["end_time"] for each in found)
    states = [each["state_type"] for each in found]
    assert (states.count("COMPLETED"), states.count("FAILED")) == (COUNT - 1, 1)


def test_a_lost_server_gets_one_limited_request_tried_twice(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(orchestration, "_lost_servers", set())
    monkeypatch.setattr(orchestration, "_link", None)
    answers, limits = [200, 503, 200, 500, 500], []

    def answer(request: httpx.Request) -> httpx.Response:
        limits.append(request.extensions["timeout"]["read"])
        return httpx.Response(answers.pop(0))

    link = ServerLink("http://lab")
    hooks: dict[str, list[Any]] = {"request": [link._before], "response": [link._after]}
    with httpx.Client(transport=httpx.MockTransport(answer), event_hooks=hooks) as client:
        begin, end = (client.build_request("POST", f"http://lab/{name}") for name in ("b", "e"))
        assert client.send(begin).status_code == 200
        assert client.send(end).status_code == 503  # SQLite is busy: Prefect's client tries again
        assert client.send(end).status_code == 200
        link.ending = True
        assert [client.send(begin).status_code, client.send(begin).status_code] == [500, 500]
        with pytest.raises(orchestration._NotSent):  # "failed" must not follow a lost "completed"
            client.send(end)
    assert limits == [BEGIN_S, BEGIN_S, LOST_S, END_S, LOST_S]
    assert not orchestration.is_unreachable()
    link.mark_lost("nothing came")
    link.mark_lost("nothing came")
    assert orchestration.is_unreachable()


def _tables(path: Path) -> set[str]:
    with closing(sqlite3.connect(path)) as file:
        return {name for (name,) in file.execute("select name from sqlite_master")}


@pytest.mark.parametrize("kept", ["none", "sound", "damaged", "used"])
def test_a_new_file_begins_as_a_copy_only_of_one_that_is_sound(
    kept: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    made: list[str] = []

    def make() -> None:
        made.append("made")
        _fill(tmp_path / "home" / embedded_server.NAME)

    monkeypatch.setattr(embedded_server, "_make", make)
    (tmp_path / "home").mkdir()
    template = embedded_server._template()
    template.parent.mkdir(parents=True)
    if kept == "damaged":
        template.write_bytes(b"not a database at all" * 1000)
    elif kept != "none":
        _fill(template, runs=kept == "used")
    embedded_server.prepare_database(tmp_path / "home")
    assert made == ([] if kept == "sound" else ["made"])
    assert _tables(tmp_path / "home" / embedded_server.NAME) >= {"flow_run", "task_run"}
    assert embedded_server._sound(template)  # the next one begins with it
    embedded_server.prepare_database(tmp_path / "home")  # which is there now
    assert made == ([] if kept == "sound" else ["made"])


def _fill(path: Path, runs: bool = False) -> None:
    with closing(sqlite3.connect(path)) as file, file:
        for name in ("alembic_version", "flow_run", "task_run"):
            file.execute(f"create table {name} (id text)")
        file.execute("insert into alembic_version values ('1')")
        if runs:
            file.execute("insert into flow_run values ('1')")


@pytest.mark.parametrize(("error", "shown"), [(ValueError("a fault"), 1), (None, 0)])
def test_a_cancelled_poll_is_no_fault(
    error: Exception | None,
    shown: int,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Prefect's watch of a served run ends so while the server does not answer."""
    monkeypatch.setattr(orchestration, "_store", None)
    monkeypatch.setenv("PREFECT_HOME", str(tmp_path))
    orchestration.configure_prefect(tmp_path)

    async def poll() -> None:
        if error is not None:
            raise error
        await asyncio.get_running_loop().create_future()

    async def watch() -> None:
        task = asyncio.ensure_future(poll())
        task.add_done_callback(lambda done: done.result())
        await asyncio.wait([task], timeout=0.01)
        task.cancel()
        await asyncio.wait([task])
        turn = asyncio.get_running_loop().create_future()  # the callback runs in this turn
        asyncio.get_running_loop().call_soon(turn.set_result, None)
        await turn

    asyncio.run(watch())
    assert [record.name for record in caplog.records if record.exc_info] == ["asyncio"] * shown
