"""Runs of a service that are killed, or suspended from Prefect's page."""

from __future__ import annotations

import asyncio
import os
import signal
import threading
from collections.abc import AsyncIterator, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from uuid import UUID, uuid4
from zoneinfo import ZoneInfo

import pytest

from sliplab.flows.collecting import requests
from sliplab.flows.collecting.live_feed import LiveFolder
from sliplab.flows.running import stopping
from sliplab.plugins.web.server import runs
from sliplab.plugins.web.server.runs import ServedRuns
from sliplab.plugins.web.server.schedules import Scheduled
from sliplab.plugins.web.server.waiting_runs import drop_unplanned
from sliplab.storage.files import read_json, write_json
from sliplab.storage.remote.objects import LAYOUT_FILE
from sliplab.storage.trials import control
from sliplab.storage.trials.store import TrialStore
from tests.conftest import ROOT
from tests.flows.conftest import tiny, write
from tests.plugins.web.server.serving import Page, processes, serving, until

pytestmark = pytest.mark.programs

RIG = ROOT / "rigs" / "rehearsal.yaml"


def process_of(run: str) -> int:
    """The process that carries out a run; 0 where there is none."""
    return next(iter(processes("sliplab.plugins.web.server.runs", run)), 0)


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    """A service with a push that hangs: its place's marker is a pipe that nobody writes to."""
    folder = tmp_path_factory.mktemp("runs")
    (folder / "remote").mkdir()
    os.mkfifo(folder / "remote" / LAYOUT_FILE)
    nights = folder / "schedules.yaml"  # its folder is one from which protocols may be named
    nights.write_text(
        "timezone: UTC\nschedules:\n"
        f"  - {{name: copy, flow: push, url: 'file://{folder}/remote', cron: '0 0 1 1 *'}}\n"
    )
    TrialStore.create(folder / "store")
    with serving(folder / "store", RIG, "ends", None, folder / "log", nights) as found:
        yield found


def test_a_run_whose_begin_got_no_answer_is_begun(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The server took it, and answered too late: it would stay pending, and its night be lost."""
    from prefect.states import Pending, Scheduled

    run = SimpleNamespace(
        id=uuid4(),
        deployment_id=uuid4(),
        state=Scheduled(),
        run_count=0,
        auto_scheduled=False,
        tags=[],
    )

    class Client:
        async def get_scheduled_flow_runs_for_deployments(self, *of: Any, **to: Any) -> list[Any]:
            return [run] if run.state.is_scheduled() else []

        async def read_flow_run(self, wanted: UUID) -> Any:
            return run

        async def set_flow_run_state(self, wanted: UUID, state: Any) -> None:
            run.state = Pending()
            raise TimeoutError

    begun: list[Any] = []

    async def start(served: ServedRuns, wanted: Any) -> None:
        begun.append(wanted)

    monkeypatch.setattr(ServedRuns, "_start", start)
    served, client, threads = ServedRuns(tmp_path, {run.deployment_id: None}, {}), Client(), None
    with pytest.raises(TimeoutError):
        asyncio.run(served._look(client, threads))
    assert begun == []
    for _ in range(2):
        asyncio.run(served._look(client, threads))
    assert begun == [run]


def test_a_run_in_an_hour_that_the_clocks_leave_out_waits_for_its_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    zone, now = "Europe/Rome", datetime.now(UTC)
    at = next(
        moment
        for hours in range(24 * 366)
        if (moment := now.replace(minute=30, second=0, microsecond=0) + timedelta(hours=hours))
        .astimezone(ZoneInfo(zone))
        .utcoffset()
        < (moment + timedelta(hours=1)).astimezone(ZoneInfo(zone)).utcoffset()
    )
    night = Scheduled(
        name="n", flow="collect", cron="30 2 * * *", timezone=zone, active=True, parameters={}
    )
    run = SimpleNamespace(
        id=uuid4(),
        deployment_id=uuid4(),
        run_count=0,
        auto_scheduled=True,
        parameters={"wanted": {}},
        expected_start_time=at,
    )
    begun: list[Any] = []

    class Client:
        async def get_scheduled_flow_runs_for_deployments(self, *of: Any, **to: Any) -> list[Any]:
            return [run]

    async def begin(served: ServedRuns, client: Any, wanted: Any) -> None:
        begun.append(wanted)

    class Clock(datetime):
        @classmethod
        def now(cls, tz: Any = None) -> datetime:
            return at + later

    monkeypatch.setattr(ServedRuns, "_begin", begin)
    monkeypatch.setattr(runs, "datetime", Clock)
    served, client, threads = (
        ServedRuns(tmp_path, {run.deployment_id: None}, {}, [night]),
        Client(),
        None,
    )
    for minutes, expected in ((1, []), (59, []), (60, [run])):
        later = timedelta(minutes=minutes)
        asyncio.run(served._look(client, threads))
        assert begun == expected


class Queue:
    """Prefect's server, with runs that are due."""

    def __init__(self, *flows: str) -> None:
        self.flows = {uuid4(): SimpleNamespace(name=name) for name in flows}
        self.runs = [self.due(deployment) for deployment in self.flows]
        self.said: dict[UUID, str] = {}

    def due(self, deployment: UUID) -> Any:
        return SimpleNamespace(
            id=uuid4(),
            name="run",
            deployment_id=deployment,
            run_count=0,
            auto_scheduled=False,
            tags=[],
            parameters={},
            created=datetime.now(UTC),
            expected_start_time=datetime.now(UTC),
        )

    async def get_scheduled_flow_runs_for_deployments(self, *of: Any, **to: Any) -> list[Any]:
        return [run for run in self.runs if run.id not in self.said]

    async def read_flow_run(self, run: UUID) -> Any:
        from prefect.states import Running

        return SimpleNamespace(state=Running())

    async def set_flow_run_state(self, run: UUID, state: Any) -> Any:
        self.said[run] = f"{state.type.value}: {state.message}"
        return SimpleNamespace(status=None)

    @asynccontextmanager
    async def opened(self) -> AsyncIterator[Queue]:
        yield self


def waiting(store: TrialStore) -> Any:
    """What the live page is told."""
    return LiveFolder(store.folder).waiting()


def test_a_stop_cancels_what_waits_and_would_move_the_arm(tmp_path: Path) -> None:
    store = TrialStore.create(tmp_path / "s")
    control.ask(store, "stop", who="anna")  # before the service began: means none of its runs
    client, threads = Queue("collect", "study", "label"), None
    served = ServedRuns(store.folder, client.flows, {})
    served._process, served._run = SimpleNamespace(returncode=None), client.runs[0]

    async def supervise(client: Any) -> None:
        pass

    served._supervise = supervise
    client.runs = client.runs[1:]
    asyncio.run(served._look(client, threads))
    assert client.said == {}
    assert [(run["flow"], run["begun"]) for run in waiting(store)] == [
        ("collect", True),
        ("study", False),
    ]
    control.ask(store, "pause")
    control.ask(store, "stop", who="ben", why="smoke")
    control.ask(store, "resume")
    asyncio.run(served._look(client, threads))
    (said,) = client.said.values()
    assert said.startswith("CANCELLED: with the stop by ben, ")
    assert next(iter(client.said)) == client.runs[0].id
    assert [run["flow"] for run in waiting(store)] == ["collect"]
    client.runs.append(client.due(client.runs[0].deployment_id))  # started after the stop
    asyncio.run(served._look(client, threads))
    assert len(client.said) == 1


def test_a_stop_during_a_begin_is_left_to_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It came after the look at the requests: the run's own process finds it."""
    store, client = TrialStore.create(tmp_path / "s"), Queue("collect")
    served, threads = ServedRuns(store.folder, client.flows, {}), None
    last = runs.last_number
    monkeypatch.setattr(runs, "last_number", lambda of: (last(of), control.ask(store, "stop"))[0])
    monkeypatch.setattr(runs, "stop_after", lambda of, number: None)
    asyncio.run(served._look(client, threads))
    assert control.stop_after(store, served._since) is not None


def test_what_waits_ends_with_the_service(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store, client = TrialStore.create(tmp_path / "s"), Queue("collect", "label")
    monkeypatch.setattr("prefect.client.orchestration.get_client", client.opened)
    monkeypatch.setattr(stopping, "request", lambda: None)
    served = ServedRuns(store.folder, client.flows, {})

    async def end() -> None:
        over = asyncio.Event()
        over.set()
        await served.carry_out(0.01, over)

    asyncio.run(end())
    assert client.said == {client.runs[0].id: "CANCELLED: the service ended before it began"}
    assert waiting(store) == []


class Planner(Queue):
    """Prefect's server, with schedules: with one, it deletes the runs that schedules planned."""

    def __init__(self, flow: str, *slugs: str) -> None:
        super().__init__(flow)
        self.slugs = list(slugs)

    async def read_flow_runs(self, *of: Any, offset: int, **to: Any) -> list[Any]:
        return self.runs[offset:]

    async def read_deployment_schedules(self, deployment: UUID) -> list[Any]:
        return [SimpleNamespace(id=slug, slug=slug) for slug in self.slugs]

    async def delete_deployment_schedule(self, deployment: UUID, slug: str) -> None:
        self.slugs.remove(slug)
        self.runs = [run for run in self.runs if not run.auto_scheduled]

    async def create_flow_run_from_deployment(
        self, deployment: UUID, *, parameters: Any, state: Any, tags: list[str]
    ) -> None:
        run = self.due(deployment)
        run.parameters, run.tags = parameters, tags
        run.expected_start_time = state.state_details.scheduled_time
        self.runs.append(run)


def test_a_night_that_has_begun_is_made_again_once() -> None:
    client = Planner("collect", "night", "old", "older")
    (night,) = client.runs
    begin = night.expected_start_time = datetime.now(UTC).replace(second=0, microsecond=0)
    night.auto_scheduled, night.parameters = True, {"wanted": {"trials": 20}}
    item = Scheduled(
        name="night",
        flow="collect",
        cron=f"{begin.minute} {begin.hour} * * *",
        timezone="UTC",
        active=True,
        parameters={"trials": 20},
    )
    asyncio.run(drop_unplanned(client, client.flows, [item]))
    (again,) = client.runs
    assert (again.expected_start_time, again.auto_scheduled) == (begin, False)
    client.slugs.append("oldest")  # another service's, before the next restart
    asyncio.run(drop_unplanned(client, client.flows, [item]))
    assert client.runs == [again]


@pytest.mark.parametrize("error", [OSError(5, "Input/output error"), TimeoutError()])
def test_a_stop_of_the_page_does_not_wait_for_the_disk(
    error: OSError, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing begins meanwhile: whether another person stopped it cannot be read."""
    store, client = TrialStore.create(tmp_path / "s"), Queue("collect", "stop")
    rig, stop = ({run: flow} for run, flow in client.flows.items())
    served, done, begun = ServedRuns(store.folder, rig, stop), list[Any](), list[Any]()
    monkeypatch.setattr(runs, "_carry_out_here", lambda flow, run: done.append(flow.name))

    async def begin(client: Any, run: Any) -> None:
        begun.append(run)

    served._begin = begin

    def unreadable(store: TrialStore) -> int:
        raise error

    with monkeypatch.context() as broken, ThreadPoolExecutor() as threads:
        broken.setattr(runs, "last_number", unreadable)
        asyncio.run(served._look(client, threads))
    assert done == ["stop"]
    with monkeypatch.context() as broken, ThreadPoolExecutor() as threads:
        broken.setattr(runs.run_records, "end_of", lambda store, run: unreadable(store))
        served._process, served._run = SimpleNamespace(returncode=1), client.runs[0]
        with pytest.raises(type(error)):  # the ended run cannot be closed
            asyncio.run(served._look(client, threads))
    assert done == ["stop", "stop"]
    served._process = served._run = None
    assert begun == []
    assert [run["flow"] for run in waiting(store)] == ["collect"]
    client.runs.pop()
    asyncio.run(served._look(client, None))
    assert begun == client.runs


@pytest.mark.parametrize("moment", [True, False])
def test_a_run_that_is_started_after_a_stop_is_begun(moment: bool, tmp_path: Path) -> None:
    """The stop is read late: the server was lost. What had waited is cancelled by any clock."""
    store, client = TrialStore.create(tmp_path / "s"), Queue("collect")
    served, threads, begun = ServedRuns(store.folder, client.flows, {}), None, list[Any]()

    async def begin(client: Any, run: Any) -> None:
        begun.append(run)

    async def supervise(client: Any) -> None:
        pass

    served._begin, served._supervise = begin, supervise
    served._process, served._run = SimpleNamespace(returncode=None), client.runs[0]
    (waited,) = client.runs
    waited.created += timedelta(hours=1)  # the clock was set back
    asyncio.run(served._look(client, threads))
    early = client.due(waited.deployment_id)
    control.ask(store, "stop", who="anna")
    request = control.ask(store, "stop", who="ben")
    stop = datetime.fromisoformat(request.moment)
    if not moment:  # an older version's is told to a second
        path = store.folder / control.FOLDER / "000002.json"
        write_json(path, {**read_json(path), "moment": ""})
        stop = datetime.fromisoformat(request.when) + timedelta(seconds=1)
    between, later, unknown = (client.due(waited.deployment_id) for _ in range(3))
    between.created = stop - timedelta(milliseconds=1)
    later.created, unknown.created = stop + timedelta(milliseconds=1), None
    client.runs += [early, between, later, unknown]
    served._process = None
    asyncio.run(served._look(client, threads))
    assert client.said.keys() == {waited.id, early.id, between.id, unknown.id}
    assert begun == [later]
    assert control.stop_after(store, served._looked) is None


@pytest.mark.parametrize(
    "change", [{"host": "elsewhere"}, {"when": "noon"}, {"when": "2026-01-01T00:00:00"}]
)
def test_a_stop_whose_time_says_little_cancels_all(change: dict[str, str], tmp_path: Path) -> None:
    store, client = TrialStore.create(tmp_path / "s"), Queue("collect")
    served, threads = ServedRuns(store.folder, client.flows, {}), None
    control.ask(store, "stop", who="anna")
    path = store.folder / control.FOLDER / "000001.json"
    write_json(path, {**read_json(path), **change})
    client.runs[0].created += timedelta(hours=1)
    asyncio.run(served._look(client, threads))
    assert len(client.said) == 1


def test_nothing_begins_while_a_stop_of_the_page_is_carried_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its request comes later: a process that begins now would find it, and end itself."""
    store, client = TrialStore.create(tmp_path / "s"), Queue("collect", "stop")
    rig, stop = ({run: flow} for run, flow in client.flows.items())
    served, noted = ServedRuns(store.folder, rig, stop), threading.Event()

    def carry_out(flow: Any, run: Any) -> None:
        noted.wait(5)
        control.ask(store, "stop", who="anna")

    async def looks(threads: Any) -> None:
        for _ in range(2):
            await served._look(client, threads)
        assert client.said == {}
        noted.set()
        await asyncio.wait(served._words.values())
        client.runs.pop()
        await served._look(client, threads)

    monkeypatch.setattr(runs, "_carry_out_here", carry_out)
    with ThreadPoolExecutor() as threads:
        asyncio.run(looks(threads))
    assert [said[:24] for said in client.said.values()] == ["CANCELLED: with the stop"]


def test_a_stop_reaches_a_run_whose_process_starts(page: Page) -> None:
    folder = page.log.parent
    data = tiny()
    data["name"] = "stopped"
    protocol = write(folder / "stopped.yaml", data)
    run = page.run("collect", protocol=str(protocol))["id"]
    until("its process", lambda: process_of(run), pause_s=0.005)
    outcome = requests.stop_collection(TrialStore.open(folder / "store"))
    assert outcome.holder is None  # it does not hold the store yet
    assert page.ended(run)["type"] == "CANCELLED", page.log.read_text()
    assert not (folder / "store" / "campaigns" / "stopped" / "trials").exists()


def test_a_killed_run_is_closed_and_a_suspended_one_goes_on(page: Page) -> None:
    folder = page.log.parent
    protocol = write(folder / "protocol.yaml", tiny())
    store = folder / "store"
    trials, records = store / "campaigns" / "tiny" / "trials", store / "control" / "runs"
    killed = page.run("collect", protocol=str(protocol))["id"]
    until("a trial", lambda: trials.is_dir() and any(trials.iterdir()))
    os.kill(process_of(killed), signal.SIGKILL)
    said = page.ended(killed)
    assert (said["type"], said["message"]) == ("CRASHED", "its process was killed (-9)")
    assert len(list(trials.iterdir())) < 6

    suspended = page.run("collect", protocol=str(protocol))["id"]
    until("a run", lambda: page.state(suspended)["type"] == "RUNNING")
    paused = {"type": "PAUSED", "name": "Suspended", "state_details": {"pause_reschedule": True}}
    answer = page.call(f"/flow_runs/{suspended}/set_state", {"state": paused})
    assert answer["status"] == "ACCEPT", answer
    until("its process", lambda: not process_of(suspended))
    assert page.state(suspended)["type"] == "PAUSED"
    page.call(f"/flow_runs/{suspended}/resume", {})
    assert page.ended(suspended)["type"] == "COMPLETED", page.log.read_text()
    assert len(list(trials.iterdir())) == 6
    ends = [read_json(records / f"{run}.end.json") for run in (suspended, killed)]
    assert [(end["state"], end["by"]) for end in ends] == [
        ("COMPLETED", "flow"),
        ("CRASHED", "service"),
    ]


@pytest.mark.long
def test_a_push_that_hangs_delays_no_collection(page: Page) -> None:
    data = tiny()
    data["name"] = "beside"
    protocol = write(page.log.parent / "beside.yaml", data)
    pushing = page.run("push")["id"]
    until("the push", lambda: page.state(pushing)["type"] == "RUNNING")
    taking = page.run("collect", protocol=str(protocol), trials=1)["id"]
    said = page.ended(taking)
    assert said["type"] == "COMPLETED", page.log.read_text()
    assert "1 of 6 committed" in said["message"]
    assert page.state(pushing)["type"] == "RUNNING"
    page.cancel(pushing)
    assert page.ended(pushing)["type"] == "CANCELLED"
