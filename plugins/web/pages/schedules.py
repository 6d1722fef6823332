"""The schedules of the service: the next runs, by name and local time."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from datetime import datetime
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING

from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import BaseRoute, Route

from sliplab.plugins.web.server.schedules import Scheduled, load_schedules, upcoming_runs
from sliplab.protocols.errors import InputError

if TYPE_CHECKING:
    from sliplab.plugins.web.pages.web import Web

RUNS = 5
"""Next runs of each schedule."""


@dataclass(frozen=True)
class NextRun:
    """A run that is due: its schedule, and its window in the schedule's time zone."""

    item: Scheduled
    begins: datetime
    ends: datetime | None


def routes(web: Web) -> list[BaseRoute]:
    """Return the routes of this subject."""

    async def show(request: Request) -> Response:
        items: list[Scheduled] = []
        runs: list[NextRun] = []
        problem = ""
        if web.schedules is not None:
            try:
                items, runs = await asyncio.to_thread(next_runs, web.schedules)
            except (InputError, OSError) as error:
                problem = str(error)
        return web.render(
            request,
            "schedules.html",
            title="Schedules",
            file=web.schedules,
            items=items,
            runs=runs,
            problem=problem,
        )

    return [Route("/schedules", show)]


def next_runs(file: Path) -> tuple[list[Scheduled], list[NextRun]]:
    """Return the schedules of a file, and the next runs of those that are active, soonest first.

    Raises:
        InputError: the file is wrong.
    """
    items = load_schedules(file)
    runs = [
        NextRun(item, begins, item.end(begins))
        for item, times in zip(items, upcoming_runs(file, items, RUNS), strict=True)
        for begins in times
        if item.active
    ]
    return items, sorted(runs, key=attrgetter("begins"))
