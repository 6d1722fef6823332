"""Programs beside a service, such as alerts and the web page: children, so that nothing waits."""

from __future__ import annotations

import asyncio
import sys
from collections.abc import Sequence
from contextlib import suppress

from sliplab.flows.running import console
from sliplab.storage.process import Child, start_tethered

END_S = 5.0
"""Longest wait for its end, s."""


async def keep_running(command: Sequence[str], stopped: asyncio.Event, *, again_s: float) -> None:
    """Run `sliplab COMMAND` until `stopped`; start it again when it has ended by itself.

    Args:
        command: its words after ``sliplab``.
        again_s: wait before it is started again, s.
    """
    while not stopped.is_set():
        try:
            child = start_tethered([sys.executable, "-m", "sliplab", *command])
        except OSError as error:
            console.say(f"warning: {command[0]} does not start: {error}")
        else:
            await _ended(child, command[0], stopped)
        with suppress(TimeoutError):
            await asyncio.wait_for(stopped.wait(), again_s)


async def _ended(child: Child, name: str, stopped: asyncio.Event) -> None:
    """Wait for the child's end, or end it when the service stops."""
    ending = asyncio.create_task(asyncio.to_thread(child.wait))
    stopping = asyncio.create_task(stopped.wait())
    await asyncio.wait([ending, stopping], return_when=asyncio.FIRST_COMPLETED)
    if ending.done():
        console.say(f"{name} ended with exit code {child.returncode}; it is started again")
    else:
        await asyncio.to_thread(child.stop, END_S)
    await ending
    stopping.cancel()
