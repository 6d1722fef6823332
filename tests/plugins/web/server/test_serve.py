"""Served flows on the embedded server: how they end, what the page shows, what is closed later."""

from __future__ import annotations

import asyncio
import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
import yaml

from sliplab.flows.collecting.progress import sign_rig
from sliplab.flows.collecting.supervisor import WindowOver
from sliplab.flows.planning.run_request import make_request
from sliplab.flows.running import orchestration, run_records, stopping
from sliplab.flows.running.embedded_server import EmbeddedServer
from sliplab.plugins.claims.document import StoppingRecord
from sliplab.plugins.web.server import deployments, serve
from sliplab.plugins.web.server.deployments import until_of
from sliplab.plugins.web.server.schedules import (
    Ask,
    Collect,
    OnRig,
    Scheduled,
    ScheduledChain,
    ScheduledPush,
    ScheduledReport,
)
from sliplab.plugins.web.server.service import Service
from sliplab.protocols import InputError
from sliplab.storage.files import read_json, write_json
from sliplab.storage.schema.campaign_end import STOPPING
from sliplab.storage.trials import control
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.lock import Locked, exclusive
from sliplab.storage.trials.store import TrialStore
from tests.conftest import ROOT
from tests.crash import campaign
from tests.plugins.web.server.serving import Page, clients, no_garbage_collection, until
from tests.storage.trial_files import campaign as plain_campaign
from tests.storage.trial_files import commit

RIG = ROOT / "rigs" / "rehearsal.yaml"


@pytest.fixture(scope="module")
def server() -> Iterator[EmbeddedServer]:
    """The embedded server of the tests; the settings point at it."""
    from prefect.settings import temporary_settings

    server = orchestration.embedded()
    with temporary_settings(updates=server.settings()):
        yield server


@pytest.fixture
def service(server: EmbeddedServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Service:
    """This process as the one that serves a store that is not there yet."""
    monkeypatch.setenv("SLIPLAB_SERVICE", "")
    # as if somebody could look
    monkeypatch.setattr(orchestration, "uses_private_server", lambda: False)
    store = TrialStore.create(tmp_path / "store")
    here = str(tmp_path)
    found = Service(str(store.folder), str(RIG), "here", "embedded", os.getpid(), (here,))
    found.export_environment()
    return found


@pytest.fixture
def protocol(tmp_path: Path) -> Path:
    path = tmp_path / "protocol.yaml"
    path.write_text(yaml.safe_dump(campaign.protocol(4)))
    return path


def ends(service: Service) -> list[dict[str, Any]]:
    folder = service.folder / "control" / "runs"
    return [read_json(path) for path in sorted(folder.glob("*.end.json"))]


def test_a_collection_ends_with_a_record_and_shows_itself(
    service: Service, server: EmbeddedServer, protocol: Path
) -> None:
    from prefect.client.orchestration import get_client
    from prefect.client.schemas.filters import LogFilter, LogFilterFlowRunId

    from sliplab.plugins.web.server.deployments import collect

    with get_client(sync_client=True) as client:
        sign_rig(client, "rehearsal", True)  # as a killed program left it
        state = collect(Collect(protocol=protocol, trials=3), return_state=True)
        limit = client.read_global_concurrency_limit_by_name("rig rehearsal")
        run = client.read_flow_run(state.state_details.flow_run_id)
        own = LogFilter(flow_run_id=LogFilterFlowRunId(any_=[run.id]))
        lines = [line.message for line in client.read_logs(own, limit=100, offset=0)]
    assert run.name == "collect crash on rehearsal, 3 simulated trials"
    assert sum(line.endswith(" committed") for line in lines) == 3
    assert state.type.value == "COMPLETED"
    assert "3 of 4 committed, 1 missing" in state.message
    (end,) = ends(service)
    assert (end["state"], end["by"], end["message"]) == ("COMPLETED", "flow", state.message)
    made = Page(server.url, server.password, "here").artifacts(str(state.state_details.flow_run_id))
    assert made["progress"]["data"] == 100
    table = {row["outcome"]: row for row in yaml.safe_load(made["table"]["data"])}
    assert (table["committed"]["this run"], table["committed"]["campaign"]) == (3, 3)
    assert table["missing"]["campaign"] == 1
    assert made["image"]["data"].startswith("data:image/svg+xml;base64,")
    assert "(simulated)" in made["image"]["description"]
    assert (limit.limit, limit.active_slots) == (1, 0)


def test_a_push_goes_only_where_a_schedule_says(
    service: Service, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from sliplab.plugins.web.server.deployments import push

    url = f"file://{tmp_path}/remote"
    stored = plain_campaign(service.folder, "c")
    commit(stored, "a")
    state = push(ScheduledPush(url=url), return_state=True)
    assert (state.type.value, "none: give a schedule" in state.message) == ("FAILED", True)
    replace(service, urls=(url,)).export_environment()
    state = push(ScheduledPush(), return_state=True)
    assert (state.type.value, state.message) == ("COMPLETED", "push: 1 trial sent, 0 were there")
    state = push(ScheduledPush(url=f"file://{tmp_path}/elsewhere"), return_state=True)
    assert "must be one that the schedules name" in state.message
    assert not (tmp_path / "elsewhere").exists()
    assert [end["state"] for end in ends(service)].count("COMPLETED") == 1


def test_a_week_is_reported_without_an_analysis(service: Service) -> None:
    from sliplab.plugins.web.server.deployments import report

    state = report(ScheduledReport(period="week"), return_state=True)
    assert state.type.value == "COMPLETED", state.message
    assert len(list((service.folder / "report" / "periods").glob("*.html"))) == 1


@pytest.mark.long
def test_pause_is_shown_on_the_page_only_while_the_run_is_running(server: EmbeddedServer) -> None:
    from prefect.client.orchestration import get_client
    from prefect.states import Completed, Running

    from sliplab.plugins.web.server.deployments import collect

    with get_client(sync_client=True) as client:
        run = client.create_flow_run(collect, state=Running()).id
        orchestration.show_running(client, run, "Paused", "paused before A (pause by anna: lunch)")
        paused = client.read_flow_run(run).state
        client.set_flow_run_state(run, Completed(), force=True)
        orchestration.show_running(client, run, "Paused", "")
        ended = client.read_flow_run(run).state
    assert (paused.type.value, paused.name) == ("RUNNING", "Paused")
    assert "anna: lunch" in paused.message
    assert ended.is_completed()


@pytest.mark.long
def test_claims_end_a_collection_of_the_service_too(service: Service, tmp_path: Path) -> None:
    from sliplab.plugins.web.server.deployments import collect

    data = campaign.protocol(2)
    claim = {"figure": "first_slip", "at_most": "60 s"}
    data["collection"] |= {"repetitions": 7, "stopping": {"error": 0.4, "claims": [claim]}}
    protocol = tmp_path / "claims.yaml"
    protocol.write_text(yaml.safe_dump(data))
    state = collect(Collect(protocol=protocol), return_state=True)
    assert state.type.value == "COMPLETED", state.message
    record = StoppingRecord.load(service.folder / "campaigns" / data["name"] / STOPPING)
    assert record.verdict == "settled"
    assert f"{record.looks[-1].taken} of 14 committed" in state.message
    state = collect(Collect(protocol=protocol, no_stopping=True), return_state=True)
    assert "14 of 14 committed" in state.message


def test_what_goes_wrong_is_one_message(service: Service, protocol: Path) -> None:
    from sliplab.plugins.web.server.deployments import chain, collect, pause, resume

    state = collect(Collect(protocol=protocol.with_name("none.yaml")), return_state=True)
    assert state.type.value == "FAILED"
    assert "none.yaml: no such file" in state.message

    assert pause(Ask(who="anna"), return_state=True).type.value == "COMPLETED"
    state = collect(Collect(protocol=protocol), return_state=True)
    assert (state.type.value, "is paused (pause by anna" in state.message) == ("FAILED", True)
    assert resume(Ask(), return_state=True).type.value == "COMPLETED"

    # collected and labelled; and nothing was trained that could be evaluated
    state = chain(ScheduledChain(protocol=protocol, trials=2, train=False), return_state=True)
    assert (state.type.value, "run `sliplab train` first" in state.message) == ("FAILED", True)
    store = TrialStore.open(service.folder)
    labels = Derived.of(store, "labels", campaign.NAME)
    assert all(labels.read(trial) for trial in store.campaign(campaign.NAME).committed())
    assert sorted(end["state"] for end in ends(service)) == [*["COMPLETED"] * 2, *["FAILED"] * 3]


SECRET = "hunter2-not-yours"


def test_a_run_reads_no_file_outside_the_services_folders(
    service: Service, protocol: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    elsewhere = tmp_path_factory.mktemp("elsewhere") / "protocol.yaml"
    elsewhere.write_text(f"password: {SECRET}\n")
    folder = protocol.parent
    (folder / "link.yaml").symlink_to(elsewhere)
    (folder / "folder").symlink_to(elsewhere.parent)
    (folder / "key.pem").write_text(SECRET)
    inside = (
        "../elsewhere0/protocol.yaml",
        "link.yaml",
        "folder/protocol.yaml",
        "key.pem",
        "",
        "/",
    )
    missing = elsewhere.with_name("missing.yaml")
    for given in ("/proc/self/environ", "/etc/shadow", elsewhere, missing, *inside):
        with pytest.raises(InputError, match=r"must be a file .yaml or .yml below ") as error:
            service.protocol(Path(given))
        assert SECRET not in str(error.value)
    assert service.protocol(Path("protocol.yaml")) == protocol.resolve()
    assert service.protocol(protocol) == protocol.resolve()


def test_nothing_is_quoted_of_what_is_no_protocol(service: Service, tmp_path: Path) -> None:
    for text in (
        f"password: {SECRET}\n",
        SECRET,
        f"a: *{SECRET}\n",
        f"{SECRET}: 1\n{SECRET}: 2\n",
        f"!{SECRET} x\n",
        f"? {{{SECRET}: 1}}\n: 2\n",
        f"protocol_of: {SECRET}\n",
    ):
        (tmp_path / "settings.yaml").write_text(text)
        with pytest.raises(InputError, match=r"settings\.yaml: is not a valid protocol") as error:
            service.protocol(Path("settings.yaml"))
        assert SECRET not in str(error.value)


def test_a_rig_in_use_is_waited_for_as_long_as_was_said(service: Service, protocol: Path) -> None:
    from sliplab.plugins.web.server.deployments import collect

    with exclusive(service.folder / ".lock", "the store"):
        state = collect(Collect(protocol=protocol, patience_min=0), return_state=True)
    assert (state.type.value, "is in use by another program" in state.message) == ("FAILED", True)


def test_a_rig_that_is_free_again_is_taken(
    service: Service, protocol: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(deployments, "POLL_S", 0.01)
    run_request = make_request(protocol, RIG, service.folder)
    answers = [Locked("the rig is in use by anna"), Locked("still"), {"taken": 1}]
    reported: list[str] = []
    monkeypatch.setattr(deployments, "_report_waiting", lambda run, why: reported.append(why))

    def work() -> dict[str, Any]:
        answer = answers.pop(0)
        if isinstance(answer, Locked):
            raise answer
        return answer

    assert deployments.when_free(run_request, 10.0, work, None) == {"taken": 1}
    assert reported == ["the rig is in use by anna"]
    answers[:] = [Locked("the rig is in use by anna")]
    with pytest.raises(WindowOver, match="no trial was taken: the rig is in use by anna"):
        deployments.when_free(replace(run_request, until=0.0), 10.0, work, None)


def test_a_night_without_a_trial_says_so(
    service: Service, protocol: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from sliplab.plugins.web.server.deployments import collect

    monkeypatch.setattr(deployments, "until_of", lambda *_: 1.0)
    state = collect(Collect(protocol=protocol, until="06:00"), return_state=True)
    assert state.type.value == "COMPLETED"
    assert state.message.endswith("the next collection continues; no trial was taken")


def test_a_run_that_waits_for_its_rig_is_stopped(
    service: Service, protocol: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from sliplab.plugins.web.server.deployments import collect

    monkeypatch.setattr(deployments, "POLL_S", 0.01)
    store = TrialStore.open(service.folder)
    monkeypatch.setattr(deployments, "_report_waiting", lambda *_: control.ask(store, "stop"))
    with exclusive(service.folder / ".lock", "the store"):
        state = collect(Collect(protocol=protocol), return_state=True)
    assert state.type.value == "CANCELLED"
    # its process is told which requests there were when the service took it
    replace(service, since=0).export_environment()
    state = collect(Collect(protocol=protocol), return_state=True)
    assert state.type.value == "CANCELLED"
    assert store.campaign(campaign.NAME).begun is False
    stopping._requested.clear()


def test_a_window_that_is_over_moves_nothing(service: Service, protocol: Path) -> None:
    class Run:
        expected_start_time = datetime.now(UTC) - timedelta(days=2)

    with pytest.raises(WindowOver, match="before the run began"):
        until_of(OnRig(until="06:00", timezone="Europe/Rome"), Run())
    assert until_of(OnRig(), Run()) is None
    Run.expected_start_time = datetime.now(UTC)
    end = until_of(OnRig(until="06:00", timezone="UTC"), Run())
    assert 0 < end - Run.expected_start_time.timestamp() <= 86400


def test_runs_of_killed_processes_are_closed_at_the_next_start(
    service: Service, server: EmbeddedServer, tmp_path: Path
) -> None:
    from prefect.client.orchestration import get_client
    from prefect.states import Completed, Running

    from sliplab.plugins.web.server.deployments import label

    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    with get_client(sync_client=True) as client:
        runs = [str(client.create_flow_run(label, state=Running()).id) for _ in range(4)]
        for run in runs:
            run_records.begin(service.folder, run, "label", "embedded")
        folder = service.folder / "control" / "runs"
        for number, (pid, host) in enumerate([(gone.pid, None), (gone.pid, "elsewhere")]):
            path = folder / f"{runs[number]}.json"
            reported = read_json(path)
            reported["process"] |= {"pid": pid, "host": host or reported["process"]["host"]}
            write_json(path, reported)
        run_records.end(service.folder, runs[3], "COMPLETED", "", "flow")
        client.set_flow_run_state(runs[3], Completed(), force=True)

        closed = run_records.close_killed_runs(service.folder, "embedded")
        states = [client.read_flow_run(run).state for run in runs]
    assert [item["run"] for item in closed] == runs[:1]  # on this machine, and gone
    assert [state.type.value for state in states] == ["CRASHED", *["RUNNING"] * 2, "COMPLETED"]
    assert f"its process was killed (pid {gone.pid}" in states[0].message
    assert read_json(folder / f"{runs[0]}.end.json")["by"] == "next start"
    assert run_records.close_killed_runs(service.folder, "embedded") == []
    assert not run_records.end(service.folder, runs[0], "COMPLETED", "", "flow")  # the first stands


def test_a_servers_name_has_no_secrets() -> None:
    url = "https://anna:secret@lab.example:4200/api?key=secret"
    assert run_records.server_name(url) == "https://lab.example:4200"
    assert run_records.server_name(None) == "embedded"


def test_the_server_refuses_wrong_parameters_and_makes_scheduled_runs(
    service: Service, server: EmbeddedServer, tmp_path: Path
) -> None:
    from sliplab.plugins.web.server.deployments import collect

    night = Scheduled(
        name="nights",
        flow="collect",
        cron="0 22 * * *",
        timezone="Europe/Rome",
        active=True,
        parameters={"protocol": "p.yaml", "until": "06:00"},
    )
    when = serve._prefects([night])
    store = TrialStore.open(service.folder)

    async def register() -> None:
        made = await collect.ato_deployment(
            "collect here", schedules=when, tags=serve._tags(store.folder, "r")
        )
        await made.aapply()

    asyncio.run(register())
    page = Page(server.url, server.password, "here")
    for wanted, said in (
        ({}, "'protocol' is a required property"),
        ({"protocol": "p.yaml", "protcol": "x"}, "'protcol' was unexpected"),
        ({"protocol": "p.yaml", "trials": 0}, "0 is less than the minimum of 1"),
        ({"protocol": "p.yaml", "store": "/etc"}, "'store' was unexpected"),
    ):
        refused = page.run("collect", **wanted)
        assert (refused["status"], said in refused["detail"]) == (409, True), refused

    there = page.deployment("collect")
    assert page.call(f"/deployments/{there['id']}/schedule", {}) is None
    asked = {"flow_runs": {"deployment_id": {"any_": [there["id"]]}}}
    runs = page.call("/flow_runs/filter", asked | {"sort": "EXPECTED_START_TIME_ASC"})
    assert runs[0]["auto_scheduled"]
    assert runs[0]["parameters"] == {"wanted": {"protocol": "p.yaml", "until": "06:00"}}

    asyncio.run(serve._refuse_another("collect", "here", store.folder))  # it is ours
    page.call("/deployments/get_scheduled_flow_runs", {"deployment_ids": [there["id"]]})
    # the server notes a runner's query some time after its answer
    until("being served", lambda: page.deployment("collect")["status"] == "READY")
    with pytest.raises(InputError, match=r"--name = here: is served for .*store; give another"):
        asyncio.run(serve._refuse_another("collect", "here", tmp_path / "other"))


def night(name: str, flow: str = "label", **changes: Any) -> Scheduled:
    """A schedule of every minute."""
    given = {"cron": "* * * * *", "timezone": "UTC", "active": True, "parameters": {}, **changes}
    return Scheduled(name=name, flow=flow, **given)


def test_what_is_no_longer_in_the_file_of_schedules_runs_no_more(
    service: Service, server: EmbeddedServer
) -> None:
    """Deleted, renamed, moved to another flow, changed or disabled: its late runs go as well."""
    from sliplab.plugins.web.server.deployments import label, train

    page, here = Page(server.url, server.password, "nights"), replace(service, name="nights")
    late = (datetime.now(UTC) - timedelta(minutes=5)).replace(second=0, microsecond=0).isoformat()

    def scheduled(flow: str) -> list[str]:
        return sorted(item["slug"] for item in page.deployment(flow)["schedules"])

    def waiting(flow: str) -> list[tuple[str, ...]]:
        """The campaigns of all runs of a deployment."""
        runs = page.call(
            "/flow_runs/filter",
            {"flow_runs": {"deployment_id": {"any_": [page.deployment(flow)["id"]]}}},
        )
        return sorted({tuple(run["parameters"]["wanted"]["campaigns"]) for run in runs})

    def start(*schedules: Scheduled) -> None:
        asyncio.run(serve._register(here, schedules, (label, train)))

    def plan(flow: str) -> None:
        """Plan the last five minutes and the next days, as the server does while nobody serves."""
        there = page.deployment(flow)["id"]
        page.call(f"/deployments/{there}/schedule", {"start_time": late, "min_runs": 8})

    def of(name: str) -> dict[str, Any]:
        return {"parameters": {"campaigns": [name]}}

    a, b = night("a a", **of("a")), night("b", **of("b"))
    start(a, b)
    plan("label")
    assert scheduled("label") == ["a-a", "b"]
    assert waiting("label") == [("a",), ("b",)]
    start(b, night("c", "train", **of("c")))
    plan("train")
    assert (scheduled("label"), scheduled("train")) == (["b"], ["c"])
    assert (waiting("label"), waiting("train")) == ([("b",)], [("c",)])
    start(night("c", **of("c")), night("b", **of("b"), active=False))
    assert (scheduled("label"), scheduled("train")) == (["b", "c"], [])
    assert (waiting("label"), waiting("train")) == ([], [])
    plan("label")
    assert waiting("label") == [("c",)]
    start()
    assert scheduled("label") == []
    assert waiting("label") == []


def test_late_runs_without_a_window_do_not_begin_when_the_service_is_back(
    service: Service, server: EmbeddedServer
) -> None:
    from sliplab.plugins.web.server.deployments import collect, label

    page, here = Page(server.url, server.password, "back"), replace(service, name="back")
    asyncio.run(serve._register(here, [], (collect, label)))
    early = page.run("collect", protocol="p.yaml")["id"]
    window = page.run("collect", protocol="p.yaml", until="06:00")["id"]
    analysis = page.run("label")["id"]
    later = {"type": "SCHEDULED", "state_details": {"scheduled_time": "2100-01-01T00:00:00Z"}}
    asked = {"parameters": {"wanted": {"protocol": "p.yaml"}}, "state": later}
    there = page.deployment("collect")["id"]
    future = page.call(f"/deployments/{there}/create_flow_run", asked)["id"]
    asyncio.run(serve._register(here, [], (collect, label)))
    assert page.state(early)["message"] == "missed while the service was down"
    assert page.state(early)["type"] == "CANCELLED"
    for run in (window, analysis, future):
        assert page.state(run)["type"] == "SCHEDULED"


def test_a_moved_store_is_not_taken_for_another(
    service: Service, server: EmbeddedServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its own database has deployments of its old folder, which are called ready."""
    from sliplab.plugins.web.server.deployments import label

    here = replace(service, name="moved")
    asyncio.run(serve._register(here, [], (label,)))
    page = Page(server.url, server.password, "moved")
    page.call(
        "/deployments/get_scheduled_flow_runs", {"deployment_ids": [page.deployment("label")["id"]]}
    )
    until("being served", lambda: page.deployment("label")["status"] == "READY")
    moved = service.folder.rename(tmp_path / "elsewhere")
    here = replace(here, store=str(moved))
    with pytest.raises(InputError, match="is served for"):  # a server that stores share
        asyncio.run(serve._register(here, [], (label,)))
    monkeypatch.setenv("PREFECT_HOME", str(moved / ".prefect"))
    asyncio.run(serve._register(here, [], (label,)))
    assert f"store:{moved}" in page.deployment("label")["tags"]


def test_all_deployments_are_registered_by_one_client(
    service: Service, server: EmbeddedServer
) -> None:
    from sliplab.plugins.web.server.deployments import label, stop

    with no_garbage_collection():
        before = clients()
        here = replace(service, name="registered")
        registered = asyncio.run(serve._register(here, [], (label, stop)))
        assert clients() == before + 1
    page = Page(server.url, server.password, "registered")
    assert {str(number) for number in registered} == {
        page.deployment(name)["id"] for name in ("label", "stop")
    }


def test_what_a_killed_service_had_taken_is_closed(
    service: Service, server: EmbeddedServer
) -> None:
    from prefect.client.orchestration import get_client
    from prefect.states import Pending

    from sliplab.plugins.web.server.deployments import label

    async def register() -> None:
        await (await label.ato_deployment("label stranded")).aapply()

    asyncio.run(register())
    page, store = Page(server.url, server.password, "stranded"), TrialStore.open(service.folder)
    taken, ours, waiting = (page.run("label")["id"] for _ in range(3))
    with get_client(sync_client=True) as client:
        for run in (taken, ours):
            client.set_flow_run_state(run, Pending(), force=True)
    run_records.begin(service.folder, ours, "label", "embedded")  # by a process that is alive
    asyncio.run(serve._close_stranded("stranded", ["label"], store.folder))
    assert page.state(taken)["type"] == "CRASHED"
    assert "was killed" in page.state(taken)["message"]
    assert [page.state(run)["type"] for run in (ours, waiting)] == ["PENDING", "SCHEDULED"]


def test_deployments_of_an_older_version_are_deleted(
    service: Service, server: EmbeddedServer, tmp_path: Path
) -> None:
    from sliplab.plugins.web.server.deployments import label, stop

    store = service.folder

    async def register() -> None:
        for flow, folder in ((label, store), (stop, tmp_path / "another")):
            tags = serve._tags(folder, "r")
            await (await flow.ato_deployment("older", tags=tags)).aapply()
            named = serve.deployment_name(flow.name, "older")
            await (await flow.ato_deployment(named, tags=tags)).aapply()

    asyncio.run(register())
    asyncio.run(serve._delete_older("older", ["label", "stop", "pause"], store))
    page = Page(server.url, server.password, "older")
    found = page.call("/deployments/filter", {"deployments": {"name": {"like_": "older"}}})
    assert sorted(item["name"] for item in found) == ["label older", "older", "stop older"]
    assert next(item for item in found if item["name"] == "older")["tags"][1].endswith("another")
