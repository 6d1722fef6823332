"""A signal at any moment of a flow run is Ctrl-C, whatever handler Prefect has installed."""

from __future__ import annotations

import os
import signal
from typing import Any

import pytest
from prefect import flow, task
from prefect.cache_policies import NO_CACHE
from prefect.flow_engine import FlowRunEngine

from sliplab.flows.running import stopping
from sliplab.flows.running.orchestration import run

SIGNALS = [signal.SIGINT, signal.SIGTERM]


def send(number: int) -> None:
    os.kill(os.getpid(), number)


@task(name="interrupted", cache_policy=NO_CACHE, persist_result=False)
def interrupted_task(number: int) -> None:
    """Send a signal to its own process."""
    send(number)


@flow(name="interrupted", validate_parameters=False, persist_result=False)
def interrupted_flow(number: int, in_task: bool) -> str:
    """Send a signal to its own process, in a task or not."""
    if in_task:
        interrupted_task(number)
    else:
        send(number)
    return "not reached"


@flow(name="quiet", validate_parameters=False, persist_result=False)
def quiet_flow(argument: str) -> str:
    """Return its argument."""
    return argument


@pytest.mark.parametrize("in_task", [False, True])
@pytest.mark.parametrize("number", SIGNALS)
def test_signal_in_the_work_raises_keyboard_interrupt(number: int, in_task: bool) -> None:
    with stopping.signals(), pytest.raises(KeyboardInterrupt):
        run(interrupted_flow, number, in_task)


@pytest.mark.parametrize("name", ["begin_run", "handle_success", "_report_attempt_conclusion"])
@pytest.mark.parametrize("number", SIGNALS)
def test_signal_in_prefects_engine_raises_keyboard_interrupt(
    number: int, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    original = getattr(FlowRunEngine, name)

    def method(*arguments: Any, **options: Any) -> Any:
        result = original(*arguments, **options)
        monkeypatch.setattr(FlowRunEngine, name, original)
        send(number)
        return result

    monkeypatch.setattr(FlowRunEngine, name, method)
    with stopping.signals(), pytest.raises(KeyboardInterrupt):
        run(quiet_flow, "done")
