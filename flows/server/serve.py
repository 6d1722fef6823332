"""`sliplab serve`: one program registers the deployments of one rig and runs what is asked for.

Prefect's runner takes a single run at a time, because a rig is one thing. Each is a process of its
own, which stops its arm and ends when this program ends, however that happens. Pause, resume and
stop are carried past it (`flows.server.control_runs`).
"""

from __future__ import annotations

import asyncio
import os
import re
import signal
import stat
from collections.abc import Callable, Coroutine, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit
from urllib.request import ProxyHandler, build_opener

from sliplab import protocols
from sliplab.flows.running import console, run_records
from sliplab.flows.running.embedded_server import new_password
from sliplab.flows.server.control_runs import answer_page
from sliplab.flows.server.page_server import PageServer, ask_on, watch
from sliplab.flows.server.schedules import Scheduled
from sliplab.flows.server.service import Service
from sliplab.protocols import InputError
from sliplab.storage.files import write_bytes
from sliplab.storage.trials.lock import exclusive
from sliplab.storage.trials.store import Store

LOCK = ".serve.lock"
PORT = 4200
"""Prefect's usual one."""
PASSWORD = "page-password"
"""The file in Prefect's home that has the password of the service's own page."""
_PASSWORD = r"[!-~]{30,200}"
ANSWER_S = 10.0
"""How long a server is waited for when it is asked whether it has a password."""
CONTROL_POLL_S = 1.0
"""How often the page is asked for pause, resume and stop."""


@contextmanager
def page_server(port: int) -> Iterator[tuple[str, PageServer | None]]:
    """The address of Prefect's API while the block runs: PREFECT_API_URL, or a server of ours.

    Ours asks for a password, which the processes of the runs find in their environment and people
    in a file of Prefect's home that only this user can read.

    Raises:
        ServerError: ours did not start; its port may be taken.
        InputError: the password cannot be kept where only this user can read it, or the server at
            PREFECT_API_URL asks for none.
    """
    from prefect.settings import PREFECT_API_URL, temporary_settings

    url = PREFECT_API_URL.value()
    if url is not None:
        refuse_open(url)
        yield url, None
        return
    home = Path(os.environ["PREFECT_HOME"])
    page = PageServer(home, port, page_password(home))
    before = dict(os.environ)
    try:
        settings = page.server.settings()
        os.environ.update({setting.name: value for setting, value in settings.items()})
        with temporary_settings(updates=settings):
            console.say(f"the page's password is in {home / PASSWORD}, which you alone can read")
            yield page.server.url, page
    finally:
        for name in ("PREFECT_API_URL", "PREFECT_API_AUTH_STRING"):
            os.environ.pop(name, None)
            os.environ.update({name: before[name]} if name in before else {})
        page.server.stop()


def refuse_open(url: str) -> None:
    """Check that a Prefect server asks for a password; one that does not answer is not looked at.

    Raises:
        InputError: it does not, and whoever reaches it can move the arm.
    """
    address = run_records.server_name(url)
    try:
        # a proxy of the environment would refuse the loopback, as if it were a password
        opener = build_opener(ProxyHandler({}))
        with opener.open(f"{address}{urlsplit(url).path}/admin/version", timeout=ANSWER_S):
            pass
    except OSError:  # 401 is one, too
        return
    raise InputError(
        "PREFECT_API_URL", "", address,
        "asks for no password, so that any web page in a browser that reaches it can move the arm; "
        "set PREFECT_SERVER_API_AUTH_STRING for the server and PREFECT_API_AUTH_STRING here",
    )  # fmt: skip


def page_password(home: Path) -> str:
    """The password of a service's page, kept from one start to the next.

    Raises:
        InputError: it cannot be kept where only this user can read it.
    """
    path = home / PASSWORD
    with suppress(OSError, UnicodeDecodeError):
        if _private(path) and re.fullmatch(_PASSWORD, kept := path.read_text().strip()):
            return kept
    password = new_password()
    try:
        write_bytes(path, f"{password}\n".encode(), mode=0o600)
        private = _private(path)
    except OSError as error:
        raise InputError(path, "", None, f"cannot be written: {error.strerror}") from None
    if not private:
        path.unlink()
        raise InputError(
            path, "", None,
            "can be read by other users on this file system; name another folder in PREFECT_HOME",
        )  # fmt: skip
    return password


def _private(path: Path) -> bool:
    found = path.lstat()
    alone = stat.S_ISREG(found.st_mode) and not found.st_mode & 0o077
    return alone and found.st_uid == os.getuid()


def serve(
    store: Store,
    rig: str,
    name: str,
    schedules: Sequence[Scheduled],
    *,
    folders: Sequence[Path],
    port: int = PORT,
    poll_s: float = 3.0,
) -> None:
    """Register the deployments and run what is asked for, until SIGINT or SIGTERM.

    Args:
        rig: a rig file's absolute path, or the name of one that ships.
        name: of the deployments.
        folders: below which a run may name its protocol; a relative name is of the first. Those
            that ship, and those that a schedule names, it may name as well.
        port: of the embedded server's page.
        poll_s: how often the server is asked for new runs, s.

    Raises:
        Locked: another program serves this store.
        ServerError: the embedded server did not start.
        InputError: another program serves another store under this name.
    """
    from prefect.settings import PREFECT_API_URL

    ours = PREFECT_API_URL.value() is None
    with ExitStack() as stack:
        stack.enter_context(exclusive(store.folder / LOCK, f"the service of {store.folder}"))
        url, page = stack.enter_context(page_server(port))
        server = run_records.EMBEDDED if ours else run_records.server_name(url)
        protocols = _protocols(folders, schedules)
        Service(
            str(store.folder.resolve()), rig, name, server, os.getpid(), protocols
        ).export_environment()
        for item in run_records.close_dead(store.folder, server):
            console.say(f"closed: {item['flow']} {item['run']}, whose process was killed")
        looking = partial(watch, page, store.folder, server)
        asyncio.run(_serve(store, rig, name, schedules, url, poll_s, looking))


async def _serve(
    store: Store,
    rig: str,
    name: str,
    schedules: Sequence[Scheduled],
    url: str,
    poll_s: float,
    looking: Callable[[asyncio.Event], Coroutine[Any, Any, None]],
) -> None:
    from prefect.runner import Runner

    from sliplab.flows.server.deployments import CONTROL, ON_RIG

    stopped = asyncio.Event()
    loop = asyncio.get_running_loop()

    class Ours(Runner):
        """Prefect's, with SIGTERM for the whole program."""

        def handle_sigterm(self, *args: Any, **kwargs: Any) -> None:
            loop.call_soon_threadsafe(stopped.set)

    ask_on()
    rig_runner = Ours(f"{name} rig", query_seconds=poll_s, limit=1, pause_on_shutdown=False)
    control: dict[Any, Any] = {}
    for flow in (*ON_RIG, *CONTROL):
        await _refuse_another(flow.name, name, store)
        about = {"tags": _tags(store, rig), "description": flow.description}
        if flow in ON_RIG:
            when = _prefects([item for item in schedules if item.flow == flow.name])
            await rig_runner.aadd_flow(flow, name, schedules=when, **about)
        else:
            made = await flow.ato_deployment(name, **about)
            control[await made.aapply()] = flow
    await _close_stranded(name, [flow.name for flow in (*ON_RIG, *CONTROL)], store)
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, stopped.set)
    running = asyncio.create_task(rig_runner.start())
    answering = asyncio.create_task(answer_page(control, min(poll_s, CONTROL_POLL_S), stopped))
    ending = asyncio.create_task(stopped.wait())
    watching = asyncio.create_task(looking(stopped))
    console.say(f"serving {store.folder} on the rig {rig}: deployments */{name}")
    console.say(f"Prefect's page: {run_records.server_name(url)}; Ctrl-C ends")
    await asyncio.wait([ending, running, answering], return_when=asyncio.FIRST_COMPLETED)
    console.say("ending: what runs stops, arm first")
    stopped.set()
    if rig_runner.started:
        await rig_runner.astop()
    else:
        running.cancel()  # one that is still starting cannot be stopped otherwise
    for outcome in await asyncio.gather(
        running, answering, ending, watching, return_exceptions=True
    ):
        if isinstance(outcome, Exception):
            raise outcome


def _protocols(folders: Sequence[Path], schedules: Sequence[Scheduled]) -> tuple[str, ...]:
    """Where protocols may be, absolute; the root of the file system is no folder of anybody's."""
    named = [
        Path(item.parameters["protocol"]) for item in schedules if "protocol" in item.parameters
    ]
    ours = Path(protocols.__path__[0])
    found = [path.resolve() for path in (*folders, ours, *named)]
    return tuple(str(path) for path in found if path != path.parent)


def _tags(store: Store, rig: str) -> list[str]:
    return [f"rig:{Path(rig).stem}", f"store:{store.folder.resolve()}"]


def _prefects(schedules: list[Scheduled]) -> list[Any]:
    from prefect.schedules import Cron

    return [
        Cron(
            item.cron,
            timezone=item.timezone,
            active=item.active,
            parameters={"wanted": item.parameters},
            slug=item.name.replace(" ", "-"),
        )
        for item in schedules
    ]


async def _refuse_another(flow: str, name: str, store: Store) -> None:
    """Two programs under one name would take each other's runs.

    Raises:
        InputError: the name is another store's, and is being served.
    """
    from prefect.client.orchestration import get_client
    from prefect.exceptions import ObjectNotFound

    async with get_client() as client:
        try:
            there = await client.read_deployment_by_name(f"{flow}/{name}")
        except ObjectNotFound:
            return
    mine = f"store:{store.folder.resolve()}"
    others = [tag for tag in there.tags if tag.startswith("store:") and tag != mine]
    if others and there.status is not None and there.status.value == "READY":
        raise InputError(
            "--name", "", name, f"is served for {others[0].removeprefix('store:')}; give another"
        )


async def _close_stranded(name: str, flows: list[str], store: Store) -> None:
    """Close runs that a service before this one had taken and that no process has any more.

    A run whose process died has been closed by its record; this is about those that were killed
    before they could write one, and would be pending for ever.
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
    alive = {item["run"] for item in run_records.open_runs(store.folder)}
    async with get_client() as client:
        runs = await client.read_flow_runs(
            flow_filter=FlowFilter(name=FlowFilterName(any_=flows)),
            deployment_filter=DeploymentFilter(name=DeploymentFilterName(any_=[name])),
            flow_run_filter=FlowRunFilter(
                state=FlowRunFilterState(type=FlowRunFilterStateType(any_=taken))
            ),
            sort=FlowRunSort.ID_DESC,  # the server takes no None, of either
            limit=200,
        )
        for run in runs:
            if str(run.id) in alive:
                continue
            message = "the service that had taken it was killed; found at the next start"
            await client.set_flow_run_state(run.id, Crashed(message=message), force=True)
            console.say(f"closed: {run.name}, whose service was killed")
