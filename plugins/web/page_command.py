"""`sliplab page`: the web application of a store."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from sliplab.flows.cli.common import COLLECT, JsonOption, StoreArgument
from sliplab.flows.running import console
from sliplab.protocols.errors import InputError

app = typer.Typer()

PublicOption = Annotated[
    str,
    typer.Option(
        "--public-url", help="Address of a reverse proxy to the page, such as https://lab.example."
    ),
]


@app.command(rich_help_panel=COLLECT, epilog="Example: sliplab page my-store")
def page(
    store: StoreArgument,
    port: Annotated[
        int, typer.Option("--port", min=0, max=65535, help="Port of the page; 0: any free port.")
    ] = 4300,
    public_url: PublicOption = "",
    schedules: Annotated[
        Path | None, typer.Option("--schedules", help="A file of schedules to show.")
    ] = None,
    socket: Annotated[Path | None, typer.Option("--socket", hidden=True)] = None,
    as_json: JsonOption = False,
) -> None:
    """Serve the web page of a store: live view, controls, trials, labels, report, log."""
    from sliplab.flows.running import stopping
    from sliplab.flows.running.orchestration import configure_prefect
    from sliplab.storage.trials.store import TrialStore

    opened = TrialStore.open(store)
    public = origin(public_url)
    configure_prefect(opened.folder)  # before anything imports Prefect
    from sliplab.plugins.web.pages import serving
    from sliplab.plugins.web.pages.access import Access
    from sliplab.plugins.web.pages.web import Web
    from sliplab.plugins.web.server.links import Links
    from sliplab.plugins.web.server.service import ENVIRONMENT, service

    links = Links(Path(os.environ["PREFECT_HOME"]))
    web = Web(
        opened,
        Access(links.tokens()),
        schedules=schedules,
        service=service() if ENVIRONMENT in os.environ else None,
        prefect="/v2/" if socket else None,
    )
    if socket is not None:
        serving.serve_behind(web, socket)
    else:
        listener = serving.listen(port)
        address = f"http://{serving.HOST}:{listener.getsockname()[1]}"
        found = links.write(public or address)
        if as_json:
            console.print_json({"address": address, "links": found})
        else:
            console.say("Ctrl-C ends the page. To operate, and to look only:")
            for link in found.values():
                console.show(link)
        serving.serve(web, listener, public)
        stopping.check()


def origin(url: str) -> str:
    """Return the origin of a reverse proxy's address; empty without one.

    Raises:
        InputError: it is no address, or one with a path.
    """
    from urllib.parse import urlsplit

    try:
        parts = urlsplit(url.rstrip("/"))
        port = parts.port  # raises for a port that is none
    except ValueError:
        raise InputError("--public-url", "", url, "must be like https://lab.example") from None
    if url and (
        parts.scheme not in {"http", "https"}
        or not parts.hostname
        or parts.path
        or parts.query
        or port == 0
    ):
        raise InputError("--public-url", "", url, "must be like https://lab.example")
    return url.rstrip("/").lower()
