"""Trials: the catalogue with filters, and one trial with its curves, frames, gates and files."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any
from urllib.parse import urlencode

import pandas as pd
from starlette.requests import Request
from starlette.responses import HTMLResponse, JSONResponse, PlainTextResponse, Response
from starlette.routing import BaseRoute, Route

from sliplab.analysis.campaigns import Collected, has_plan
from sliplab.flows.planning.campaign_trials import all_excluded
from sliplab.flows.ui.review import ReviewRow, row_of
from sliplab.flows.ui.trial_data import ShownTrial, load_trial
from sliplab.flows.web.gates import gate_texts
from sliplab.flows.web.trial_curves import curves_json, frame_html
from sliplab.protocols.errors import InputError
from sliplab.storage.errors import StoreError
from sliplab.storage.schema.label import LABELS
from sliplab.storage.streams import Json
from sliplab.storage.trials import review
from sliplab.storage.trials.catalogue import catalogue, query
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.store import Store

if TYPE_CHECKING:
    from sliplab.flows.web.web import Web

PAGE_ROWS = 100
RETAINED = 4
"""Trials whose data stay in memory."""
FIRST_COLUMNS = ("campaign", "trial", "recorded_s", "events", "frames", "attempt", "passed")
_RECORD_COLUMNS = frozenset(
    {"experiment", "role", "repetition", "block", "simulated", "frame_source"}
    | {"sync_uncertainty_us", "unread_bytes", *FIRST_COLUMNS}
)
"""Columns of the catalogue that are no condition's."""
_FILTERS = ("campaign", "text", "where", "sort", "columns")


def routes(web: Web) -> list[BaseRoute]:
    """Return the routes of this subject."""
    loaded = LoadedTrials(web.store)

    async def show(request: Request) -> Response:
        chosen = Choice.of(request)
        try:
            listing = await asyncio.to_thread(_listing, web.store, chosen)
        except ValueError as error:
            listing = {"problem": f"{chosen.where}: {error}"}
        return web.render(request, "trials.html", title="Trials", chosen=chosen, **listing)

    async def trial(request: Request) -> Response:
        try:
            about = await asyncio.to_thread(_about, loaded, *_names(request), Choice.of(request))
        except (StoreError, InputError, ValueError) as error:
            return web.render(request, "problem.html", 404, title="Trials", problem=str(error))
        return web.render(request, "trial.html", **about)

    async def curves(request: Request) -> Response:
        return await answer(lambda: JSONResponse(loaded.curves(*_names(request))))

    async def frame(request: Request) -> Response:
        asked = request.query_params
        return await answer(lambda: HTMLResponse(loaded.frame(*_names(request), asked)))

    async def files(request: Request) -> Response:
        checked = await answer(lambda: JSONResponse(_check_files(web.store, *_names(request))))
        return checked

    one = "/trials/{campaign}/{trial}"
    return [
        Route("/trials", show),
        Route(one, trial),
        Route(f"{one}/curves", curves),
        Route(f"{one}/frame", frame),
        Route(f"{one}/files", files),
    ]
