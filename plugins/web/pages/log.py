"""The log of the store: who did what, and a note or another skin to add."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from starlette.requests import Request
from starlette.responses import RedirectResponse, Response
from starlette.routing import BaseRoute, Route

from sliplab.flows.log import add_note, log_entries
from sliplab.plugins.web.pages.web import form, named, viewer
from sliplab.protocols.errors import InputError
from sliplab.storage.errors import StoreError
from sliplab.storage.trials.context import SKIN

if TYPE_CHECKING:
    from sliplab.plugins.web.pages.web import Web

LINES = 200
"""Entries that are shown without ``?all``."""


def routes(web: Web) -> list[BaseRoute]:
    """Return the routes of this subject."""

    async def show(request: Request) -> Response:
        faults: list[str] = []
        entries = await asyncio.to_thread(log_entries, web.store, faults)
        entries.reverse()
        shown = entries if "all" in request.query_params else entries[:LINES]
        return web.render(
            request, "log.html", title="Log", entries=shown, count=len(entries), faults=faults
        )

    async def note(request: Request) -> Response:
        given = await form(request)
        text, name = given.get("text", ""), viewer(request).name
        who = given.get("who", "").strip()[:100] or name
        skin = given.get("skin", "").strip()
        context = {SKIN: skin} if skin else None
        try:
            await asyncio.to_thread(add_note, web.store, text, who=who, context=context)
        except (InputError, StoreError, OSError) as error:
            return web.render(request, "problem.html", 422, title="Log", problem=str(error))
        return named(request, RedirectResponse("/log", 303), who)

    return [Route("/log", show), Route("/log", note, methods=["POST"])]
