"""Pause, resume and stop from Prefect's page: carried out in the program that serves, at once.

Prefect's runner starts a process for every run, which takes seconds to load. A word to an arm that
moves must not wait for that, nor behind the collection it is meant for.
"""

from __future__ import annotations

import asyncio
import contextvars
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from datetime import UTC, datetime
from typing import Any
from uuid import UUID

from sliplab.flows.running import console, stopping

MOST_AT_ONCE = 16


async def answer_page(deployments: Mapping[UUID, Any], poll_s: float, over: asyncio.Event) -> None:
    """Run the flows of `deployments` whenever the page asks for one, until `over`.

    Args:
        deployments: each one's flow.
        poll_s: how often the server is asked, s. One that does not answer is asked again.
    """
    from prefect.client.orchestration import get_client

    begun: dict[UUID, asyncio.Future[None]] = {}
    loop = asyncio.get_running_loop()
    with ThreadPoolExecutor(MOST_AT_ONCE, "page") as threads:
        try:
            async with get_client() as client:
                while not over.is_set():
                    runs: Iterable[Any] = ()
                    with suppress(Exception):
                        runs = await client.get_scheduled_flow_runs_for_deployments(
                            list(deployments), scheduled_before=datetime.now(UTC)
                        )
                    begun = {run: work for run, work in begun.items() if not work.done()}
                    for run in runs:
                        if run.id not in begun:
                            context = contextvars.copy_context()  # Prefect's settings
                            begun[run.id] = loop.run_in_executor(
                                threads, context.run, _run, deployments[run.deployment_id], run
                            )
                    with suppress(TimeoutError):
                        await asyncio.wait_for(over.wait(), poll_s)
        finally:
            stopping.request()  # those that wait for a trial's end do not hold the program's up


def _run(flow: Any, run: Any) -> None:
    """One run to its end; how it ended is its state."""
    from prefect.flow_engine import run_flow

    try:
        run_flow(flow, flow_run=run, return_type="state")
    except BaseException as error:  # a thread has nobody to raise to
        console.say(f"{run.name}: {error or type(error).__name__}")
