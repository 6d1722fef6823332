"""Hours of a served campaign with viewers: do memory, files, sockets and threads stay flat?

    python -m benchmarks.nights FOLDER [--minutes 120] [--open 8] [--closed 2] [--browser]

`sliplab serve` takes trials on `rehearsal` at full speed, in windows that a schedule opens and
closes, with three viewers of the live page and alerts to a server of this program. Meanwhile a
person writes notes, pauses and resumes; one trial a window loses frames, and one run fails. Every
30 s FOLDER/samples.csv gets the memory, open files, sockets, threads and processor time of each
program. At the end every alert, every line of the log and every trial is accounted for.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from benchmarks.page import watching
from benchmarks.trials import ROOT
from sliplab.flows.log import log_entries
from sliplab.storage.files import read_json
from sliplab.storage.process import Child
from sliplab.storage.trials.checksums import RECORD
from sliplab.storage.trials.store import TrialStore

SAMPLE_S = 30.0
LIMIT_S = 180.0
LEAD_S = 120.0
"""Time in which the service starts before its first window, s."""
LATE_S = 30.0
"""Longest a run may take to end after its window, s."""
WARM_SHARE = 0.25
"""Share of the time after which slopes begin: caches have filled by then."""
COLUMNS = ("seconds", "program", "pid", "pss_mb", "files", "sockets", "threads", "processor_s")
LEVELS = COLUMNS[3:7]
PROGRAMS = {
    "sliplab serve": "service",
    "sliplab page": "page",
    "sliplab alerts": "alerts",
    "embedded_server": "prefect",
    "web.server.runs": "run",
}
PAUSED_S = 90.0
_TICK = os.sysconf("SC_CLK_TCK")


@dataclass
class Receiver:
    """A server of this program that takes alerts and pings.

    Attributes:
        lines: of all messages, each with when it came. pings: fetches of the dead-man switch.
    """

    lines: list[tuple[float, str]] = field(default_factory=list)
    pings: int = 0

    @contextmanager
    def running(self) -> Iterator[int]:
        """Serve while the block runs; yields the port."""
        receiver = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                receiver.pings += 1
                self.send_response(204)
                self.end_headers()

            def do_POST(self) -> None:
                posted = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
                receiver.lines += [(time.time(), line) for line in posted["message"].split("\n")]
                self.send_response(200)
                self.end_headers()

            def log_message(self, format: str, *args: Any) -> None:
                """Print nothing."""

        with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
            thread = threading.Thread(target=server.serve_forever)
            thread.start()
            try:
                yield server.server_port
            finally:
                server.shutdown()
                thread.join()


@dataclass(frozen=True)
class Window:
    """A time in which trials may be taken."""

    begins: datetime
    ends: datetime


def windows(first: datetime, minutes: int, open_min: int, closed_min: int) -> list[Window]:
    """Return the windows of so many minutes, from the first whole minute after `first`."""
    begin = first.replace(second=0, microsecond=0) + timedelta(minutes=1)
    step = timedelta(minutes=open_min + closed_min)
    count = max(1, minutes // (open_min + closed_min))
    each = (begin + k * step for k in range(count))
    return [Window(moment, moment + timedelta(minutes=open_min)) for moment in each]


def write_files(folder: Path, plan: list[Window], port: int) -> Path:
    """Write protocols, rig and schedules; return the schedules' file."""
    pilot = yaml.safe_load((ROOT / "protocols" / "pilot.yaml").read_text())
    for name, repetitions in (("long", 900), ("short", 1)):
        pilot |= {"name": name}
        pilot["collection"]["repetitions"] = repetitions
        (folder / f"{name}.yaml").write_text(yaml.safe_dump(pilot))
    faults = [{"kind": "frames_lost", "trial": 7, "at_s": 0.3, "count": 3}]
    rig = {"extends": "rehearsal", "name": "nights", "mock": {"faults": faults}}
    (folder / "rig.yaml").write_text(yaml.safe_dump(rig))
    schedules = [
        {
            "name": f"window {number}",
            "flow": "collect",
            # the second window finishes a campaign
            "protocol": "short.yaml" if number == 2 else "long.yaml",
            "cron": f"{window.begins.minute} {window.begins.hour} * * *",
            "until": f"{window.ends:%H:%M}",
        }
        for number, window in enumerate(plan, 1)
    ]
    fails = plan[0].ends
    schedules.append(
        {"name": "fails", "flow": "evaluate", "cron": f"{fails.minute} {fails.hour} * * *"}
    )
    alerts = {
        "to": [f"json://127.0.0.1:{port}"],
        "ping": f"http://127.0.0.1:{port}/ping",
        "attempts": 1,
        "paused_min": 1,
        "most_per_hour": 1000,
    }
    file = folder / "schedules.yaml"
    file.write_text(yaml.safe_dump({"timezone": "UTC", "schedules": schedules, "alerts": alerts}))
    return file


@contextmanager
def serving(folder: Path, schedules: Path) -> Iterator[Child]:
    """`sliplab serve`; FOLDER/serve.log has what it prints."""
    command = [sys.executable, "-m", "sliplab", "serve", str(schedules), "--port", "0"]
    command += ["--store", str(folder / "store"), "--rig", str(folder / "rig.yaml")]
    with (folder / "serve.log").open("w") as log:
        child = Child(command, stdout=log, stderr=log, cwd=folder)
    try:
        wait_for(lambda: "; Ctrl-C ends" in (folder / "serve.log").read_text() or child.poll())
        assert child.poll() is None, (folder / "serve.log").read_text()
        yield child
    finally:
        child.stop(LIMIT_S)


def wait_for(found: Any, limit_s: float = LIMIT_S) -> Any:
    """Return the result of `found` as soon as it is truthy."""
    end, pause = time.monotonic() + limit_s, threading.Event()
    while not (answer := found()):
        assert time.monotonic() < end, f"waited {limit_s:g} s"
        pause.wait(0.5)
    return answer


def sample(root: int, began: float) -> Iterator[list[Any]]:
    """Yield a row of `COLUMNS` of each program below a process; of `PROGRAMS` only."""
    for pid in descendants(root):
        try:
            yield [round(time.time() - began, 1), *_of_process(pid)]
        except (OSError, KeyError):  # it has just ended, or is none of `PROGRAMS`
            continue


def descendants(root: int) -> list[int]:
    """Return a process and all that it and those started."""
    parents: dict[int, list[int]] = {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = path.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        parents.setdefault(int(fields[1]), []).append(int(path.parent.name))
    found = [root]
    for pid in found:
        found += parents.get(pid, [])
    return found


def _of_process(pid: int) -> list[Any]:
    folder = Path(f"/proc/{pid}")
    words = (folder / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
    name = next((name for part, name in PROGRAMS.items() if part in words), None)
    if name is None:
        name = {"chromium": "browser"}["chromium" if "chromium" in words else ""]
    rollup = (folder / "smaps_rollup").read_text().splitlines()
    pss = next(int(line.split()[1]) for line in rollup if line.startswith("Pss:"))
    links = [os.readlink(path) for path in (folder / "fd").iterdir()]
    fields = (folder / "stat").read_text().rpartition(")")[2].split()
    processor = (int(fields[11]) + int(fields[12])) / _TICK
    sockets = sum(link.startswith("socket:") for link in links)
    return [name, pid, round(pss / 1000, 2), len(links), sockets, int(fields[17]), processor]


class Person(threading.Thread):
    """Writes notes, pauses and resumes on the page, as its forms do."""

    def __init__(self, link: str, plan: list[Window]) -> None:
        super().__init__(name="person", daemon=True)
        self._link, self._plan = link, plan
        self._over = threading.Event()
        self.done: list[tuple[str, str]] = []
        self.failed: list[str] = []

    def run(self) -> None:
        """Do one thing a window, in its middle: a pause in the third (or last), else a note."""
        pausing = self._plan[min(2, len(self._plan) - 1)]
        for number, window in enumerate(self._plan, 1):
            middle = window.begins + (window.ends - window.begins) / 3
            if self._over.wait(max((middle - datetime.now(UTC)).total_seconds(), 0.0)):
                return
            self._do("note", f"window {number}")
            if window is pausing:
                self._do("pause", "lens dirty")
                self._over.wait(PAUSED_S)
                self._do("resume", "cleaned")

    def _do(self, what: str, text: str) -> None:
        from re import search

        import httpx

        root = self._link.partition("/enter")[0]
        try:
            with httpx.Client(timeout=60, follow_redirects=False, trust_env=False) as line:
                line.get(self._link).raise_for_status()
                token = search(r'name="csrf" value="([^"]+)"', line.get(f"{root}/log").text)
                assert token is not None
                path = "log" if what == "note" else f"control/{what}"
                words = {"text": text} if what == "note" else {"why": text}
                sent = {"csrf": token[1], "who": "Anna", **words}
                answer = line.post(f"{root}/{path}", data=sent)
                assert answer.status_code == 303, answer.text
        except (httpx.HTTPError, AssertionError) as error:
            self.failed.append(f"{what}: {error!r}")
        else:
            self.done.append((what, text))

    def stop(self) -> None:
        """End it."""
        self._over.set()
        self.join(LIMIT_S)


@contextmanager
def browsing(link: str) -> Iterator[None]:
    """Chromium with the live page open."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path="/usr/bin/chromium", args=["--no-sandbox", "--disable-gpu"]
        )
        tab = browser.new_page()
        tab.goto(link)
        yield
        browser.close()


def measure(folder: Path, minutes: int, open_min: int, closed_min: int, browser: bool) -> int:
    """Serve, sample and account; return the number of things that do not hold."""
    folder.mkdir(parents=True, exist_ok=True)
    folder = folder.resolve()
    receiver = Receiver()
    began = time.time()
    plan = windows(datetime.now(UTC) + timedelta(seconds=LEAD_S), minutes, open_min, closed_min)
    with ExitStack() as stack:
        port = stack.enter_context(receiver.running())
        child = stack.enter_context(serving(folder, write_files(folder, plan, port)))
        home = folder / "store" / ".prefect"
        links = [home / f"{role}-link" for role in ("operator", "reader")]
        # the page's program starts beside the service
        wait_for(lambda: all(link.exists() for link in links))
        operator, reader = (link.read_text().strip() for link in links)
        wait_for(lambda: _answers(reader))
        pictures = stack.enter_context(watching(reader))
        if browser:
            stack.enter_context(browsing(reader))
        person = Person(operator, plan)
        person.start()
        stack.callback(person.stop)
        out = stack.enter_context((folder / "samples.csv").open("w", newline=""))
        table = csv.writer(out)
        table.writerow(COLUMNS)
        end = plan[-1].ends + timedelta(seconds=LATE_S)
        pause, counts = threading.Event(), []
        while datetime.now(UTC) < end and child.poll() is None:
            table.writerows(sample(os.getpid(), began))
            out.flush()
            counts.append(pictures())
            pause.wait(SAMPLE_S)
        alive = child.poll() is None
        # what a last window left to be said
        pause.wait(15)
    faults = [] if alive else ["the service ended by itself"]
    faults += person.failed
    if len(counts) > 1 and counts[-1] == counts[-min(len(counts), 10)]:
        faults.append("viewers got no pictures at the end")
    faults += account(folder, plan, receiver, person.done)
    report(folder, receiver, counts)
    for fault in faults:
        print(f"DOES NOT HOLD: {fault}")
    return len(faults)


def _answers(link: str) -> bool:
    import httpx

    try:
        return httpx.get(link, timeout=30, trust_env=False).status_code == 200
    except httpx.HTTPError:
        return False


def account(
    folder: Path, plan: list[Window], receiver: Receiver, done: list[tuple[str, str]]
) -> list[str]:
    """Return what is missing or too much among alerts, log and trials."""
    store, faults = TrialStore.open(folder / "store"), []
    campaigns = {item.name: item for item in store.campaigns()}
    failed = sum(
        str(e["cause"]).startswith("gate") for c in campaigns.values() for e in c.quarantined()
    )
    lines = [line for _, line in receiver.lines]
    twice = [line for line, count in Counter(lines).items() if count > 1]
    faults += [f"told twice: {line}" for line in twice]
    kinds = {"failed 1 time": failed, "paused for": 1, ": done, 36 of 36": 1, "evaluate": 1}
    for part, count in kinds.items():
        found = [line for line in lines if part in line]
        if len(found) != count:
            faults.append(f"alert '{part}': {len(found)} instead of {count}: {found[:3]}")
    others = [line for line in lines if not any(part in line for part in kinds)]
    faults += [f"unexpected alert: {line}" for line in others]
    events = [read_json(path) for path in (store.folder / "alerts").glob("*.json")]
    unsent = [event["text"] for event in events if None in event.get("sent", {}).values()]
    faults += [f"not sent: {text}" for text in unsent]
    entries = log_entries(store, faults)
    for what, text in done:
        found = [e for e in entries if (e.what, e.who, e.text) == (what, "Anna", text)]
        if len(found) != 1:
            faults.append(f"log has {what} '{text}' {len(found)} times")
    for what, count in (("session", len(plan)), ("run", len(plan) + 1), ("quarantine", failed)):
        found = [entry for entry in entries if entry.what == what]
        if len(found) != count:
            faults.append(f"log has {len(found)} x {what} instead of {count}")
    for campaign in campaigns.values():
        late = [
            path.name
            for path in campaign.folders("trials")
            if not any(
                w.begins.timestamp()
                <= (path / RECORD).stat().st_mtime
                <= w.ends.timestamp() + LATE_S
                for w in plan
            )
        ]
        faults += [f"outside of all windows: {late}"] if late else []
        print(f"{campaign.name}: {len(campaign.committed())} trials committed")
    print(f"alerts: {len(lines)} lines; pings {receiver.pings}; log: {len(entries)} lines")
    return faults


def report(folder: Path, receiver: Receiver, counts: list[int]) -> None:
    """Print first and last level, and slope an hour, of each program."""
    with (folder / "samples.csv").open() as file:
        rows = list(csv.DictReader(file))
    last = max(float(row["seconds"]) for row in rows)
    print(f"{len(rows)} rows over {last / 60:.0f} min; pictures of a viewer: {counts[-1]}")
    print(f"{'program':8} {'figure':10} {'first':>8} {'last':>8} {'largest':>8} {'slope / h':>10}")
    for name in ("service", "page", "alerts", "prefect", "browser", "run"):
        points: dict[float, dict[str, float]] = {}
        for row in rows:
            if row["program"] == name:
                sums = points.setdefault(float(row["seconds"]), dict.fromkeys(LEVELS, 0.0))
                for level in LEVELS:
                    sums[level] += float(row[level])
        for level in LEVELS if points else ():
            seconds = np.array(sorted(points))
            values = np.array([points[moment][level] for moment in seconds])
            warm = seconds > WARM_SHARE * last
            slope = np.polyfit(seconds[warm] / 3600, values[warm], 1)[0] if warm.sum() > 2 else 0.0
            print(
                f"{name:8} {level:10} {values[0]:8.1f} {values[-1]:8.1f} {values.max():8.1f} "
                f"{slope:10.2f}"
            )


def main() -> int:
    """Exit code 0 where all holds, else 1."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.nights", description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--minutes", type=int, default=120)
    parser.add_argument("--open", type=int, default=8, help="minutes of a window")
    parser.add_argument("--closed", type=int, default=2, help="minutes between two windows")
    parser.add_argument("--browser", action="store_true", help="one Chromium more")
    asked = parser.parse_args()
    return bool(measure(asked.folder, asked.minutes, asked.open, asked.closed, asked.browser))


if __name__ == "__main__":
    sys.exit(main())
