"""How states of task runs reach Prefect's server: in small batches, only the newest of each run.

Prefect sends an event for every state of a task run (pending, running, completed), and the server
keeps each one. For a trial of 50 ms that costs more than the trial. Here they are held for a
moment; of a run that went through several states meanwhile the last one is sent, which says when it
began and ended. What takes longer than `HELD_S` is shown as it always was. That a run is pending is
never sent: here each task begins as soon as it is called.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator
from concurrent.futures import CancelledError
from contextlib import asynccontextmanager, suppress
from typing import Any

import prefect.events.utilities
import prefect.task_engine
from prefect.events.clients import NullEventsClient
from prefect.events.schemas.events import Event
from prefect.events.worker import EventsWorker

from sliplab.flows.running import server_calls

HELD_S = 0.25
MOST = 100
"""Task runs that are held at once."""
EXIT_S = 5.0
"""How long the end of the program waits for events that a server has not taken yet."""
EXIT_LOST_S = 0.2
_TASK_RUN = "prefect.task-run."


class BatchingWorker(EventsWorker):
    """Prefect's own worker, which all events pass, with a short queue before its client."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self._held: dict[str, Event] = {}
        self._timer: asyncio.TimerHandle | None = None
        self._later: asyncio.Task[None] | None = None
        self._sending: asyncio.Lock | None = None

    @asynccontextmanager
    async def _lifespan(self) -> AsyncGenerator[None, None]:
        self._sending = asyncio.Lock()  # belongs to the loop that runs now
        async with super()._lifespan():
            try:
                yield
            finally:
                if self._timer is not None:
                    self._timer.cancel()
                await self._send()

    async def _handle(self, event: Event) -> None:
        if not event.event.startswith(_TASK_RUN):
            await self._send()
            await super()._handle(event)
            return
        before = self._held.pop(event.resource.id, None)
        if before is not None:
            self._context_cache.pop(before.id, None)
            # a server that takes events in their order must not wait for one that never comes
            event = event.model_copy(update={"follows": before.follows})
        self._held[event.resource.id] = event
        if len(self._held) >= MOST:
            await self._send()
        elif self._timer is None:
            self._timer = asyncio.get_running_loop().call_later(HELD_S, self._begin_to_send)

    def _begin_to_send(self) -> None:
        self._timer = None
        self._later = asyncio.create_task(self._send_later())

    async def _send_later(self) -> None:
        with suppress(Exception):  # a server that is lost is said elsewhere
            await self._send()

    async def _send(self) -> None:
        assert self._sending is not None
        async with self._sending:
            while self._held:
                await super()._handle(self._held.pop(next(iter(self._held))))


_engine: Any = prefect.task_engine
_emitter: Any = prefect.events.utilities
_emit = _engine.emit_task_run_state_change_event


def _emit_but_pending(
    task_run: Any, initial_state: Any, validated_state: Any, follows: Event | None = None
) -> Event | None:
    if initial_state is None:
        return None
    event: Event | None = _emit(task_run, initial_state, validated_state, follows)
    return event


_drain: Any = EventsWorker.drain


def _drain_at_exit(self: Any, at_exit: bool = False) -> Any:
    """Prefect's own, which knows no limit: at the program's end a server is not waited for long."""
    if not at_exit:
        return _drain(self)
    limit_s = EXIT_LOST_S if server_calls.lost() else EXIT_S
    with suppress(TimeoutError, CancelledError):
        self._drain(at_exit=True).result(limit_s)
    return True


def install(silent: bool = False) -> None:
    """Have the events of this process go that way.

    Args:
        silent: there is no server: they go nowhere.
    """
    bound_exit()
    BatchingWorker.set_client_override(NullEventsClient if silent else None)
    _emitter.EventsWorker = BatchingWorker
    _engine.emit_task_run_state_change_event = _emit_but_pending


def bound_exit() -> None:
    """Have the end of this process wait for a few seconds at most until its events are sent."""
    worker: Any = EventsWorker
    worker.drain = _drain_at_exit


def renew() -> None:
    """Let go of the connection to a server that is no more; the next event makes another one."""
    EventsWorker.drain_all(timeout=EXIT_LOST_S, at_exit=False)
