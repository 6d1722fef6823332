"""Report: the pages under STORE/report, when each was made, and the commands that make them."""

from __future__ import annotations

import asyncio
import html
import re
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING

from starlette.requests import Request
from starlette.responses import FileResponse, PlainTextResponse, Response
from starlette.routing import BaseRoute, Route

from sliplab.storage.errors import StoreError
from sliplab.storage.files import inside
from sliplab.storage.trials.store import TrialStore

if TYPE_CHECKING:
    from sliplab.plugins.web.pages.web import Web

MAIN = "index.html"
FOLDER = "report"
_STEPS = (
    ("label", "derived/labels"),
    ("train", "models"),
    ("evaluate", "derived/evaluation"),
    ("report", f"{FOLDER}/{MAIN}"),
)
"""Commands that lead to the report, and where each leaves its results."""
_TYPES = {
    ".html": "text/html",
    ".svg": "image/svg+xml",
    ".png": "image/png",
    ".csv": "text/csv",
    ".json": "application/json",
    ".parquet": "application/octet-stream",
}
"""Endings of the files that are served."""
_POLICY = (
    "default-src 'none'; style-src 'unsafe-inline'; img-src 'self' data:; form-action 'none'; "
    "base-uri 'none'; frame-ancestors 'none'"
)
"""A report carries its styles in itself, and no scripts."""
_TITLE = re.compile(r"<title>(.*?)</title>", re.DOTALL)
_HEAD_BYTES = 20_000


@dataclass(frozen=True)
class ReportPage:
    """A page or the results of a step.

    Attributes:
        name: path below the report's folder, or a command.
        when: UTC; empty for what was not made yet.
    """

    name: str
    title: str
    when: str


def routes(web: Web) -> list[BaseRoute]:
    """Return the routes of this subject."""

    async def show(request: Request) -> Response:
        pages, steps = await asyncio.to_thread(_made, web.store)
        return web.render(
            request,
            "reports.html",
            title="Report",
            reports=pages,
            steps=steps,
            quoted=quote(str(web.store.folder)),
        )

    async def file(request: Request) -> Response:
        path = web.store.folder / FOLDER / request.path_params["path"]
        try:
            known = inside(path, web.store.folder / FOLDER).is_file()
        except (StoreError, OSError, ValueError):
            known = False
        if not known or path.suffix not in _TYPES:
            return PlainTextResponse("the report has no such file\n", 404)
        headers = {"content-security-policy": _POLICY}
        return FileResponse(path, headers=headers, media_type=_TYPES[path.suffix])

    return [Route("/report", show), Route("/report/{path:path}", file)]


def _made(store: TrialStore) -> tuple[list[ReportPage], list[ReportPage]]:
    """Return the pages, that of the whole store first, and the steps up to it."""
    folder = store.folder / FOLDER
    paths = sorted(folder.rglob("*.html"), key=lambda path: (path != folder / MAIN, path))
    pages = [ReportPage(str(path.relative_to(folder)), _title(path), _when(path)) for path in paths]
    steps = [ReportPage(name, "", _when(store.folder / place)) for name, place in _STEPS]
    return pages, steps


def _title(path: Path) -> str:
    try:
        with path.open(encoding="utf-8", errors="replace") as file:
            found = _TITLE.search(file.read(_HEAD_BYTES))
    except OSError:
        found = None
    return html.unescape(found[1]).strip() if found else path.name


def _when(path: Path) -> str:
    """Return when a file, or the newest of a folder's own, was written, UTC; empty without any."""
    newest = max(_times(path), default=None)
    if newest is None:
        return ""
    return datetime.fromtimestamp(newest, UTC).isoformat(timespec="seconds")


def _times(path: Path) -> Iterator[float]:
    for found in path.iterdir() if path.is_dir() else (path,):
        try:
            yield found.stat().st_mtime
        except OSError:
            continue
