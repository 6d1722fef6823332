"""Trials: the catalogue with filters, and one trial with its curves, frames, gates and files."""

from __future__ import annotations

import asyncio
import threading
from collections import OrderedDict
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlencode

import numpy as np
import pandas as pd
from starlette.requests import Request
from starlette.responses import HTMLResponse, JSONResponse, PlainTextResponse, Response
from starlette.routing import BaseRoute, Route

from sliplab.analysis.campaigns import Collected, has_plan
from sliplab.flows.planning.campaign_trials import all_excluded
from sliplab.plugins.web.pages.gates import amount, gate_texts
from sliplab.plugins.web.pages.trial_curves import curves_json, frame_html
from sliplab.plugins.web.review.trial_list import ReviewRow, row_of
from sliplab.plugins.web.trial_data import ShownTrial, load_trial
from sliplab.protocols.errors import InputError
from sliplab.storage.errors import StoreError
from sliplab.storage.schema.label import LABELS
from sliplab.storage.streams import Json
from sliplab.storage.trials import review
from sliplab.storage.trials.catalogue import catalogue_so_far, query
from sliplab.storage.trials.checksums import read_sums, to_fetch
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.store import TrialStore

if TYPE_CHECKING:
    from sliplab.plugins.web.pages.web import Web

PAGE_ROWS = 100
READ_S = 4.0
"""Longest time in which a request reads trials for the catalogue, s; the next ones go on."""
RETAINED = 4
"""Trials whose data stay in memory."""
FIRST_COLUMNS = ("campaign", "trial", "recorded_s", "events", "frames", "attempt", "passed")
_RECORD_COLUMNS = frozenset(
    {"experiment", "role", "repetition", "block", "simulated", "frame_source"}
    | {"sync_uncertainty_us", "unread_bytes", "rows_lost", "no_clock", *FIRST_COLUMNS}
)
"""Columns of the catalogue that are no condition's."""
_FILTERS = ("campaign", "text", "where", "sort", "columns")


def routes(web: Web) -> list[BaseRoute]:
    """Return the routes of this subject."""
    loaded = LoadedTrials(web.store)

    async def show(request: Request) -> Response:
        chosen = Choice.of(request)
        listing = await asyncio.to_thread(_listing, web.store, chosen)
        return web.render(request, "trials.html", title="Trials", chosen=chosen, **listing)

    async def trial(request: Request) -> Response:
        try:
            about = await asyncio.to_thread(_about, loaded, *_names(request), Choice.of(request))
        except (StoreError, InputError, ValueError) as error:
            return web.render(request, "problem.html", 404, title="Trials", problem=str(error))
        return web.render(request, "trial.html", **about)

    async def curves(request: Request) -> Response:
        return await answered(lambda: JSONResponse(loaded.curves(*_names(request))))

    async def frame(request: Request) -> Response:
        asked = request.query_params
        return await answered(lambda: HTMLResponse(loaded.frame(*_names(request), asked)))

    async def files(request: Request) -> Response:
        return await answered(lambda: JSONResponse(_check_files(loaded, *_names(request))))

    one = "/trials/{campaign}/{trial}"
    return [
        Route("/trials", show),
        Route(one, trial),
        Route(f"{one}/curves", curves),
        Route(f"{one}/frame", frame),
        Route(f"{one}/files", files),
    ]


async def answered(work: Callable[[], Response]) -> Response:
    """Do work that reads the store in a thread, and answer with its result or its fault."""
    try:
        return await asyncio.to_thread(work)
    except (StoreError, InputError, IndexError) as error:
        return PlainTextResponse(str(error), 404)
    except ValueError as error:
        return PlainTextResponse(str(error), 422)


@dataclass(frozen=True)
class Choice:
    """Trials and columns that a viewer asked for.

    Attributes:
        campaign, text, where: filters; all trials where empty. `text` is part of an id.
        sort: a column's name, after a minus in descending order; the store's order if empty.
        columns: ``all``, or the first ones and those of conditions if empty.
        page: from 1.
    """

    campaign: str = ""
    text: str = ""
    where: str = ""
    sort: str = ""
    columns: str = ""
    page: int = 1

    @staticmethod
    def of(request: Request) -> Choice:
        """Read it from a request's query."""
        asked = request.query_params
        page = asked.get("page", "1")
        texts = {name: asked.get(name, "").strip() for name in _FILTERS}
        return Choice(**texts, page=int(page) if page.isdecimal() and len(page) < 9 else 1)

    def link(self, **changes: object) -> str:
        """Return the query of this choice with some changes; the page is the first then."""
        query = {**vars(self), "page": 1, **changes}
        found = urlencode({key: value for key, value in query.items() if value not in ("", 1)})
        return f"?{found}" if found else ""

    def of_table(self, table: pd.DataFrame) -> pd.DataFrame:
        """Return the rows of the catalogue that pass the filters, sorted.

        Raises:
            ValueError: `where` cannot be read.
        """
        if self.campaign:
            table = table[table["campaign"] == self.campaign]
        if self.text:
            table = table[table["trial"].str.contains(self.text, case=False, regex=False)]
        if self.where:
            table = query(table, self.where)
        column = self.sort.removeprefix("-")
        if column in table.columns:
            table = table.sort_values(column, ascending=column == self.sort, kind="stable")
        return table


def _listing(store: TrialStore, chosen: Choice) -> dict[str, Any]:
    """Return what the catalogue's page shows."""
    unreadable: list[str] = []
    table, left = catalogue_so_far(store, unreadable, READ_S)
    whole = None
    if left:
        whole = {c.name: {path.name for path in c.folders("trials")} for c in store.campaigns()}
    elif len(table) and not unreadable:  # else what is whole may be more than what can be read
        whole = {str(name): set(part) for name, part in table.groupby("campaign")["trial"]}
    excluded = all_excluded(store, unreadable, whole)
    about = {
        "total": len(table),
        "left": left,
        "campaigns": list(whole or dict.fromkeys(table.get("campaign", ()))),
        "all_columns": list(table.columns),
        "excluded": excluded,
        "unreadable": unreadable,
        "store_simulated": bool(len(table)) and bool(table["simulated"].all()),
    }
    nothing: dict[str, Any] = {"columns": [], "rows": [], "count": 0, "page": 1, "last_page": 1}
    if not len(table):
        return {**about, **nothing, "problem": ""}
    try:
        found = chosen.of_table(table)
    except ValueError as error:
        return {**about, **nothing, "problem": str(error)}
    last = max(1, -(-len(found) // PAGE_ROWS))
    page = min(max(chosen.page, 1), last)
    part = found.iloc[(page - 1) * PAGE_ROWS : page * PAGE_ROWS]
    columns = [
        name
        for name in found.columns
        if chosen.columns == "all"
        or name in FIRST_COLUMNS
        or (name not in _RECORD_COLUMNS and part[name].notna().any())
    ]
    numbers = {name for name in columns if pd.api.types.is_numeric_dtype(part[name].dtype)}
    numbers -= {name for name in columns if pd.api.types.is_bool_dtype(part[name].dtype)}
    cells = (map(_cell, row) for row in part[columns].itertuples(index=False))
    return {
        **about,
        "problem": "",
        "columns": columns,
        "numbers": numbers,
        "rows": [dict(zip(columns, row, strict=True)) for row in cells],
        "count": len(found),
        "page": page,
        "last_page": last,
    }


def _cell(value: Any) -> str:
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if value is None or value != value:  # not a number
        return ""
    if isinstance(value, float):
        return f"{value:,.0f}" if value.is_integer() else f"{value:.5g}"
    return f"{value:,}" if isinstance(value, int | np.integer) else str(value)


def _names(request: Request) -> tuple[str, str]:
    return request.path_params["campaign"], request.path_params["trial"]


class LoadedTrials:
    """Data of the trials that were looked at last; they are read again when they have changed."""

    def __init__(self, store: TrialStore) -> None:
        self.store = store
        self._lock = threading.Lock()
        self._found: OrderedDict[tuple[str, str], tuple[object, ShownTrial]] = OrderedDict()

    def item(self, campaign: str) -> Collected:
        """Return a campaign.

        Raises:
            StoreError: there is none of this name.
        """
        found = Collected(self.store.campaign(campaign))
        if not found.campaign.begun:
            raise StoreError(f"{self.store.folder}: has no campaign '{campaign}'")
        return found

    def get(self, campaign: str, trial: str) -> ShownTrial:
        """Return a trial's data.

        Raises:
            StoreError: it is not there, or damaged.
        """
        name = campaign, trial
        with self._lock:  # one at a time: each may take as much memory as a trial's events
            item = self.item(campaign)
            stamp = self._stamp(item, trial)
            known = self._found.pop(name, None)
            shown = known[1] if known and known[0] == stamp else load_trial(self.store, item, trial)
            self._found[name] = stamp, shown
            while len(self._found) > RETAINED:
                self._found.popitem(last=False)
        return shown

    def _stamp(self, item: Collected, trial: str) -> object:
        """Return what changes when the data do."""
        campaign = item.campaign
        label = Derived.of(self.store, LABELS, item.name).folder / f"{trial}.json"
        paths = campaign.folder / "trials" / trial, campaign.sync_file(trial), label
        return [_changed(path) for path in (*paths, campaign.protocol_file)]

    def curves(self, campaign: str, trial: str) -> Json:
        """Return a trial's curves and onsets, see `curves_json`."""
        shown = self.get(campaign, trial)
        row = row_of_shown(self.store, shown)
        decision = None
        if row is not None and not row.problem:
            decision = review.last(self.store, campaign, trial)
        return curves_json(shown, decision, "" if row is None else row.key)

    def frame(self, campaign: str, trial: str, asked: Mapping[str, str]) -> str:
        """Return the frame of a number, ``frame``, or nearest to a time in s, ``time``.

        Raises:
            IndexError: the trial has no such frame.
            ValueError: neither is given as a number.
        """
        shown = self.get(campaign, trial)
        if "frame" in asked:
            return frame_html(shown, int(asked["frame"]))
        return frame_html(shown, shown.frame_at(float(asked.get("time", "nan"))))


def row_of_shown(store: TrialStore, shown: ShownTrial) -> ReviewRow | None:
    """Return the state of a trial's label; None of a campaign without labels."""
    if not has_plan(shown.item.info):
        return None
    return row_of(store, shown.item, shown.recording.folder.name, 0)


def _changed(path: Path) -> tuple[int, int] | None:
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_ino, status.st_mtime_ns


def _about(loaded: LoadedTrials, campaign: str, trial: str, chosen: Choice) -> dict[str, Any]:
    """Return what a trial's page shows besides its curves."""
    store = loaded.store
    item = loaded.item(campaign)
    recording = item.campaign.recording(trial)
    record = recording.record
    row = row_of(store, item, trial, 0) if has_plan(item.info) else None
    before, after = _neighbours(store, (campaign, trial), chosen)
    return {
        "title": trial,
        "campaign": campaign,
        "trial": trial,
        "record": record,
        "provenance": item.campaign.provenance(recording),
        "frame_source": recording.frame_source,
        "refitted": recording.refitted,
        "clocks": {
            name: (clock.grade, amount("uncertainty_s", (clock.uncertainty_ns or 0) / 1e9))
            for name, clock in recording.clocks.devices().items()
        },
        "gates": gate_texts(record.quality.gates),
        "row": row,
        "files": {name: known.bytes for name, known in sorted(read_sums(recording.folder).items())},
        "chosen": chosen,
        "before": before,
        "after": after,
        "rerun": find_spec("rerun") is not None,
    }


def _neighbours(
    store: TrialStore, name: tuple[str, str], chosen: Choice
) -> tuple[tuple[str, str] | None, tuple[str, str] | None]:
    """Return the trials before and after one in a catalogue's choice."""
    table, _ = catalogue_so_far(store, [], READ_S)
    with suppress(ValueError):
        table = chosen.of_table(table)
    names = list(zip(table["campaign"], table["trial"], strict=True)) if len(table) else []
    if name not in names:
        return None, None
    here = names.index(name)
    return (names[here - 1] if here else None), (names[here + 1] if here + 1 < len(names) else None)


def _check_files(loaded: LoadedTrials, campaign: str, trial: str) -> list[tuple[str, str]]:
    """Return what a check of every byte says of each file of a trial."""
    folder = loaded.item(campaign).campaign.recording(trial).folder
    found = []
    for name, known in sorted(read_sums(folder).items()):
        path = folder / name
        fault = "not downloaded" if to_fetch(path) else known.problem(path)
        found.append((name, fault or "intact"))
    return found
