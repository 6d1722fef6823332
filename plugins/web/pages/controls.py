"""Controls: pause, resume, stop, skip, again and start, each with who and why."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from starlette.requests import Request
from starlette.responses import RedirectResponse, Response
from starlette.routing import BaseRoute, Route

from sliplab.flows.collecting import requests
from sliplab.plugins.web.pages.web import form, named, viewer
from sliplab.plugins.web.server.service import Service, deployment_name
from sliplab.protocols.errors import InputError
from sliplab.storage.errors import StoreError

if TYPE_CHECKING:
    from sliplab.plugins.web.pages.web import Web

MOST_CHARACTERS = 1000
"""Of a reason."""
ANSWER_S = 20.0
"""Longest wait for Prefect's answer, s."""
RETRIES = 4
"""Of a request to Prefect, whose database may be written to meanwhile (503)."""


class Controls:
    """What an operator can do from the page; every action is in the log."""

    def __init__(self, web: Web) -> None:
        self._web = web
        # threads of their own: a stop never waits for pages that read a store
        self._stops = ThreadPoolExecutor(4, "stop")
        self._others = ThreadPoolExecutor(2, "control")

    def routes(self) -> list[BaseRoute]:
        """Return the routes of all actions."""
        return [
            Route(f"/control/{name}", self._route(action), methods=["POST"])
            for name, action in (
                ("pause", partial(self._ask, "pause")),
                ("resume", partial(self._ask, "resume")),
                ("stop", self._stop),
                ("skip", partial(self._decide, "skip")),
                ("again", partial(self._decide, "again")),
                ("collect", self._collect),
            )
        ]

    def protocols(self) -> list[str]:
        """Return the protocol files that a run may be started with, for the service's page."""
        here = self._web.service
        if here is None:
            return []
        found: list[str] = []
        for root in map(Path, here.protocols):
            files = [root] if root.is_file() else sorted(root.glob("*.y*ml"))
            for file in files:
                try:
                    found.append(str(here.protocol(file)))
                except (InputError, OSError):
                    continue
        return list(dict.fromkeys(found))

    def _route(self, action: Callable[..., Any]) -> Callable[[Request], Any]:
        async def handle(request: Request) -> Response:
            given = await form(request)
            name = viewer(request).name
            who = given.get("who", "").strip()[:100] or name
            why = given.get("why", "").strip()[:MOST_CHARACTERS]
            try:
                await action(given, who, why)
            except (InputError, StoreError, OSError) as error:
                text = str(error)
                return self._web.render(request, "problem.html", 422, title="Live", problem=text)
            return named(request, RedirectResponse("/", 303), who)

        return handle

    async def _run(self, threads: ThreadPoolExecutor, work: Callable[[], Any]) -> Any:
        return await asyncio.get_running_loop().run_in_executor(threads, work)

    async def _stop(self, given: Mapping[str, str], who: str, why: str) -> None:
        """Stop at once; the signal goes out before anything is written."""
        halted = await self._run(self._stops, partial(requests.halt, self._web.store.folder))
        work = partial(
            requests.note_stop,
            self._web.store,
            *halted,
            who=who or "the page, operator's link",
            why=why,
            limit_s=ANSWER_S,
        )
        await self._run(self._stops, work)

    async def _ask(self, kind: str, given: Mapping[str, str], who: str, why: str) -> None:
        if not who:
            raise InputError("who", "", who, "must be a name: it is stored in the log")
        # a running collection carries it out between two trials; the page shows when it has
        work = partial(requests.ask, self._web.store, kind, who=who, why=why, limit_s=0.0)  # type: ignore[arg-type]
        await self._run(self._others, work)

    async def _decide(self, kind: str, given: Mapping[str, str], who: str, why: str) -> None:
        for name, value in (("who", who), ("why", why)):
            if not value:
                raise InputError(name, "", value, "must not be empty: it is stored with the trial")
        await self._run(self._others, partial(self._decided, kind, given, who, why))

    def _decided(self, kind: str, given: Mapping[str, str], who: str, why: str) -> None:
        trials = given.get("trials", "").replace(",", " ").split()
        if not trials:
            raise InputError("trials", "", "", "must name a trial")
        name = given.get("campaign", "")
        by_campaign = requests.known_trials(self._web.store, [name] if name else None, trials)
        for campaign, ids in by_campaign.items():
            requests.ask(
                self._web.store,
                kind,  # type: ignore[arg-type]
                who=who,
                why=why,
                campaign=campaign,
                trials=ids,
                limit_s=0.0,
            )

    async def _collect(self, given: Mapping[str, str], who: str, why: str) -> None:
        """Ask the service for a run of its deployment."""
        here = self._web.service
        if here is None:
            raise InputError("collect", "", "", "needs `sliplab serve`; or run `sliplab collect`")
        if not who:
            raise InputError("who", "", who, "must be a name: it is stored with the session")
        protocol = here.protocol(Path(given.get("protocol", "")))
        wanted: dict[str, Any] = {"protocol": str(protocol), "operator": who, "note": why}
        if trials := given.get("count", "").strip():
            if not trials.isascii() or not trials.isdigit():
                raise InputError("count", "", trials, "must be a number of trials")
            wanted["trials"] = int(trials)
        # Prefect takes seconds to load, during which the pages of others must not stand still
        await self._run(self._others, partial(_create_run, here, wanted))


def _create_run(here: Service, wanted: Mapping[str, Any]) -> None:
    """Ask Prefect's server for a run of the service's deployment.

    Raises:
        StoreError: it did not take it.
    """
    from prefect.client.orchestration import get_client
    from prefect.settings import PREFECT_CLIENT_MAX_RETRIES, temporary_settings
    from prefect.states import Scheduled

    name = f"collect/{deployment_name('collect', here.name)}"
    try:
        with (
            temporary_settings(updates={PREFECT_CLIENT_MAX_RETRIES: RETRIES}),
            get_client(httpx_settings={"timeout": ANSWER_S}, sync_client=True) as client,
        ):
            deployment = client.read_deployment_by_name(name)
            client.create_flow_run_from_deployment(
                deployment.id, parameters={"wanted": wanted}, state=Scheduled()
            )
    except Exception as error:
        text = str(error) or type(error).__name__
        raise StoreError(f"Prefect's server did not take the run: {text}") from error
