"""The cost of the web page while trials are taken: three viewers, and none.

A simulated rig takes trials with and without viewers in turn. `watched_over_alone` is the processor
time that the collecting program spends on a planned second with viewers over that without (its wall
time says more about what else the machine does), `page_core_percent` the processor time of the
page's program while it is watched, as a share of one core, `feed_core_percent` that of the thread
which makes the pictures in the collecting program, `page_memory_mb` what it holds at the
end, and `pictures_per_s` how often each viewer gets new pictures.
"""

from __future__ import annotations

import http.client
import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from urllib.parse import urlsplit

from benchmarks.measure import RUNS, Figures, spread
from benchmarks.trials import ROOT, SimulatedSession, open_session
from sliplab.flows.collecting.live_feed import THREAD as FEED
from sliplab.storage.process import Child

VIEWERS = 3
LIMIT_S = 60.0
_TICK = os.sysconf("SC_CLK_TCK")


class _Viewer:
    """Reads the page's stream in a thread of this process, and counts the pictures."""

    def __init__(self, link: str) -> None:
        place = urlsplit(link)
        self._line = http.client.HTTPConnection(place.netloc, timeout=LIMIT_S)
        self._line.request("GET", f"{place.path}?{place.query}")
        entered = self._line.getresponse()
        entered.read()
        cookie = str(entered.headers["set-cookie"]).partition(";")[0]
        self._line.request("GET", "/live", headers={"Cookie": cookie})
        self._answer = self._line.getresponse()
        assert self._answer.status == 200
        self.pictures = 0
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self) -> None:
        while line := self._answer.readline():
            self.pictures += line.startswith(b"event: pictures")

    def close(self) -> None:
        """Leave."""
        assert self._line.sock is not None
        self._line.sock.shutdown(2)
        self._thread.join(LIMIT_S)
        self._line.close()


def watch(link: str) -> None:
    """Be several viewers; print how many pictures one of them got at each line of the input."""
    viewers = [_Viewer(link) for _ in range(VIEWERS)]
    for _ in sys.stdin:
        print(viewers[0].pictures, flush=True)
    for viewer in viewers:
        viewer.close()


@contextmanager
def watching(link: str) -> Iterator[Callable[[], int]]:
    """Watch the page in a process of its own; yield what counts the pictures."""
    command = [sys.executable, "-c", f"from benchmarks.page import watch; watch({link!r})"]
    child = Child(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, cwd=ROOT)
    assert child.stdin is not None
    assert child.stdout is not None
    asked, answers = child.stdin, child.stdout

    def pictures() -> int:
        asked.write(b"\n")
        asked.flush()
        return int(answers.readline())

    with asked, answers:
        try:
            yield pictures
        finally:
            child.stop(LIMIT_S)


@contextmanager
def _page(store: Path) -> Iterator[tuple[Child, str]]:
    command = [sys.executable, "-m", "sliplab", "page", str(store), "--port", "0", "--json"]
    child = Child(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
    try:
        assert child.stdout is not None
        yield child, json.loads(child.stdout.readline())["links"]["reader"]
    finally:
        child.stop(LIMIT_S)
        child.stdout.close()


def measure(runs: int = RUNS, seconds: float = 10.0) -> Figures:
    """Take trials for so long with viewers, and for so long without, `runs` times."""
    ratios, shares, feeds, rates = [], [], [], []
    with ExitStack() as stack:
        work = stack.enter_context(open_session("rehearsal", 860))
        (feed,) = (f"self/task/{t.native_id}" for t in threading.enumerate() if t.name == FEED)
        child, link = stack.enter_context(_page(work.collector.campaign.folder.parents[1]))
        work.take(2)  # compiled
        for _ in range(runs):
            alone, _ = _pace(work, seconds)
            with watching(link) as pictures:
                pictures()  # they are there
                # the page has read the store, and the collection has seen that it is watched
                _pace(work, min(seconds, 5.0))
                before, seen = _processor_s(str(child.pid)), pictures()
                fed = _processor_s(feed)
                watched, took = _pace(work, seconds)
                shares.append(100 * (_processor_s(str(child.pid)) - before) / took)
                feeds.append(100 * (_processor_s(feed) - fed) / took)
                rates.append((pictures() - seen) / took)
            ratios.append(watched / alone)
        memory = _memory_mb(child.pid)
    return {
        **spread("watched_over_alone", ratios),
        **spread("page_core_percent", shares),
        **spread("feed_core_percent", feeds),
        **spread("pictures_per_s", rates),
        "page_memory_mb": memory,
    }


def _pace(work: SimulatedSession, seconds: float) -> tuple[float, float]:
    """Take trials for so long.

    Returns:
        Processor time of this process a planned second, and how long it took, s.
    """
    began, used, planned = time.perf_counter(), time.process_time(), 0.0
    while (took := time.perf_counter() - began) < seconds:
        planned += work.take(1)
    return (time.process_time() - used) / planned, took


def _processor_s(process: str) -> float:
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / _TICK


def _memory_mb(pid: int) -> float:
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("VmRSS:"):
            return int(line.split()[1]) / 1000
    raise AssertionError("no VmRSS")
