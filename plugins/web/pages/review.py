"""Review: people accept, adjust or reject the labels of trials; each decision is a file."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import BaseModel, Field, StrictInt, ValidationError
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import BaseRoute, Route

from sliplab.analysis.labels.reviewed import STATES
from sliplab.plugins.web.pages.gates import gate_texts
from sliplab.plugins.web.pages.trial_curves import curves_json
from sliplab.plugins.web.pages.trials import LoadedTrials, answered
from sliplab.plugins.web.pages.web import viewer
from sliplab.plugins.web.review.trial_list import (
    LabelChanged,
    ReviewRow,
    TrialList,
    filtered_rows,
    record_verdict,
)
from sliplab.plugins.web.trial_data import ShownTrial
from sliplab.protocols.errors import InputError
from sliplab.storage.errors import StoreError
from sliplab.storage.streams import Json
from sliplab.storage.trials import review
from sliplab.storage.trials.review import ReviewedOnsets, Verdict

if TYPE_CHECKING:
    from sliplab.plugins.web.pages.web import Web

VERDICTS: tuple[tuple[Verdict, str], ...] = (
    ("accept", "Accept label"),
    ("adjust", "Adjust to lines"),
    ("reject", "Reject"),
    ("reopen", "Reopen"),
)
KEYS = (
    ("n ↓", "next"),
    ("p ↑", "previous"),
    ("← →", "frame"),
    ("i g", "line to the cursor"),
    ("a", "accept"),
    ("s", "adjust"),
    ("r", "reason, reject"),
    ("u", "reopen"),
    ("0", "lines back"),
    ("z, Ctrl + wheel", "zoom"),
)


def routes(web: Web) -> list[BaseRoute]:
    """Return the routes of this subject."""
    reviews = Reviews(web)

    async def show(request: Request) -> Response:
        try:
            trials = await asyncio.to_thread(reviews.trials)
        except (StoreError, InputError) as error:
            return web.render(request, "problem.html", 404, title="Review", problem=str(error))
        return web.render(
            request,
            "review.html",
            title="Review",
            campaigns=list(trials.items),
            ranked=trials.ranked,
            states=STATES,
            verdicts=VERDICTS,
            keys=KEYS,
            who=viewer(request).name or web.who,
        )

    async def rows(request: Request) -> Response:
        return await answered(lambda: reviews.rows(request.query_params))

    async def trial(request: Request) -> Response:
        def read() -> Response:
            found, texts = reviews.trial(**request.path_params)
            html = web.html(request, "review_label.html", **texts)
            return JSONResponse({**found, "html": html})

        return await answered(read)

    async def decide(request: Request) -> Response:
        body = await request.body()
        return await asyncio.to_thread(reviews.decide, body)

    return [
        Route("/review", show),
        Route("/review/rows", rows),
        Route("/review/decision", decide, methods=["POST"]),
        Route("/review/{campaign}/{trial}", trial),
    ]


class _Lines(BaseModel):
    """Where the onset lines are, ns; texts, as scripts round greater numbers."""

    incipient_ns: int | None
    gross_ns: int | None


class _Asked(BaseModel):
    """A decision as the page sends it; see `record_verdict`."""

    campaign: str
    trial: str
    verdict: Verdict
    lines: _Lines
    label: str
    seen: Annotated[StrictInt, Field(ge=0)]
    who: str
    why: str


class Reviews:
    """The trials to review, read when they are first asked for, and what people decide on them."""

    def __init__(self, web: Web) -> None:
        self._store, self._trials = web.store, web.reviews
        self._loaded = LoadedTrials(web.store)
        self._lock = threading.Lock()

    def trials(self) -> TrialList:
        """Return the list of trials, up to date.

        Raises:
            StoreError: there are none, or a campaign is damaged.
        """
        with self._lock:
            if self._trials is None:
                self._trials = TrialList(self._store)
            else:
                self._trials.refresh()
            return self._trials

    def rows(self, asked: Mapping[str, str]) -> Response:
        """Return the rows that pass the filters; nothing (204) where none changed ``since``."""
        trials = self.trials()
        if asked.get("since") == str(trials.changes):
            return Response(status_code=204)
        changes = trials.changes  # before the rows: what changes meanwhile is sent the next time
        found = filtered_rows(
            trials.rows,
            campaign=asked.get("campaign", ""),
            state=asked.get("state", ""),
            text=asked.get("text", ""),
            doubtful_first="first" in asked,
        )
        return JSONResponse({"changes": str(changes), "rows": [_row_json(row) for row in found]})

    def trial(self, campaign: str, trial: str) -> tuple[Json, dict[str, Any]]:
        """Return a trial for the page's script, and the values of its texts.

        Raises:
            StoreError: it is not in the list, or damaged.
        """
        trials = self.trials()
        with self._lock:
            row = trials.renew(trials.row(campaign, trial))
        shown = self._loaded.get(campaign, trial)
        history = [] if row.problem else review.history(self._store, campaign, trial)
        decision = history[-1] if history else None
        lines = shown.suggested
        if decision is not None and decision.verdict == "adjust" and decision.label == row.key:
            lines = decision.new
        found = {
            "row": _row_json(row),
            "label": "" if shown.label is None else shown.label.key,
            "seen": row.decisions,
            "able": row.label == "fresh" and not row.problem,
            "lines": {kind: None if ns is None else str(ns) for kind, ns in vars(lines).items()},
            "curves": curves_json(shown, decision, row.key),
        }
        record = shown.recording.record
        texts = {
            "row": row,
            "record": record,
            "history": history,
            "gates": gate_texts(record.quality.gates),
            "label": _label_quality(shown),
            "refitted": shown.recording.refitted,
        }
        return found, texts

    def decide(self, body: bytes) -> Response:
        """Store the decision that a request's body describes, and answer with what was stored."""
        try:
            asked = _Asked.model_validate_json(body)
            if not asked.who.strip():
                raise ValueError("a decision needs the name of its reviewer")
            trials = self.trials()
            with self._lock:
                row = trials.row(asked.campaign, asked.trial)
                lines = ReviewedOnsets(**vars(asked.lines))
                shared = asked.model_dump(include={"label", "seen", "who", "why"})
                made = record_verdict(trials, row, asked.verdict, lines, **shared)
                trials.renew(row)
        except ValidationError as error:
            first = error.errors()[0]
            return _refused(f"{'.'.join(map(str, first['loc']))}: {first['msg']}", 422)
        except (LabelChanged, review.Overtaken) as error:
            return _refused(f"{error}. Review it and decide again", 409)
        except ValueError as error:
            return _refused(str(error), 422)
        except (OSError, StoreError) as error:
            return _refused(str(error), 503)
        return JSONResponse({"stated": f"{row.trial}: {made}"})


def _refused(text: str, status: int) -> Response:
    return JSONResponse({"stated": f"Not saved: {text}"}, status)


def _row_json(row: ReviewRow) -> list[str | int]:
    """Return campaign, trial, status, severity of the doubt, and reasons of a row."""
    return [row.campaign, row.trial, row.status, row.severity, "; ".join(row.reasons)]


def _label_quality(shown: ShownTrial) -> dict[str, str]:
    """Return what is known of a label's origin and quality."""
    label = shown.label
    if label is None:
        return {}
    names = ("source", "rule", "reference", "markers_lost", "plate_lost", "camera_moved_px")
    values = {name.replace("_", " "): getattr(label, name) for name in names}
    found = {
        name: f"{value:.3g}" if isinstance(value, float) else str(value)
        for name, value in values.items()
        if value is not None
    }
    if label.quality:
        worst = min(label.quality)
        found["worst marker"] = f"{label.quality.index(worst)}, quality {worst:.2f} of 1"
    return found
