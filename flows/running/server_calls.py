"""Calls to Prefect's server that no campaign waits for: each has a limit, and an answer without it.

Prefect's engine calls its server when a flow run begins and when it ends. One that stands still, is
gone or cannot write would hold a flow up for minutes, and Ctrl-C with it. Here these calls are made
in a thread of their own. Where no answer comes in time, the engine gets the one that a server would
have given, and the flow goes on: the store says what is done. One line says so. An end that was not
delivered is kept in the store (`run_records`), and the next command reports it.

Between a run's begin and its end nothing here is called: states of tasks are events, which Prefect
sends in the background (`run_events`).
"""

from __future__ import annotations

import contextvars
import queue
import threading
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any
from uuid import UUID, uuid4

from sliplab.flows.running import console, run_records, stopping

BEGIN_S = 15.0
"""How long the begin of a run waits for an answer; no arm moves yet."""
END_S = 5.0
"""How long its end does."""
LOST_S = 0.5
"""How long each does once the server was lost, or when a stop was requested."""
NOWHERE = "http://127.0.0.1:9/api"
"""The address that Prefect has where no server could be started; it is never called."""

_current: Calls | None = None
_said: set[str] = set()
"""Servers of which the line was said; one that answers again is taken out."""


def lost() -> bool:
    """Whether the server of the flow that runs now, or ran last, did not answer."""
    return _current is not None and _current.lost


def lose(reason: str) -> None:
    """Say that the server of the flow that runs now does not answer."""
    if _current is not None:
        _current.lose(reason)


def was_lost(server: str) -> bool:
    """Whether a server was lost and has not answered since."""
    return server in _said


def forget(server: str) -> None:
    """Note that a server answers, or is another one now."""
    _said.discard(server)


class Calls:
    """The calls of one flow run, made one after the other by a daemon thread.

    Args:
        server: as `run_records.server_name` calls it.
        store: where an end that could not be reported is kept; None keeps none.
        run: the flow run, if it has begun.
    """

    def __init__(self, server: str, store: Path | None, run: Any = None) -> None:
        global _current
        self._server, self._store, self._run = server, store, run
        self._known = run is not None
        self.nobody = False
        """There is no server."""
        self._jobs: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None
        self.lost = server in _said
        _current = self

    def absent(self, reason: str) -> None:
        """Have every call answered here: there is no server."""
        self.nobody = True
        self.lose(reason)

    def through(self, client: Any) -> None:
        """Have a Prefect client's calls about flow runs made here; `client` is changed in place."""
        answers: dict[str, Callable[..., Any]] = {
            "create_flow_run": self._create,
            "read_flow_run": self._read,
            "set_flow_run_state": self._set,
            "update_flow_run": _nothing,
            "update_flow_run_labels": _nothing,
            "set_flow_run_name": _nothing,
            "raise_for_api_version_mismatch_once": _nothing,
        }
        for name, answer in answers.items():
            setattr(client, name, partial(self._call, name, getattr(client, name), answer))

    def close_dead(self) -> None:
        """Close what killed processes left open on the server, as far as it answers."""
        if self._store is not None:
            closing = partial(run_records.close_dead, self._store, self._server)
            self._call("close", closing, _nothing)

    def __enter__(self) -> Calls:
        """Itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """End the thread, once what it is at is done."""
        self._jobs.put(None)

    def lose(self, reason: str) -> None:
        """Note that the server does not answer, and say so once."""
        self.lost = True
        if self._server not in _said:
            _said.add(self._server)
            name = "" if self._server == run_records.EMBEDDED else f" {self._server}"
            console.say(
                f"warning: the Prefect server{name} does not answer ({reason}); the work goes on "
                "without it, the store keeps everything, and the next command reports this run"
            )

    def _call(self, name: str, real: Any, answer: Callable[..., Any], *args: Any, **kw: Any) -> Any:
        if self.nobody:
            return answer(*args, **kw)
        given_up = threading.Event()
        context = contextvars.copy_context()  # Prefect's settings stand in there
        outcome: Future[Any] = Future()

        def job() -> None:
            try:
                found = context.run(real, *args, **kw)
            except BaseException as error:  # whatever it is belongs to who waits for it
                outcome.set_exception(error)
                return
            outcome.set_result(found)
            if name == "create_flow_run" and given_up.is_set():
                with suppress(Exception):  # else it would be pending there for ever
                    context.run(real.__self__.delete_flow_run, found.id)

        self._put(job)
        limit_s = self._limit_s(name, *args, **kw)
        try:
            found = outcome.result(limit_s)
        except TimeoutError:
            given_up.set()
            self.lose(f"nothing came in {limit_s:g} s")
        except Exception as error:
            self.lose(reason_of(error))
        else:
            self.lost = False
            forget(self._server)
            if name in {"create_flow_run", "read_flow_run"}:
                self._run, self._known = found, True
            return found
        return answer(*args, **kw)

    def _put(self, job: Callable[[], None]) -> None:
        if self._thread is None:
            self._thread = threading.Thread(target=self._work, name="server calls", daemon=True)
            self._thread.start()
        self._jobs.put(job)

    def _work(self) -> None:
        while (job := self._jobs.get()) is not None:
            job()

    def _limit_s(self, name: str, *args: Any, **kw: Any) -> float:
        if self.lost or stopping.requested():
            return LOST_S
        ends = name == "set_flow_run_state" and _state(*args, **kw).is_final()
        return END_S if ends else BEGIN_S

    def _create(self, flow: Any, **kw: Any) -> Any:
        from prefect.client.schemas import FlowRun

        self._run = FlowRun(
            flow_id=uuid4(), name="without a server", state=kw.get("state"), parameters={}
        )
        return self._run

    def _read(self, run: UUID) -> Any:
        return self._run

    def _set(self, run: UUID, state: Any, force: bool = False) -> Any:
        from prefect.client.schemas import OrchestrationResult
        from prefect.client.schemas.responses import SetStateStatus, StateAcceptDetails

        if state.is_final() and self._known and self._store is not None:
            with suppress(OSError):
                run_records.owe(self._store, str(run), state.type.value, state.message or "")
        return OrchestrationResult(
            status=SetStateStatus.ACCEPT, state=state, details=StateAcceptDetails()
        )


def _state(run: UUID, state: Any, force: bool = False) -> Any:
    return state


def _nothing(*args: Any, **kw: Any) -> None:
    return None


def reason_of(error: BaseException) -> str:
    """Return an error and what caused it as one line."""
    text = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
    cause = error.__cause__
    more = "" if cause is None or str(cause) in text else f" ({type(cause).__name__}: {cause})"
    return " ".join(f"{text}{more}".split())[:300]
