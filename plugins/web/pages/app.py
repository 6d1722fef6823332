"""The web application: its subjects, one module each, behind the gate."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import TYPE_CHECKING

from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import HTMLResponse, PlainTextResponse, Response
from starlette.routing import BaseRoute, Mount, Route
from starlette.staticfiles import StaticFiles

from sliplab.plugins.web.pages import live, log, report, review, schedules, trials
from sliplab.plugins.web.pages.access import AccessGate, cookie_name, set_cookie
from sliplab.plugins.web.pages.web import PAGES, is_secure

if TYPE_CHECKING:
    from sliplab.plugins.web.pages.web import Web

SUBJECTS = (live.routes, trials.routes, review.routes, report.routes, log.routes, schedules.routes)


def application(web: Web) -> Starlette:
    """Return the application of one store. `SameOrigin` must be in front of it."""
    routes: list[BaseRoute] = [
        Route("/enter", _enter(web)),
        Mount("/static", StaticFiles(directory=Path(__file__).with_name("static"))),
    ]
    for subject in SUBJECTS:
        routes += subject(web)
    entry = web.templates.get_template("enter.html").render()
    return Starlette(
        routes=routes, middleware=[Middleware(AccessGate, access=web.access, entry=entry)]
    )


def _enter(web: Web) -> Callable[[Request], Awaitable[Response]]:
    page = web.templates.get_template("entered.html")
    places = {path for path, _ in PAGES}

    async def enter(request: Request) -> Response:
        """Exchange a link's token for a cookie, and go to the page ``to``.

        The browser leaves this page by itself: a redirect would still belong to the site on which
        the link was opened, and get no cookie.
        """
        role = web.access.role_of(request.query_params.get("token", ""))
        if role is None:
            return PlainTextResponse("this link is not valid (any more)\n", 403)
        own = cookie_name(request.headers.get("host", ""))
        name, value = set_cookie(own, web.access.cookie(role), secure=is_secure(request))
        to = request.query_params.get("to", "/")
        return HTMLResponse(page.render(to=to if to in places else "/"), headers={name: value})

    return enter
