"""Serves the web application of one store until this program is ended."""

from __future__ import annotations

import os
import socket
from pathlib import Path
from typing import TYPE_CHECKING

import uvicorn

from sliplab.flows.running.same_origin import SameOrigin
from sliplab.plugins.web.pages.app import application
from sliplab.protocols import InputError

if TYPE_CHECKING:
    from sliplab.plugins.web.pages.web import Web

CLOSE_S = 1
"""Time in which open streams may end when the program ends, s."""
HOST = "127.0.0.1"


def listen(port: int) -> socket.socket:
    """Return a socket that listens on the loopback.

    Args:
        port: 0 for a free one.

    Raises:
        InputError: the port is taken.
    """
    listener = socket.socket()
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((HOST, port))
        listener.listen()
    except OSError as error:
        listener.close()
        raise InputError("--port", "", port, f"cannot be listened on: {error.strerror}") from None
    return listener


def serve(web: Web, listener: socket.socket, public: str = "") -> None:
    """Serve on a socket of the loopback until SIGINT or SIGTERM.

    Args:
        public: origin of a reverse proxy (`same_origin.refusal`).
    """
    app = SameOrigin(application(web), listener.getsockname()[1], public)
    with listener:
        uvicorn.Server(_config(app)).run(sockets=[listener])


def serve_behind(web: Web, path: Path) -> None:
    """Serve on a socket of the file system, behind a server that has the gate for `Host`.

    Only this user can reach it.
    """
    path.unlink(missing_ok=True)
    with socket.socket(socket.AF_UNIX) as listener:
        before = os.umask(0o077)
        try:
            listener.bind(str(path))
        finally:
            os.umask(before)
        uvicorn.Server(_config(application(web))).run(sockets=[listener])


def _config(app: object) -> uvicorn.Config:
    return uvicorn.Config(
        app,  # type: ignore[arg-type]
        log_level="critical",
        access_log=False,
        lifespan="on",
        ws="none",
        timeout_graceful_shutdown=CLOSE_S,
    )
