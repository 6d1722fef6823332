"""Requests that are forwarded to the web application's program; Prefect keeps its own."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import uvicorn
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.testclient import TestClient
from starlette.websockets import WebSocket

from sliplab.flows.running.forward import LARGEST_BODY, Forward
from sliplab.flows.running.same_origin import SameOrigin, own_hosts, refusal


async def echo(request: Request) -> Response:
    """What came, and two cookies."""
    found = {
        "method": request.method,
        "path": request.url.path,
        "query": request.url.query,
        "host": request.headers["host"],
        "cookie": request.headers.get("cookie"),
        "body": (await request.body()).decode(),
    }
    answer = JSONResponse(found, 418)
    answer.headers.append("set-cookie", "a=1")
    answer.headers.append("set-cookie", "b=2")
    return answer


async def greet(socket: WebSocket) -> None:
    await socket.accept()
    await socket.send_text("prefect")
    await socket.close()


def prefect() -> Starlette:
    """Answers every path, as Prefect's page does."""
    return Starlette(
        routes=[
            WebSocketRoute("/{path:path}", greet),
            Route("/{path:path}", lambda request: PlainTextResponse("prefect")),
        ]
    )


@contextmanager
def web(path: Path) -> Iterator[None]:
    """The other program, in a thread."""
    routes = [Route("/{path:path}", echo, methods=["GET", "POST"])]
    config = uvicorn.Config(Starlette(routes=routes), uds=str(path), log_level="critical")
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run, daemon=True)
    thread.start()
    end, pause = time.monotonic() + 60, threading.Event()
    while not server.started:
        assert time.monotonic() < end
        pause.wait(0.02)
    try:
        yield
    finally:
        server.should_exit = True
        thread.join(60)


@pytest.fixture
def socket(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    from tempfile import TemporaryDirectory

    with TemporaryDirectory() as folder:  # short: a socket's path has 107 bytes at most
        yield Path(folder) / "web"


def test_other_paths_are_forwarded_whole(socket: Path) -> None:
    with web(socket), TestClient(Forward(prefect(), socket)) as client:
        answer = client.post("/control/pause?a=b%20c", content="x=1", headers={"host": "lab"})
        assert answer.status_code == 418
        assert answer.json() == {
            "method": "POST",
            "path": "/control/pause",
            "query": "a=b%20c",
            "host": "lab",
            "cookie": None,
            "body": "x=1",
        }
        assert answer.headers.get_list("set-cookie") == ["a=1", "b=2"]
        trial = client.get("/trials/pilot/depth%3D1mm%2Cr%3D1").json()["path"]
        assert trial == "/trials/pilot/depth=1mm,r=1"
        assert client.post("/", content=b"x" * (LARGEST_BODY + 1)).status_code == 413


def test_one_browsers_cookie_is_not_sent_for_another(socket: Path) -> None:
    app = Forward(prefect(), socket)
    with web(socket), TestClient(app) as client:
        for cookie in (None, "a=mine", None):
            client.cookies.clear()
            headers = {} if cookie is None else {"cookie": cookie}
            assert client.get("/", headers=headers).json()["cookie"] == cookie


@pytest.mark.parametrize("path", ["/api", "/api/health", "/v2/", "/ui-settings"])
def test_prefects_paths_need_no_other_program(socket: Path, path: str) -> None:
    client = TestClient(Forward(prefect(), socket))
    assert client.get(path).text == "prefect"


def test_websockets_are_prefects(socket: Path) -> None:
    client = TestClient(Forward(prefect(), socket))
    with client.websocket_connect("/live") as line:
        assert line.receive_text() == "prefect"


def test_program_may_come_and_go(socket: Path) -> None:
    with TestClient(Forward(prefect(), socket)) as client:
        assert client.get("/").status_code == 503
        with web(socket):
            assert client.get("/").status_code == 418
        assert client.get("/").status_code == 503
        assert client.get("/apiary").status_code == 503  # no path of Prefect's
        assert client.get("/api").text == "prefect"


@pytest.mark.parametrize(
    ("host", "origin", "status"),
    [
        ("lab.example", "https://lab.example", 0),
        ("lab.example", None, 0),
        ("lab.example", "http://lab.example", 403),
        ("lab.example", "http://127.0.0.1:4300", 403),
        ("lab.example", "null", 403),
        ("127.0.0.1:4300", "http://127.0.0.1:4300", 0),
        ("127.0.0.1:4300", "https://lab.example", 403),
        ("evil.example", "https://lab.example", 421),
    ],
)
def test_only_the_proxys_own_pages_are_answered(host: str, origin: str | None, status: int) -> None:
    origins = [] if origin is None else [origin]
    assert refusal([host], origins, own_hosts(4300), "https://lab.example")[0] == status
    client = TestClient(SameOrigin(prefect(), 4300, "https://lab.example"))
    headers = {"host": host} | ({} if origin is None else {"origin": origin})
    assert client.get("/", headers=headers).status_code == (status or 200)
