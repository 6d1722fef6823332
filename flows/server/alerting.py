"""Runs the program that sends a service's alerts as a child, so that nothing waits for it."""

from __future__ import annotations

import asyncio
import sys
from contextlib import suppress
from pathlib import Path

from sliplab.flows.running import console
from sliplab.storage.process import Child, start_tethered

AGAIN_S = 60.0
"""Wait before it is started again, s."""
END_S = 5.0
"""Longest wait for its end, s."""


async def keep_alerting(store: Path, file: Path | None, stopped: asyncio.Event) -> None:
    """Run `sliplab alerts` until `stopped`; start it again when it has ended by itself.

    Args:
        file: has the section ``alerts:``; None to do nothing.
    """
    while file is not None and not stopped.is_set():
        try:
            child = start_tethered(
                [sys.executable, "-m", "sliplab", "alerts", str(store), str(file)]
            )
        except OSError as error:
            console.say(f"warning: alerts do not start: {error}")
        else:
            await _ended(child, stopped)
        with suppress(TimeoutError):
            await asyncio.wait_for(stopped.wait(), AGAIN_S)


async def _ended(child: Child, stopped: asyncio.Event) -> None:
    """Wait for the child's end, or end it when the service stops."""
    ending = asyncio.create_task(asyncio.to_thread(child.wait))
    stopping = asyncio.create_task(stopped.wait())
    await asyncio.wait([ending, stopping], return_when=asyncio.FIRST_COMPLETED)
    if ending.done():
        console.say(f"alerts ended with exit code {child.returncode}; they are started again")
    else:
        await asyncio.to_thread(child.stop, END_S)
    await ending
    stopping.cancel()
