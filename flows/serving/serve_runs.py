"""How a served flow run begins and ends: with the service, with the arm first, and with a record.

Prefect kills a run with SIGTERM and would call it crashed; here it is a person's wish, which stops
the arm first and ends as CANCELLED. What went wrong is one message and no traceback.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from typing import Any

from sliplab.flows.collecting.stops import CampaignStopped, WindowOver
from sliplab.flows.planning.run_request import RunRequest
from sliplab.flows.running import console, run_records, server_calls, stopping
from sliplab.flows.running.embedded_server import die_with
from sliplab.flows.serving.serve_parameters import OnRig
from sliplab.flows.serving.serve_watch import ask_on
from sliplab.flows.serving.serve_windows import window_end
from sliplab.flows.serving.service import Service, service
from sliplab.protocols import InputError
from sliplab.rigs.core.capabilities import RigError
from sliplab.storage.errors import disk_error
from sliplab.storage.trials.lock import Locked
from sliplab.storage.trials.store import StoreError

LOOK_S = 2.0
"""How often a rig that is in use is asked for again."""
_EXPECTED = (StoreError, RigError, Locked, CampaignStopped, InputError)


def run_of(work: Callable[[Service, Any], str]) -> Any:
    """Do the work of one served flow run.

    Args:
        work: gets the service and Prefect's flow run; returns in words what it did.

    Returns:
        The state in which the run ends.
    """
    from prefect.context import FlowRunContext
    from prefect.states import Cancelled, Completed, Failed

    from sliplab.flows.running import run_events

    context = FlowRunContext.get()
    if context is None or context.flow_run is None or context.flow is None:
        raise RuntimeError("is no flow run")
    run, here, name = context.flow_run, service(), context.flow.name
    server_calls.Calls(here.server, here.folder, run).through(context.client)
    run_events.bound_exit()
    ask_on()
    run_records.begin(here.folder, str(run.id), name, here.server, here.name)
    state: Any
    try:
        with stopping.signals():
            if os.getpid() != here.pid and not die_with(here.pid):
                stopping.stop()
            try:
                state = Completed(message=work(here, run))
            except WindowOver as over:
                state = Completed(message=str(over))
    except KeyboardInterrupt:
        state = Cancelled(message="stopped, the arm first; every committed trial is kept")
    except Exception as error:
        if stopping.requested():  # compiled code that a signal interrupts has errors of its own
            state = Cancelled(message="stopped, the arm first; every committed trial is kept")
        else:
            state = Failed(message=_words(error))
            if not isinstance(error, _EXPECTED):
                console.messages.print_exception(max_frames=8)
    except BaseException as signal:
        if type(signal).__name__ == "Pause":  # Prefect's page: leave the rig, go on when resumed
            run_records.suspended(here.folder, str(run.id))
        raise
    with suppress(OSError):
        run_records.end(here.folder, str(run.id), state.type.value, state.message or "", "flow")
    console.say(f"{name} {run.name}: {state.type.value}: {state.message}")
    if os.getpid() != here.pid and os.getppid() != here.pid and here.server == run_records.EMBEDDED:
        os._exit(console.FAILED)  # the server went with the service: nobody is left to be told
    return state


def ended(flow: Any, flow_run: Any, state: Any) -> None:
    """Prefect's hook for every end, also of runs whose process could not say anything any more."""
    here = service()
    run_records.end(here.folder, str(flow_run.id), state.type.value, state.message or "", "hook")


HOOKS: dict[str, list[Any]] = {
    name: [ended] for name in ("on_completion", "on_failure", "on_cancellation", "on_crashed")
}


def until_of(wanted: OnRig, run: Any) -> float | None:
    """When the rig must be free again, seconds since 1970.

    Raises:
        WindowOver: that was before the run began.
    """
    if wanted.until is None:
        return None
    due: datetime = run.expected_start_time or run.start_time
    end = window_end(due, wanted.until, wanted.timezone)
    if datetime.now(end.tzinfo) >= end:
        raise WindowOver(f"the window ended {end:%Y-%m-%d %H:%M %Z}, before the run began")
    return end.timestamp()


def when_free(
    run_request: RunRequest, patience_s: float, work: Callable[[], dict[str, Any]], run: Any
) -> dict[str, Any]:
    """Do `work` as soon as no other program holds the store or the rig.

    Raises:
        Locked: one still does after `patience_s`.
        WindowOver: one still does when the window ends.
    """
    waited = 0.0
    while True:
        try:
            return work()
        except Locked as busy:
            if run_request.until is None and waited >= patience_s:
                raise
            if run_request.until is not None and datetime.now().timestamp() >= run_request.until:
                raise WindowOver(f"the window is over and nothing was taken: {busy}") from None
            if not waited:
                _report_waiting(run, str(busy))
        stopping.wait(LOOK_S)
        waited += LOOK_S


def _report_waiting(run: Any, why: str) -> None:
    """Show on Prefect's page that a run waits for its rig."""
    from prefect.client.orchestration import get_client
    from prefect.states import Running

    console.say(f"waiting: {why}")
    with suppress(Exception), get_client(sync_client=True) as client:
        state: Any = Running(name="WaitingForRig", message=why)
        client.set_flow_run_state(run.id, state, force=True)


def _words(error: Exception) -> str:
    name = getattr(error, "filename", None)
    if isinstance(error, OSError) and name:
        return str(disk_error(Path(os.fsdecode(name)), error) or error)
    return str(error) or type(error).__name__
