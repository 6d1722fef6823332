"""Five viewers of a collection, one of whom is cut off and one of whom reads nothing: the data of
its trials are those that nobody watched."""

from __future__ import annotations

import socket
import struct
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import httpx
import pytest
import uvicorn

from benchmarks.trials import SimulatedSession, open_session
from sliplab.flows.running.same_origin import SameOrigin
from sliplab.plugins.web.pages import serving
from sliplab.plugins.web.pages.app import application
from sliplab.plugins.web.pages.web import Web
from sliplab.storage.trials.checksums import read_sums
from sliplab.storage.trials.store import TrialStore
from tests.plugins.web.pages.opened import ACCESS
from tests.plugins.web.server.serving import until

TRIALS, VIEWERS, LIMIT_S = 6, 5, 60.0
pytestmark = pytest.mark.programs


class Viewer(threading.Thread):
    """Opens the reader's link and reads the live page's stream until it leaves.

    Args:
        cut: it leaves without a word (RST) instead of an orderly end.
    """

    def __init__(self, port: int, *, cut: bool = False) -> None:
        super().__init__(name="viewer", daemon=True)
        place = f"http://127.0.0.1:{port}"
        entered = httpx.get(f"{place}/enter?token={ACCESS.tokens['reader']}", trust_env=False)
        cookie = entered.headers["set-cookie"].partition(";")[0]
        self._line = socket.create_connection(("127.0.0.1", port), timeout=LIMIT_S)
        if cut:
            self._line.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        head = f"GET /live HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nCookie: {cookie}\r\n\r\n"
        self._line.sendall(head.encode())
        self.leaves = threading.Event()
        self.pictures, self.cut = 0, cut

    def run(self) -> None:
        """Count the pictures."""
        with self._line:
            while not self.leaves.is_set() and (part := self._line.recv(65536)):
                self.pictures += part.count(b"event: pictures")

    def leave(self) -> None:
        """Close the connection; one that is cut, after what comes next."""
        self.leaves.set()
        if not self.cut:
            self._line.shutdown(socket.SHUT_RDWR)
        if self.ident is not None:
            self.join(LIMIT_S)
        self._line.close()


@contextmanager
def page(store: TrialStore) -> Iterator[int]:
    """The page of a store in a thread of this process; yields its port."""
    with serving.listen(0) as listener:
        port = int(listener.getsockname()[1])
        app = SameOrigin(application(Web(store, ACCESS)), port)
        server = uvicorn.Server(serving._config(app))
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
        thread.start()
        try:
            yield port
        finally:
            server.should_exit = True
            thread.join(LIMIT_S)


def data(work: SimulatedSession) -> dict[str, dict[str, str]]:
    """The checksums of all files with data, by trial."""
    folders = work.collector.campaign.folders("trials")
    return {path.name: {n: s.sha256 for n, s in read_sums(path).items()} for path in folders}


def test_viewers_change_no_byte() -> None:
    with open_session("rehearsal", TRIALS) as alone:
        alone.take()
        expected = data(alone)
    with ExitStack() as stack:
        work = stack.enter_context(open_session("rehearsal", TRIALS))
        store = TrialStore.open(Path(work.collector.campaign.folder).parents[1])
        port = stack.enter_context(page(store))
        dropped, silent = Viewer(port, cut=True), Viewer(port)
        others = [Viewer(port) for _ in range(VIEWERS - 2)]
        for viewer in (dropped, silent, *others):
            stack.callback(viewer.leave)
        for viewer in (dropped, *others):
            viewer.start()
        # a simulated trial may be over before the collection sees that somebody watches
        until("the viewers are seen", lambda: work.feed.watched)
        work.take(1)
        until("pictures", lambda: all(viewer.pictures for viewer in (dropped, *others)))
        dropped.leave()
        work.take()
        until("all trials", lambda: len(data(work)) == TRIALS)
        assert data(work) == expected
        assert len(expected) == TRIALS
