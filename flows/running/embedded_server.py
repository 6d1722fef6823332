"""The embedded Prefect server as a process of ours: it survives Ctrl-C and dies with its parent.

Prefect's own embedded server shares the terminal's process group, so Ctrl-C takes it away while
the flow still has to tell it that it crashed (a minute of retries), and it outlives a killed
parent. This one leads its own session, and the kernel ends it when its parent dies.

It starts while its parent does other things: only asking for its `url` waits for it. What it leaves
out, so that it keeps up with short trials, is in `LEAN`.

It asks every client for a password, and answers no page but its own (docs/decisions/prefect.md).
That of a service shares its port with the web application (`forward`).

Run as a module it is the server; imported it starts one.
"""

from __future__ import annotations

import atexit
import fcntl
import os
import re
import resource
import secrets
import shutil
import signal
import socket
import sqlite3
import subprocess
import sys
import time
import urllib.request
from contextlib import closing, suppress
from dataclasses import dataclass
from http.client import HTTPException
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sliplab.flows.running.process import collect_garbage_seldom, die_with
from sliplab.flows.running.same_origin import SameOrigin
from sliplab.storage.process import Child

if TYPE_CHECKING:
    from starlette.types import ASGIApp

START_LIMIT_S = 120.0
STOP_LIMIT_S = 10.0
LEAN = {
    # without the feed of events and automations; runs, tasks and states are stored
    "PREFECT_SERVER_SERVICES_EVENT_PERSISTER_ENABLED": "false",
    "PREFECT_SERVER_SERVICES_TRIGGERS_ENABLED": "false",
    # task runs are written many at once, and a second later at most
    "PREFECT_SERVER_SERVICES_TASK_RUN_RECORDER_BATCH_SIZE": "100",
    "PREFECT_SERVER_SERVICES_TASK_RUN_RECORDER_FLUSH_INTERVAL": "1",
    # types of blocks are for things that are set up on a page
    "PREFECT_API_BLOCKS_REGISTER_ON_START": "false",
}
"""Settings of a server without a page; what the user has set in the environment counts more."""
_HEADLESS = {"PREFECT_UI_ENABLED": "0", "PREFECT__SERVER_EPHEMERAL": "1"}
_RAISED = re.compile(r"[\w.]*(Error|Exception|Interrupt)\b")
"""The line of a traceback that says what was raised."""
_direct = urllib.request.build_opener(urllib.request.ProxyHandler({}))
"""Opener for the loopback, which ignores proxies of the environment."""


WEB, PUBLIC = "SLIPLAB_WEB_SOCKET", "SLIPLAB_PUBLIC_URL"


@dataclass(frozen=True)
class WebFront:
    """The web application that shares a server's port.

    Attributes:
        socket: on which its program listens.
        public: address of a reverse proxy, such as ``https://lab.example``; empty without one.
    """

    socket: Path
    public: str = ""


class ServerError(RuntimeError):
    """The embedded server did not start; the message says where its log is."""


class EmbeddedServer:
    """One server on a port of the loopback, its log in Prefect's home.

    Args:
        port: where; 0 for a free one.
        page: whether it has Prefect's page, and all of its services with it.
        password: that its clients must know (PREFECT_API_AUTH_STRING); by default a new one.
        front: the web application that gets all paths but Prefect's.

    Raises:
        ServerError: the port is taken, or it did not start.
    """

    def __init__(
        self,
        home: Path,
        port: int = 0,
        *,
        page: bool = False,
        password: str | None = None,
        front: WebFront | None = None,
    ) -> None:
        self.password = password or new_password()
        self._log = home / "server.log"
        kind = {"PREFECT_UI_ENABLED": "1"} if page else {**LEAN, **_HEADLESS}
        retained = {name: value for name, value in os.environ.items() if name not in _HEADLESS}
        try:
            written = self._log.open("w")
        except OSError as error:
            raise ServerError(f"{self._log}: cannot be written: {error.strerror}") from None
        with socket.socket() as listener, written as log:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                listener.bind(("127.0.0.1", port))
            except OSError as error:
                raise ServerError(f"port {port} of the loopback: {error.strerror}") from None
            self.port = int(listener.getsockname()[1])
            # the server inherits the open socket: another program could take a free number first.
            # Above the standard streams: with one of these closed, the port would have its number
            handle = fcntl.fcntl(listener, fcntl.F_DUPFD_CLOEXEC, 3)
            self._process = Child(
                [
                    *(sys.executable, "-P", "-m", "sliplab.flows.running.embedded_server"),
                    *(str(handle), str(os.getpid()), str(home)),
                ],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                pass_fds=[handle],
                env={**kind, **retained, **_closed(self.port, self.password, front)},
            )
            os.close(handle)
        self._answers = False
        atexit.register(self.stop)

    @property
    def pid(self) -> int:
        """The server's process."""
        return self._process.pid

    @property
    def url(self) -> str:
        """Value of PREFECT_API_URL; waits until the server answers there.

        Raises:
            ServerError: it did not start.
        """
        if not self._answers:
            self._wait_until_healthy()
            self._answers = True
        return self.address

    @property
    def address(self) -> str:
        """The same, without a look whether it answers."""
        return f"http://127.0.0.1:{self.port}/api"

    def settings(self) -> dict[Any, str]:
        """Prefect's settings of its clients: `url` and password.

        Raises:
            ServerError: it did not start.
        """
        from prefect.settings import PREFECT_API_AUTH_STRING, PREFECT_API_URL

        return {PREFECT_API_URL: self.url, PREFECT_API_AUTH_STRING: self.password}

    @property
    def alive(self) -> bool:
        """True while its process runs."""
        return self._process.poll() is None

    @property
    def answers(self) -> bool:
        """True where it answers within 5 s."""
        return self.alive and self._healthy()

    def _wait_until_healthy(self) -> None:
        end = time.monotonic() + START_LIMIT_S
        while time.monotonic() < end:
            try:
                self._process.wait(timeout=0.02)
            except subprocess.TimeoutExpired:
                if self._healthy():
                    return
            else:
                break
        code = self._process.poll()
        self.stop()
        raise ServerError(
            f"the embedded Prefect server did not start: {self._cause(code)}; see {self._log}"
        )

    def _cause(self, code: int | None) -> str:
        """Return why it did not start: its exit code, its last message, a limit of the shell."""
        if code is None:
            return f"no response at {self.address} within {START_LIMIT_S:.0f} s"
        found = f"ended by {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
        with suppress(OSError):
            lines = [line.strip() for line in self._log.read_text(errors="replace").split("\n")]
            lines = [line for line in lines if _RAISED.match(line)] or [
                line for line in lines if line
            ]
            found += f", {lines[-1][:300]}" if lines else ""
        limit, _ = resource.getrlimit(resource.RLIMIT_FSIZE)
        if limit != resource.RLIM_INFINITY:
            found += f" (this shell has a file size limit of {limit} bytes, see `ulimit -f`)"
        return found

    def _healthy(self) -> bool:
        try:
            with _direct.open(f"{self.address}/health", timeout=5) as answer:
                return int(answer.status) == 200
        except (OSError, HTTPException):
            return False

    def stop(self) -> None:
        """End the server; safe to call more than once."""
        self._process.stop(STOP_LIMIT_S)


def new_password() -> str:
    """Return a random password in the form that Prefect expects (``user:password``)."""
    return f"sliplab:{secrets.token_urlsafe(32)}"


def _closed(port: int, password: str, front: WebFront | None) -> dict[str, str]:
    """Settings of a server for those who have its password, whatever else is set."""
    own = f"http://127.0.0.1:{port}"
    public = "" if front is None else front.public
    return {
        WEB: "" if front is None else str(front.socket),
        PUBLIC: public,
        "PREFECT_SERVER_API_AUTH_STRING": password,
        "PREFECT_SERVER_API_CORS_ALLOWED_ORIGINS": f"{own},http://localhost:{port}"
        + (f",{public}" if public else ""),
        "PREFECT_SERVER_API_CSRF_PROTECTION_ENABLED": "true",
        "PREFECT_SERVER_UI_API_URL": f"{public or own}/api",
    }


def _serve(handle: int, parent: int, home: Path) -> None:
    """Run the server until it is asked to end, or until the parent dies."""
    if not die_with(parent):
        return  # it died before it could be watched
    collect_garbage_seldom()
    if not _names_database():
        # so that no part of the folder's name is read as part of the database's address
        os.chdir(home)
        home = Path()
        os.environ["PREFECT_HOME"] = str(home)
    import uvicorn
    from prefect.server.api.server import create_app

    from sliplab.flows.running.forward import Forward

    prepare_database(home)
    with socket.socket(fileno=handle) as listener:
        prefect, web = create_app(), os.environ.get(WEB)
        inside: ASGIApp = Forward(prefect, Path(web)) if web else prefect
        app = SameOrigin(inside, listener.getsockname()[1], os.environ.get(PUBLIC, ""))
        uvicorn.Server(uvicorn.Config(app, log_level="error")).run(sockets=[listener])


NAME = "prefect.db"
_DATABASE = re.compile("PREFECT_(SERVER|API)_DATABASE_(CONNECTION_URL|DRIVER)")
_MADE = "alembic_version"
"""The one table with a row in a file that has just been made."""


def _names_database() -> bool:
    """Return True where the user has set another database."""
    return any(_DATABASE.fullmatch(name) for name in os.environ)


def prepare_database(home: Path) -> None:
    """Create the tables in Prefect's home; do nothing where the user has set another database.

    Prefect makes the tables of a new file by all migrations since its first version, which takes
    half of the server's start. So the first file that is made with a version of Prefect is copied,
    empty as it is then, into the user's cache folder, and every later store begins with that copy.
    It may be deleted at any time; one that is damaged is not used.
    """
    if _names_database() or (home / NAME).exists():
        return
    template = _template()
    if template is not None and _sound(template):
        _copy(template, home / NAME)
        return
    _make()
    if template is not None:
        with suppress(OSError, sqlite3.Error):  # a folder that cannot be written to
            _keep(home / NAME, template)


def _template() -> Path | None:
    """Return the path of the cached database template; None for a user without a home."""
    import prefect

    try:
        base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    except RuntimeError:
        return None
    return base / "sliplab" / f"prefect-{prefect.__version__}.db"


def _sound(path: Path) -> bool:
    """Return True where the file is an intact database of Prefect without any flow run."""
    if not path.is_file():
        return False
    try:
        with closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True)) as file:
            if file.execute("pragma quick_check").fetchone() != ("ok",):
                return False
            tables = {
                name
                for (name,) in file.execute("select name from sqlite_master where type='table'")
            }
            return (
                {_MADE, "flow_run", "task_run"} <= tables
                and file.execute(f"select count(*) from {_MADE}").fetchone() == (1,)
                and file.execute("select count(*) from flow_run").fetchone() == (0,)
            )
    except sqlite3.Error:
        return False


def _make() -> None:
    """Let Prefect make its tables where its settings say."""
    import asyncio

    from prefect.server.database import provide_database_interface

    asyncio.run(provide_database_interface().create_db())


def _keep(made: Path, template: Path) -> None:
    template.parent.mkdir(parents=True, exist_ok=True)
    from sliplab.storage.files import replacing

    with (
        replacing(template) as temporary,
        closing(sqlite3.connect(made)) as source,
        closing(sqlite3.connect(temporary)) as target,
    ):
        source.backup(target)


def _copy(template: Path, target: Path) -> None:
    from sliplab.storage.files import replacing

    with replacing(target) as temporary:
        shutil.copyfile(template, temporary)


if __name__ == "__main__":
    _serve(int(sys.argv[1]), int(sys.argv[2]), Path(sys.argv[3]))
