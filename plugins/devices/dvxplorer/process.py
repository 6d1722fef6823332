"""dv-processing in a child process, so that its hanging constructors and crashes do no harm.

Observed with 2.0.4: the network reader holds Python's interpreter lock while it connects and waits
for a header without a timeout, so Ctrl-C does nothing; and an invalid packet terminates the process
(`terminate called after throwing`), which would include the arm's driver. Here only a child ends.
"""

from __future__ import annotations

import os
import signal
import time
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import Any

from sliplab.plugins.devices.dvxplorer.settings import DvxplorerSettings
from sliplab.plugins.devices.dvxplorer.source import DEVICE, EventBatch, open_source
from sliplab.rigs.core.capabilities import DeviceHealth
from sliplab.rigs.core.library_process import LibraryProcess, of_device
from sliplab.storage.streams import Json

OPEN_S = 20.0
"""Timeout for the process to start and to open a camera or streams, s."""
ANSWER_S = 5.0
"""Timeout of a call; the library answers at once, s."""
WAIT_S = 0.005
"""Time for which a poll waits for data, s."""
_POLL_S = 0.001
_SELF_END_S = 30.0
"""Time after the parent's timeout at which the child ends itself, s; only without a parent."""
_CLOSE_S = 2.0
"""Timeout for the library to close the camera, s."""


class EventProcess:
    """A `plugins.devices.dvxplorer.source.DvxEventSource` in a child process.

    Attributes:
        name: model and serial number, or the name in the stream's header.
        resolution: columns and rows.
        in_force: active settings as the camera reports them.

    Raises:
        RigError: no such camera or stream, one that does not send events and triggers, or a
            timeout.
    """

    def __init__(self, settings: DvxplorerSettings) -> None:
        self._process = of_device(
            DEVICE,
            lambda: LibraryProcess(
                "dv-processing",
                "sliplab.plugins.devices.dvxplorer.process:serve",
                (settings.model_dump_json(), OPEN_S),
                OPEN_S,
                ignore_suspend=True,
            ),
        )
        self.name: str
        self.resolution: tuple[int, int]
        self.in_force: Json
        self.name, self.resolution, self.in_force = self._process.begun

    def run(self, on: bool, noise_filter_us: int | None = None) -> None:
        """Switch a camera's events and its trigger input on or off. Raises RigError."""
        self._call("run", on, noise_filter_us)

    def poll(self) -> EventBatch:
        """Read all available data. Raises RigError if the library failed, died or hangs."""
        found: EventBatch = self._call("poll")
        return found

    def health(self, settings: DvxplorerSettings) -> DeviceHealth:
        """Return the health report of the camera, or of the stream. Raises RigError."""
        found: DeviceHealth = self._call("health", settings)
        return found

    def close(self) -> None:
        """End the process; safe to call more than once."""
        self._process.end()

    def _call(self, name: str, *arguments: Any) -> Any:
        return of_device(DEVICE, lambda: self._process.call(name, *arguments, within_s=ANSWER_S))


def serve(fd: int, settings_json: str, start_s: float) -> None:
    """Run the child: serve calls from the pipe on `fd` until it closes.

    A kernel timer ends it if a call exceeds its timeout, which needs no interpreter lock.
    """
    pipe = Connection(fd)
    signal.setitimer(signal.ITIMER_REAL, start_s + _SELF_END_S)
    settings = DvxplorerSettings.model_validate_json(settings_json)
    try:
        source = open_source(settings.source)
    except Exception as error:
        with suppress(OSError):
            pipe.send((False, str(error)))
        os._exit(1)
    with suppress(EOFError, OSError):
        pipe.send((True, (source.name, source.resolution, source.in_force)))
        while True:
            signal.setitimer(signal.ITIMER_REAL, 0)
            name, arguments, within_s = pipe.recv()
            signal.setitimer(signal.ITIMER_REAL, within_s + _SELF_END_S)
            try:
                answer = (True, getattr(source, name)(*arguments))
                end = time.monotonic() + WAIT_S
                # a short wait for data here costs less than another call
                while name == "poll" and answer[1].empty and answer[1].running:
                    if time.monotonic() > end or pipe.poll(_POLL_S):
                        break
                    answer = (True, source.poll())
            except Exception as error:
                answer = (False, str(error))
            pipe.send(answer)
    signal.setitimer(signal.ITIMER_REAL, _CLOSE_S)
    with suppress(Exception):
        source.run(False)
    del source  # the library closes inputs on deletion
    os._exit(0)
