"""`sliplab serve`: one program registers the deployments of one rig and runs what is requested."""

from __future__ import annotations

import asyncio
import os
import signal
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from urllib.parse import urlsplit
from uuid import UUID

from sliplab import protocols
from sliplab.flows.running import console, run_records
from sliplab.flows.running.embedded_server import WebFront
from sliplab.plugins.web.server.helpers import keep_running
from sliplab.plugins.web.server.links import ROLES, Links
from sliplab.plugins.web.server.page_server import ANSWER_S, PageServer, page_server, watch
from sliplab.plugins.web.server.runs import ServedRuns
from sliplab.plugins.web.server.schedules import Scheduled
from sliplab.plugins.web.server.service import Service, deployment_name
from sliplab.plugins.web.server.waiting_runs import cancel_missed, drop_unplanned
from sliplab.protocols import InputError
from sliplab.storage.trials.lock import exclusive
from sliplab.storage.trials.store import TrialStore

LOCK = ".serve.lock"
PORT = 4200
"""Prefect's usual one."""
AGAIN_S = {"page": 5.0, "alerts": 60.0}
"""Wait before a program beside the service is started again, s."""
POLL_S = 1.0
"""Longest interval between polls for runs, s: a request to the arm must not wait."""


def serve(
    store: TrialStore,
    rig: str,
    name: str,
    schedules: Sequence[Scheduled],
    *,
    folders: Sequence[Path],
    port: int = PORT,
    poll_s: float = 3.0,
    alerts: Path | None = None,
    shown: Path | None = None,
    public: str = "",
) -> None:
    """Register the deployments and run what is requested, until SIGINT or SIGTERM.

    Args:
        rig: a rig file's absolute path, or the name of one that ships.
        name: of the service; those of its deployments end in it.
        folders: below which a run may name its protocol; a relative name is of the first. Those
            that ship, and those that a schedule names, it may name as well.
        port: of the page, and of the embedded server.
        poll_s: how often the server is polled for new runs, s.
        alerts: a file with the section ``alerts:``, which another program sends (`helpers`).
        shown: the file of the schedules, for the page.
        public: origin of a reverse proxy to the page; empty without one.

    Raises:
        Locked: another program serves this store.
        ServerError: the embedded server did not start.
        InputError: another program serves another store under this name.
    """
    from prefect.settings import PREFECT_API_URL

    ours = PREFECT_API_URL.value() is None
    with ExitStack() as stack:
        stack.enter_context(exclusive(store.folder / LOCK, f"the service of {store.folder}"))
        # short: a socket's path has 107 bytes at most
        folder = stack.enter_context(TemporaryDirectory(prefix="sliplab-web-"))
        front = WebFront(Path(folder) / "web", public)
        url, page = stack.enter_context(page_server(port, front))
        server = run_records.EMBEDDED if ours else run_records.server_name(url)
        protocols = _protocols(folders, schedules)
        urls = tuple(item.parameters["url"] for item in schedules if "url" in item.parameters)
        at = str(store.folder.resolve())
        here = Service(at, rig, name, server, os.getpid(), protocols, urls)
        here.export_environment()
        for item in run_records.close_killed_runs(store.folder, server):
            console.say(f"closed: {item['flow']} {item['run']}, whose process was killed")
        if page is None:
            place = ["--port", str(_beside(url, port)), "--public-url", public]
        else:
            links = Links(Path(os.environ["PREFECT_HOME"]))
            links.write(public or run_records.server_name(url))
            place = ["--socket", str(front.socket)]
        place += [] if shown is None else ["--schedules", str(shown)]
        programs = [["page", str(store.folder), *place]]
        if alerts is not None:
            programs.append(["alerts", str(store.folder), str(alerts)])
        asyncio.run(_serve(here, schedules, url, page, poll_s, programs))


async def _serve(
    here: Service,
    schedules: Sequence[Scheduled],
    url: str,
    page: PageServer | None,
    poll_s: float,
    programs: Sequence[Sequence[str]],
) -> None:
    from prefect.settings import (
        PREFECT_API_REQUEST_TIMEOUT,
        PREFECT_CLIENT_MAX_RETRIES,
        temporary_settings,
    )

    from sliplab.plugins.web.server.deployments import BESIDE, CONTROL, ON_RIG

    stopped = asyncio.Event()
    registered = await _register(here, schedules, (*ON_RIG, *BESIDE, *CONTROL))
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, stopped.set)

    def lane(*of: Sequence[Any]) -> ServedRuns:
        """Return what executes the runs of some flows, by one process at a time."""
        runs = [{run: flow for run, flow in registered.items() if flow in some} for some in of]
        return ServedRuns(here.folder, runs[0], runs[1], schedules)

    lanes = [lane(ON_RIG, CONTROL), lane(BESIDE, ())]
    # a server that does not answer is queried again next time
    limits = {PREFECT_API_REQUEST_TIMEOUT: ANSWER_S, PREFECT_CLIENT_MAX_RETRIES: 0}
    with temporary_settings(updates=limits):
        working = [
            asyncio.create_task(each.carry_out(min(poll_s, POLL_S), stopped)) for each in lanes
        ]
        watching = asyncio.create_task(watch(page, here.folder, here.server, stopped))
    helping = [
        asyncio.create_task(keep_running(words, stopped, again_s=AGAIN_S[words[0]]))
        for words in programs
    ]
    ending = asyncio.create_task(stopped.wait())
    shown = ", ".join(deployment_name(flow.name, here.name) for flow in (ON_RIG[0], *CONTROL))
    console.say(f"serving {here.folder} on the rig {here.rig}: deployments {shown} and others")
    home = Path(os.environ["PREFECT_HOME"])
    files = " and ".join(str(Links(home).file(role)) for role in ROLES)
    console.say(f"the page's links, readable only by you: {files}")
    console.say(f"Prefect's page: {run_records.server_name(url)}/v2/; Ctrl-C ends")
    await asyncio.wait([ending, *working], return_when=asyncio.FIRST_COMPLETED)
    console.say("stopping: the arm first, then all runs")
    stopped.set()
    for outcome in await asyncio.gather(
        *working, watching, *helping, ending, return_exceptions=True
    ):
        if isinstance(outcome, Exception):
            raise outcome


async def _register(
    here: Service, schedules: Sequence[Scheduled], flows: Sequence[Any]
) -> dict[UUID, Any]:
    """Register a deployment of each flow; return the flows by their deployments' ids.

    Raises:
        InputError: another program serves another store under this name.
    """
    from prefect.client.orchestration import get_client
    from prefect.context import AsyncClientContext

    registered: dict[UUID, Any] = {}
    names = [flow.name for flow in flows]
    # one client for all of it: see `page_server.watch`
    async with AsyncClientContext.get_or_create():
        for flow in flows:
            if not _has_own_server(here):
                await _refuse_another(flow.name, here.name, here.folder)
            when = _prefects([item for item in schedules if item.flow == flow.name])
            made = await flow.ato_deployment(
                deployment_name(flow.name, here.name),
                schedules=when,
                tags=_tags(here.folder, here.rig),
                description=flow.description,
            )
            registered[await made.aapply()] = flow
        async with get_client() as client:
            await drop_unplanned(client, registered, schedules)
            await cancel_missed(client, registered)
        await _close_stranded(here.name, names, here.folder)
        await _delete_older(here.name, names, here.folder)
    return registered


def _beside(url: str, port: int) -> int:
    """Return the page's port where the user's own Prefect server has that of `url`."""
    return port + 1 if port and urlsplit(url).port == port else port


def _protocols(folders: Sequence[Path], schedules: Sequence[Scheduled]) -> tuple[str, ...]:
    """Return the absolute folders in which protocols may be; the file system's root is excluded."""
    named = [
        Path(item.parameters["protocol"]) for item in schedules if "protocol" in item.parameters
    ]
    ours = Path(protocols.__path__[0])
    found = [path.resolve() for path in (*folders, ours, *named)]
    return tuple(str(path) for path in found if path != path.parent)


def _tags(store: Path, rig: str) -> list[str]:
    return [f"rig:{Path(rig).stem}", f"store:{store.resolve()}"]


def _prefects(schedules: list[Scheduled]) -> list[Any]:
    from prefect.schedules import Cron

    return [
        Cron(
            item.cron,
            timezone=item.timezone,
            active=item.active,
            parameters={"wanted": item.parameters},
            slug=item.slug,
        )
        for item in schedules
    ]


def _has_own_server(here: Service) -> bool:
    """Return whether Prefect's database is the store's, and no other service can share it.

    In a copied or moved store it still calls the old place's deployments ready to run.
    """
    home = Path(os.environ["PREFECT_HOME"]).resolve()
    return here.server == run_records.EMBEDDED and home.parent == here.folder.resolve()


async def _refuse_another(flow: str, name: str, store: Path) -> None:
    """Check that no other program serves this name; two would take each other's runs.

    Raises:
        InputError: the name is another store's, and is being served.
    """
    from prefect.client.orchestration import get_client
    from prefect.exceptions import ObjectNotFound

    async with get_client() as client:
        try:
            there = await client.read_deployment_by_name(f"{flow}/{deployment_name(flow, name)}")
        except ObjectNotFound:
            return
    mine = f"store:{store.resolve()}"
    others = [tag for tag in there.tags if tag.startswith("store:") and tag != mine]
    if others and there.status is not None and there.status.value == "READY":
        raise InputError(
            "--name", "", name, f"is served for {others[0].removeprefix('store:')}; give another"
        )


async def _delete_older(name: str, flows: list[str], store: Path) -> None:
    """Delete the deployments that an older version made for this store, all called `name`."""
    from prefect.client.orchestration import get_client
    from prefect.exceptions import ObjectNotFound

    async with get_client() as client:
        for flow in flows:
            with suppress(ObjectNotFound):
                there = await client.read_deployment_by_name(f"{flow}/{name}")
                if f"store:{store.resolve()}" in there.tags:
                    await client.delete_deployment(there.id)


async def _close_stranded(name: str, flows: list[str], store: Path) -> None:
    """Close runs that an earlier service had taken and that no process carries out.

    A run whose process died has been closed by its record; this is about those that were killed
    before they could write one, and would stay pending.
    """
    from prefect.client.orchestration import get_client
    from prefect.client.schemas.filters import (
        DeploymentFilter,
        DeploymentFilterName,
        FlowFilter,
        FlowFilterName,
        FlowRunFilter,
        FlowRunFilterState,
        FlowRunFilterStateType,
    )
    from prefect.client.schemas.objects import StateType
    from prefect.client.schemas.sorting import FlowRunSort
    from prefect.states import Crashed

    taken = [StateType.PENDING, StateType.RUNNING, StateType.CANCELLING]
    names = [name, *(deployment_name(flow, name) for flow in flows)]
    alive = {item["run"] for item in run_records.open_runs(store)}
    async with get_client() as client:
        runs = await client.read_flow_runs(
            flow_filter=FlowFilter(name=FlowFilterName(any_=flows)),
            deployment_filter=DeploymentFilter(name=DeploymentFilterName(any_=names)),
            flow_run_filter=FlowRunFilter(
                state=FlowRunFilterState(type=FlowRunFilterStateType(any_=taken))
            ),
            sort=FlowRunSort.ID_DESC,  # the server takes no None, of either
            limit=200,
        )
        for run in runs:
            if str(run.id) in alive:
                continue
            message = "its service was killed; detected at the next start"
            await client.set_flow_run_state(run.id, Crashed(message=message), force=True)
            console.say(f"closed: {run.name}, whose service was killed")
