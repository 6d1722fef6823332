"""Runs that come due at a page whose answers get lost: its clients and processes, simulated."""

from __future__ import annotations

import asyncio
import os
import random
from concurrent.futures import Executor, Future
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from uuid import UUID
from zoneinfo import ZoneInfo

from prefect.client.schemas.responses import SetStateStatus
from prefect.states import Cancelled, Cancelling, Completed, Running, Scheduled

from sliplab.flows.running import run_records
from sliplab.plugins.web.server import runs, schedules
from sliplab.plugins.web.server.runs import ServedRuns
from sliplab.plugins.web.server.service import Service
from tests.patching import put
from tests.storm.virtual import Notes

POLL_S = 1.0
STOP_LIMIT_S = 30.0
"""Time that a run has to stop its arm and end."""
BEGIN_S = 1000.0
CALM_S = 250
"""Until when runs come due and answers get lost."""
LONGEST_S = 6000
"""Until all of them have ended, and the service, too."""
ZONES = ("UTC", "Europe/Rome", "America/New_York")


class _Here(Executor):
    """Carries out what is submitted at once."""

    def submit(self, work: Any, /, *given: Any, **named: Any) -> Future[Any]:
        """Return what is done already."""
        done: Future[Any] = Future()
        done.set_result(work(*given, **named))
        return done


@dataclass
class _Process:
    """A process of one run: it reports its state while it lives.

    Attributes:
        ends_s: when it ends by itself. silent: it is killed, and says nothing. deaf: to a signal.
        stops_s: how long it takes to stop. said: how it said that it ended.
    """

    run: Any
    ends_s: float
    silent: bool
    deaf: bool
    stops_s: float
    said: str = ""
    returncode: int | None = None
    asked_s: float | None = None


class Page:
    """A server that keeps runs, and the clock of all that happens here.

    Args:
        lost: share of its answers that are lost, before or after they had effect.
        store: where ends are recorded.
    """

    def __init__(self, rng: random.Random, notes: Notes, store: Path, lost: float) -> None:
        self._rng, self._notes, self._store, self.lost = rng, notes, store, lost
        self.now_s = BEGIN_S
        self.runs: dict[UUID, Any] = {}
        self.processes: list[_Process] = []

    def due(self, deployment: UUID) -> None:
        """Let a run come due."""
        made = UUID(int=self._rng.getrandbits(128), version=4)
        made_run = SimpleNamespace(id=made, deployment_id=deployment, name=f"run {len(self.runs)}")
        made_run.run_count, made_run.auto_scheduled, made_run.tags = 0, False, []
        made_run.expected_start_time = datetime.fromtimestamp(self.now_s, UTC)
        made_run.state = Scheduled()
        self.runs[made] = made_run

    def _may_be_lost(self) -> None:
        if self._rng.random() < self.lost:
            raise TimeoutError("the page does not answer")

    async def get_scheduled_flow_runs_for_deployments(
        self, deployments: list[UUID], scheduled_before: datetime
    ) -> list[Any]:
        """Return the runs that are due."""
        self._may_be_lost()
        return [run for run in self.runs.values() if run.state.is_scheduled()]

    async def read_flow_run(self, run: UUID) -> Any:
        """Return a run as it is known."""
        self._may_be_lost()
        return SimpleNamespace(**vars(self.runs[run]))

    async def set_flow_run_state(self, run: UUID, state: Any, force: bool = False) -> Any:
        """Take a run's new state."""
        self._may_be_lost()
        self.runs[run].state = state
        self._may_be_lost()
        return SimpleNamespace(status=SetStateStatus.ACCEPT)

    async def start(self, *command: str, **options: Any) -> Any:
        """Start a process: `asyncio.create_subprocess_exec` here."""
        run, rng = self.runs[UUID(command[4])], self._rng
        if any(each.returncode is None for each in self.processes):
            self.wrong("one run at a time is on the rig", run.name)
        if any(each.run is run for each in self.processes):
            self.wrong("a run is carried out once", run.name)
        ends_s = self.now_s + rng.uniform(1, 40)
        if not run.state.is_pending():
            self.wrong("what is cancelled is not begun", f"{run.name} is {run.state.type.value}")
        silent, deaf = rng.random() < 0.2, rng.random() < 0.3
        made = _Process(run, ends_s, silent, deaf, rng.choice([0.0, 0.0, 3.0, 20.0]))
        self.processes.append(made)
        run.state = Running()
        run_records.begin(self._store, str(run.id), command[5], "http://page", "")
        page = self

        class Shown:
            returncode = property(lambda shown: made.returncode)

            def terminate(self) -> None:
                made.asked_s = page.now_s if made.asked_s is None else made.asked_s
                if not made.deaf and not made.stops_s:
                    page.end(made, "CANCELLED", -15)

            def kill(self) -> None:
                if made.asked_s is None or page.now_s - made.asked_s < STOP_LIMIT_S - 1:
                    page.wrong("a run has its time to stop the arm", run.name)
                page.end(made, "", -9)

            async def wait(self) -> None:
                page.tick()
                if made.returncode is None:
                    raise TimeoutError

        return Shown()

    def end(self, process: _Process, state: str, code: int) -> None:
        """End a process, which records how unless it was killed."""
        if process.returncode is not None:
            return
        process.returncode, process.said = code, state
        if state:
            run_records.end(self._store, str(process.run.id), state, "it says so", "it")

    def tick(self) -> None:
        """Let a second pass."""
        self.now_s += POLL_S
        if self.now_s > BEGIN_S + LONGEST_S:
            self.wrong("waits are bounded", f"{LONGEST_S} s and no end")
            os._exit(97)
        for process in self.processes:
            if process.returncode is not None:
                continue
            asked_s = process.asked_s
            if asked_s is not None and process.deaf:
                continue  # it hangs in its stop
            if self.now_s > process.ends_s:
                if process.silent:
                    self.end(process, "", -9)
                else:
                    self.end(process, "COMPLETED", 0)
                    if self._rng.random() < 0.7:  # else the page was lost to it, too
                        process.run.state = Completed()
            elif asked_s is not None and self.now_s >= asked_s + process.stops_s:
                self.end(process, "CANCELLED", -15)

    def cancel(self) -> None:
        """A person cancels a run that is on the rig, or is to be."""
        for run in self.runs.values():
            if run.state.is_pending() and not any(each.run is run for each in self.processes):
                run.state = Cancelled()
        for process in self.processes:
            if process.returncode is None and process.run.state.is_running():
                process.run.state = Cancelling()

    def wrong(self, invariant: str, what: str) -> None:
        """Note a fault."""
        self._notes.add(wrong=invariant, what=what)


async def _play(page: Page, served: ServedRuns, rig: UUID, words: UUID, rng: random.Random) -> None:
    answered: list[str] = []
    runs._carry_out_here = lambda flow, run: (  # type: ignore[assignment]
        answered.append(run.name),
        setattr(page.runs[run.id], "state", Completed()),
    )
    threads: Any = _Here()
    for second in range(CALM_S + 60 * 40):
        calm = second > CALM_S
        if calm and all(run.state.is_final() for run in page.runs.values()):
            break
        page.lost = 0.0 if calm else page.lost
        if not calm and rng.random() < 0.05:
            page.due(rig if rng.random() < 0.7 else words)
        if not calm and rng.random() < 0.02:
            page.cancel()
        page.tick()
        with suppress(TimeoutError):
            await served._look(page, threads)
        await asyncio.sleep(0)
        for process in page.processes:
            late = process.asked_s is not None and page.now_s - process.asked_s > 2 * STOP_LIMIT_S
            if calm and late and process.returncode is None:
                page.wrong("a run that is cancelled ends", process.run.name)
    for run in page.runs.values():
        if not run.state.is_final():
            page.wrong("every run comes to an end", f"{run.name} is {run.state.type.value}")
            continue
        known = run_records.end_of(page._store, str(run.id))
        if known is not None and known["state"] != run.state.type.value:
            what = f"{run.name} is {run.state.type.value}, it ended as {known['state']}"
            page.wrong("the page says how a run ended", what)
    for process in page.processes:
        state = process.run.state.type.value
        if process.said not in {"", state}:
            what = f"{process.run.name} is {state}, it ended as {process.said}"
            page.wrong("the page says how a run ended", what)
    if len({*answered}) != len(answered):
        page.wrong("a run is carried out once", f"{answered}")
    page.lost = 0.0
    page.due(rig)  # while it is carried out, the service ends
    for _ in range(3):
        page.tick()
        await served._look(page, threads)
    await served._stop()
    for process in page.processes:
        if process.returncode is None:
            page.wrong("a service ends with its run", process.run.name)


def _close_left(page: Page, store: Path, rig: UUID, rng: random.Random) -> None:
    """What a killed program left is closed by the next start, on its own server alone."""
    put(run_records, "is_here", lambda process: False)
    wanted: dict[UUID, str] = {}
    for _ in range(4):
        page.due(rig)
        run = [*page.runs.values()][-1]
        kind, server = rng.choice(("killed", "owed", "told")), rng.choice(("page", "other"))
        run_records.begin(store, str(run.id), "collect", f"http://{server}")
        run.state = Completed() if kind == "told" else Running()
        wanted[run.id] = "RUNNING" if server == "other" and kind != "told" else "COMPLETED"
        if kind != "killed":
            run_records.end(store, str(run.id), "COMPLETED", "it says so", "it")
        elif server == "page":
            wanted[run.id] = "CRASHED"
        if kind == "owed":
            run_records.record_undelivered_end(store, str(run.id), "COMPLETED", "it says so")

    def report(run: str, state: Any, force: bool) -> None:
        page.runs[UUID(run)].state = state

    client = SimpleNamespace(
        read_flow_run=lambda run: page.runs[UUID(run)], set_flow_run_state=report
    )
    run_records.close_killed_runs(store, "http://page", client)
    for made, state in wanted.items():
        known = page.runs[made].state.type.value
        ended = (run_records.end_of(store, str(made)) or {"state": "RUNNING"})["state"]
        if known != state or (state == "CRASHED") != (ended == "CRASHED"):
            page.wrong("what was killed is closed", f"{known}, {ended}, and not {state}")


def serve(store: Path, notes: Notes, seed: int, lost: float) -> None:
    """Let runs come due, be cancelled and end, while the page is lost and comes back."""
    rng = random.Random(seed)
    _check_windows(rng, notes)
    _check_begins(rng, notes)
    page = Page(rng, notes, store, lost)
    put(runs, "monotonic", lambda: page.now_s)
    runs.asyncio = SimpleNamespace(  # type: ignore[attr-defined]
        **{**vars(asyncio), "create_subprocess_exec": page.start}
    )
    put(runs, "service", lambda: Service(str(store), "rig.yaml", "storm", "here", 1, ()))
    rig, words = (UUID(int=rng.getrandbits(128), version=4) for _ in range(2))
    flow = SimpleNamespace(name="collect")
    served = ServedRuns(store, {rig: flow}, {words: flow})
    asyncio.run(_play(page, served, rig, words, rng))
    _close_left(page, store, rig, rng)
    notes.add(served=len(page.runs))


def _check_windows(rng: random.Random, notes: Notes) -> None:
    """Ends of windows, against a search by half hours, at which each of these windows ends."""
    for _ in range(5):
        due = datetime.fromtimestamp(1_795_000_020 + 60 * rng.randrange(600_000), UTC)
        zone, day = rng.choice(ZONES), rng.choice(["", "", rng.choice(schedules.DAYS)])
        clock = f"{rng.choice([0, 3, 6, 22]):02d}:{rng.choice([0, 30]):02d}"
        found = schedules.window_end(due, f"{day} {clock}".strip(), zone)
        moment = due + timedelta(minutes=30 - due.minute % 30)
        while True:
            wall = moment.astimezone(ZoneInfo(zone))
            if f"{wall:%H:%M}" == clock and day in {"", schedules.DAYS[wall.weekday()]}:
                break
            moment += timedelta(minutes=30)
        if found.timestamp() != moment.timestamp():
            notes.add(wrong="a window ends as it says", what=f"{due} {day} {clock} {zone}: {found}")


def _check_begins(rng: random.Random, notes: Notes) -> None:
    """Begins of windows, against a search by half hours."""
    due = datetime.fromtimestamp(1_795_000_020 + 60 * rng.randrange(600_000), UTC)
    days, zone = rng.sample(schedules.DAYS, 2), rng.choice(ZONES)
    clock = f"{rng.choice([6, 22]):02d}:{rng.choice([0, 30]):02d}"
    cron = schedules.cron_of(days, clock)
    item = schedules.Scheduled(
        name="nights", flow="collect", cron=cron, timezone=zone, active=True, parameters={}
    )
    found = [each.timestamp() for each in schedules._runs_of(item, 3, due)]
    moment, wanted = due + timedelta(minutes=30 - due.minute % 30), list[float]()
    while len(wanted) < 3:
        wall = moment.astimezone(ZoneInfo(zone))
        if f"{wall:%H:%M}" == clock and schedules.DAYS[wall.weekday()] in days:
            wanted.append(moment.timestamp())
        moment += timedelta(minutes=30)
    if found != wanted:
        notes.add(wrong="a window begins as it says", what=f"{due} {days} {clock} {zone}")
