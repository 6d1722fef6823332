"""What the subjects of the web application share: the store, who asks, how a page is rendered."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl

from jinja2 import Environment, FileSystemLoader, StrictUndefined, select_autoescape
from starlette.requests import Request
from starlette.responses import HTMLResponse, Response

from sliplab.plugins.web.pages.access import NAME_COOKIE, Access, Viewer, set_cookie
from sliplab.plugins.web.review.trial_list import TrialList
from sliplab.plugins.web.server.service import Service
from sliplab.storage.trials.store import TrialStore

PAGES = (
    ("/", "Live"),
    ("/trials", "Trials"),
    ("/review", "Review"),
    ("/report", "Report"),
    ("/log", "Log"),
    ("/schedules", "Schedules"),
)
"""Path and name of each subject, in the order of the navigation."""


def _environment() -> Environment:
    return Environment(
        loader=FileSystemLoader(Path(__file__).with_name("templates")),
        autoescape=select_autoescape(),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


@dataclass(frozen=True)
class Web:
    """What every route gets.

    Attributes:
        store: that the pages show.
        access: who may do what.
        prefect: address of Prefect's page, relative to this application or absolute; None without.
        schedules: the file of schedules that is served; None without.
        service: that runs this page; None for the page of a store without one.
        reviews: the trials to review, where another choice or order than that of all is wanted.
        who: name of a viewer who has given none.
        templates: those of `templates/`.
    """

    store: TrialStore
    access: Access
    prefect: str | None = None
    schedules: Path | None = None
    service: Service | None = None
    reviews: TrialList | None = None
    who: str = ""
    templates: Environment = field(default_factory=_environment)

    def render(
        self, request: Request, template: str, status: int = 200, **values: Any
    ) -> HTMLResponse:
        """Return a page; templates extend ``base.html``, which needs ``title`` in `values`."""
        return HTMLResponse(self.html(request, template, **values), status)

    def html(self, request: Request, template: str, **values: Any) -> str:
        """Return the text of a page, or of a part of one."""
        shared = {
            "viewer": viewer(request),
            "pages": PAGES,
            "path": request.url.path,
            "store": self.store.folder,
            "prefect": self.prefect,
        }
        return self.part(template, **shared, **values)

    def part(self, template: str, **values: Any) -> str:
        """Return the text of a part that is the same for all viewers."""
        return self.templates.get_template(template).render(values)


def viewer(request: Request) -> Viewer:
    """Return who asks; the gate has checked it."""
    found: Viewer = request.state.viewer
    return found


def is_secure(request: Request) -> bool:
    """Return whether the browser came through TLS, so that its cookies may be for that alone."""
    return request.headers.get("x-forwarded-proto", request.url.scheme) == "https"


def named(request: Request, answer: Response, who: str) -> Response:
    """Let a browser keep the name that its person has just given."""
    if who and who != viewer(request).name:
        header, value = set_cookie(NAME_COOKIE, who, secure=is_secure(request))
        answer.headers.append(header, value)
    return answer


async def form(request: Request) -> Mapping[str, str]:
    """Return the fields of a posted form; of repeated fields the last counts."""
    return dict(parse_qsl((await request.body()).decode(), keep_blank_values=True))
