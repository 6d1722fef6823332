"""Runs started from Prefect's page: one at a time on the rig, stop requests at once.

The service looks for runs that are due. One that moves the arm, or needs all cores, is carried out
in a process of its own (`python -m sliplab.plugins.web.server.runs ID FLOW`), which ends with the
service. Pause, resume and stop are carried out in threads of the service: they must wait neither
for a process to load nor behind the collection that they are meant for.
"""

from __future__ import annotations

import asyncio
import contextvars
import json
import os
import socket
import sys
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from time import monotonic
from typing import Any
from uuid import UUID

from sliplab.flows.collecting.live_feed import WAITING, LiveFolder
from sliplab.flows.running import console, orchestration, run_records, stopping
from sliplab.flows.running.process import collect_garbage_seldom
from sliplab.plugins.web.server.schedules import Scheduled, begin_of_run
from sliplab.plugins.web.server.service import service
from sliplab.plugins.web.server.waiting_runs import cancel, is_by_schedule, moves_arm
from sliplab.storage.process import this_process
from sliplab.storage.streams import Json
from sliplab.storage.trials.control import ControlRequest, last_number, stop_after
from sliplab.storage.trials.store import TrialStore

MOST_AT_ONCE = 16
"""Requests to the arm that run at the same time."""
DISK_S = 5.0
"""Longest wait for the store's disk, s: a run must be cancelled also where it does not answer."""
STOP_LIMIT_S = 30.0
"""Time in which a run must stop its arm and end, s; it is killed then."""


class ServedRuns:
    """The runs of one service.

    Args:
        store: its folder.
        on_rig: the flow of each deployment whose runs go to a process, one at a time.
        control: the flow of each deployment whose runs go to a thread.
        schedules: those of the service.
    """

    def __init__(
        self,
        store: Path,
        on_rig: Mapping[UUID, Any],
        control: Mapping[UUID, Any],
        schedules: Sequence[Scheduled] = (),
    ) -> None:
        self._store = store
        self._on_rig, self._control = on_rig, control
        self._schedules = schedules
        self._run: Any = None
        self._asked: Any = None
        self._since = self._looked = last_number(TrialStore(store))
        self._moving = {run for run, flow in on_rig.items() if moves_arm(flow)}
        self._live = LiveFolder(store)
        self._shown: list[Json] | None = None
        self._process: asyncio.subprocess.Process | None = None
        self._stop_by: float | None = None
        self._words: dict[UUID, asyncio.Future[None]] = {}
        self._stops: list[asyncio.Future[None]] = []
        self._seen: set[UUID] = set()

    async def carry_out(self, poll_s: float, over: asyncio.Event) -> None:
        """Carry out what the page asks for until `over`; then what runs is stopped, arm first.

        Args:
            poll_s: how often the server is asked, s.
        """
        from prefect.client.orchestration import get_client

        ending = asyncio.create_task(over.wait())
        with ThreadPoolExecutor(MOST_AT_ONCE, "page") as threads:
            try:
                async with get_client() as client:
                    while not over.is_set():
                        looking = asyncio.create_task(self._look(client, threads))
                        await asyncio.wait({looking, ending}, return_when=asyncio.FIRST_COMPLETED)
                        looking.cancel()
                        with suppress(Exception, asyncio.CancelledError):
                            await looking
                        await asyncio.wait({ending}, timeout=poll_s)
                    await self._stop()  # the arm first
                    with suppress(Exception):  # of a lost server; the next start looks again
                        for run in await self._due(client):
                            if run.deployment_id in self._moving:
                                await cancel(client, run, "the service ended before it began")
                await self._show([])
            finally:
                stopping.request()  # requests that wait for a trial's end do not delay the end

    async def _look(self, client: Any, threads: ThreadPoolExecutor) -> None:
        """Check the run on the rig, and start due runs."""
        self._words = {run: word for run, word in self._words.items() if not word.done()}
        self._stops = [stop for stop in self._stops if not stop.done()]
        due = await self._due(client)
        for run in due:  # first: a stop must wait neither for the store's disk nor for other runs
            if run.deployment_id in self._control and run.id not in self._words:
                flow, context = self._control[run.deployment_id], contextvars.copy_context()
                self._words[run.id] = asyncio.get_running_loop().run_in_executor(
                    threads, context.run, _carry_out_here, flow, run
                )
                if flow.name == "stop":
                    self._stops.append(self._words[run.id])
        if self._process is not None:
            await self._supervise(client)
        if self._asked is not None and self._process is None:
            run = await client.read_flow_run(self._asked.id)
            self._asked = None
            if run.state.is_pending():
                await self._start(run)
        due = [run for run in due if run.deployment_id in self._on_rig]
        held = bool(self._stops)  # one that is not among the store's requests yet
        try:
            due = await self._without_stopped(client, due)
        except OSError:  # the disk's, or that it does not answer: a stop may be unread
            held = True
        waiting = []
        for run in due:
            if held or self._process is not None:
                waiting.append(run)
            else:
                by_schedule = is_by_schedule(run)
                begins = await begin_of_run(run, self._schedules) if by_schedule else None
                if begins is None or begins <= datetime.now(UTC):
                    await self._begin(client, run)
        await self._show(waiting if self._process is None else [self._run, *waiting])

    async def _due(self, client: Any) -> list[Any]:
        found: list[Any] = await client.get_scheduled_flow_runs_for_deployments(
            [*self._on_rig, *self._control], scheduled_before=datetime.now(UTC)
        )
        return found

    async def _without_stopped(self, client: Any, due: list[Any]) -> list[Any]:
        """Cancel what would move the arm after a person's stop; return the other runs."""
        async with asyncio.timeout(DISK_S):
            number, stop = await asyncio.to_thread(self._requests)
        left = []
        for run in due:
            later = stop is None or (run.id not in self._seen and _is_later(run, stop))
            if later or run.deployment_id not in self._moving:
                left.append(run)
            else:
                await cancel(client, run, f"with the {stop}")
        self._looked = max(number, stop.number if stop else 0)
        self._seen = {run.id for run in left}  # a stop that comes now is meant for these
        return left

    def _requests(self) -> tuple[int, ControlRequest | None]:
        """Return the number of the last request, and the last stop that was not looked at yet."""
        store = TrialStore(self._store)
        return last_number(store), stop_after(store, self._looked)

    async def _show(self, runs: list[Any]) -> None:
        """Tell the live page which runs have begun or wait."""
        shown: list[Json] = [
            {
                "flow": self._on_rig[run.deployment_id].name,
                "due": run.expected_start_time.isoformat(),
                "begun": run is self._run,
            }
            for run in runs
            if run.deployment_id in self._moving
        ]
        if self._moving and shown != self._shown:
            content = {"process": this_process(), "runs": shown}
            # of a full disk; the next look tries again
            with suppress(OSError, TimeoutError):
                async with asyncio.timeout(DISK_S):
                    await asyncio.to_thread(self._live.write, WAITING, json.dumps(content))
                    self._shown = shown

    async def _begin(self, client: Any, run: Any) -> None:
        from prefect.client.schemas.responses import SetStateStatus
        from prefect.states import Pending

        # a later stop ends it: its process takes seconds to start, and no signal reaches it
        self._since = self._looked
        self._asked = run  # whose answer may be lost: it would stay pending for ever
        answer = await client.set_flow_run_state(run.id, Pending())
        self._asked = None
        if answer.status is SetStateStatus.ACCEPT:
            await self._start(run)

    async def _start(self, run: Any) -> None:
        """Start the process of a pending run."""
        environment = {**os.environ, **replace(service(), since=self._since).environment()}
        command = (sys.executable, "-P", "-m", "sliplab.plugins.web.server.runs", str(run.id))
        self._run, self._stop_by = run, None
        self._process = await asyncio.create_subprocess_exec(
            *command, self._on_rig[run.deployment_id].name, env=environment, start_new_session=True
        )

    async def _supervise(self, client: Any) -> None:
        """Stop the run on the rig if the page cancels it; once it has ended, close it."""
        assert self._process is not None
        state = (await client.read_flow_run(self._run.id)).state
        if self._process.returncode is None:
            if state.is_cancelling():
                self._terminate()
            return
        if not (state.is_final() or state.is_paused() or state.is_scheduled()):
            await self._close(client, cancelled=state.is_cancelling())
        self._process = None

    def _terminate(self) -> None:
        assert self._process is not None
        with suppress(ProcessLookupError):
            if self._stop_by is None:
                self._stop_by = monotonic() + STOP_LIMIT_S
                self._process.terminate()
            elif monotonic() > self._stop_by:
                self._process.kill()

    async def _close(self, client: Any, *, cancelled: bool) -> None:
        """Close a run whose process ended without the server knowing how it ended."""
        from prefect.client.schemas.objects import State, StateType
        from prefect.states import Cancelled, Crashed

        assert self._process is not None
        run = str(self._run.id)
        async with asyncio.timeout(DISK_S):
            retained = await asyncio.to_thread(run_records.end_of, self._store, run)
        if retained is not None:
            state: Any = State(type=StateType(retained["state"]), message=retained["message"])
        elif cancelled:
            state = Cancelled(message="stopped before it started")
        else:
            state = Crashed(message=f"its process was killed ({self._process.returncode})")
        await client.set_flow_run_state(self._run.id, state, force=True)
        async with asyncio.timeout(DISK_S):
            await asyncio.to_thread(self._record_end, run, state)

    def _record_end(self, run: str, state: Any) -> None:
        run_records.end(self._store, run, state.type.value, state.message, "service")
        run_records.delivered(self._store, run)

    async def _stop(self) -> None:
        """End what runs; its process says itself how it ended."""
        while self._process is not None and self._process.returncode is None:
            self._terminate()
            with suppress(TimeoutError):
                await asyncio.wait_for(self._process.wait(), 1.0)


def _is_later(run: Any, stop: ControlRequest) -> bool:
    """Return whether a run was surely created after a stop; `when` is in whole seconds."""
    try:
        when = datetime.fromisoformat(stop.when)
        after = latest = when + timedelta(seconds=1)
        if stop.moment and when <= (moment := datetime.fromisoformat(stop.moment)) < latest:
            after = moment
        return stop.host == socket.gethostname() and bool(run.created >= after)
    except (ValueError, TypeError):  # it is none, or has no zone
        return False


def _carry_out_here(flow: Any, run: Any) -> None:
    """Carry out one run to its end; how it ended is its state."""
    from prefect.flow_engine import run_flow

    try:
        run_flow(flow, flow_run=run, return_type="state")
    except BaseException as error:  # a thread has no caller to raise to
        console.say(f"{run.name}: {error or type(error).__name__}")


def _carry_out(run_id: str, flow_name: str) -> None:
    """Execute one run in this process; its end is stored and reported to the server."""
    collect_garbage_seldom()
    orchestration.hide_what_a_lost_server_leaves()
    from prefect.exceptions import Abort, Pause
    from prefect.flow_engine import run_flow
    from prefect.settings import temporary_settings

    from sliplab.plugins.web.server.deployments import BESIDE, ON_RIG

    (flow,) = (flow for flow in (*ON_RIG, *BESIDE) if flow.name == flow_name)
    here = service()
    link = orchestration.ServerLink(here.server)
    with temporary_settings(updates=orchestration.limited_settings()), link.client() as client:
        run = client.read_flow_run(UUID(run_id))
        try:
            run_flow(flow, flow_run=run, return_type="state")
        except (Abort, Pause):
            pass  # the server requested it
        except Exception as error:
            link.mark_lost(error)
            if (retained := run_records.end_of(here.folder, run_id)) is not None:
                run_records.record_undelivered_end(
                    here.folder, run_id, retained["state"], retained["message"]
                )
    if not orchestration.close():
        os._exit(0)


if __name__ == "__main__":
    _carry_out(*sys.argv[1:])
