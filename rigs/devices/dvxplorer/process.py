"""dv-processing in a process of its own: its constructors can be ended, its crashes are errors.

Tried with 2.0.4: the network reader holds Python's lock while it connects and waits for a header
without a deadline, so Ctrl-C does nothing; and a packet that is none ends the process (`terminate
called after throwing`), with the arm's driver in it. Here that is a child's end.
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import Any

from sliplab.rigs.core.capabilities import DeviceHealth, RigError
from sliplab.rigs.core.library_process import LibraryError, LibraryProcess
from sliplab.rigs.devices.dvxplorer.settings import DvxplorerSettings
from sliplab.rigs.devices.dvxplorer.source import DEVICE, Look, open_source
from sliplab.storage.streams import Json

OPEN_S = 20.0
"""The longest that the process may take to begin and to open a camera or streams, s."""
ANSWER_S = 5.0
"""The library, which answers at once, must have answered by then, s."""
WAIT_S = 0.005
"""A look that would find nothing waits for so long that something comes, s."""
_LOOK_S = 0.001
_SELF_END_S = 30.0
"""Time after its parent's bound at which the child ends itself, s; only without a parent."""
_CLOSE_S = 2.0
"""Time limit for the library to close the camera, s."""


class EventProcess:
    """A `rigs.devices.dvxplorer.source.EventSource` in a process of its own.

    Attributes:
        name: model and serial number, or what the stream says of itself.
        resolution: columns and rows.
        in_force: settings as the camera says them.

    Raises:
        RigError: nothing there, or nothing that sends events and triggers, or too slow.
    """

    def __init__(self, settings: DvxplorerSettings) -> None:
        self._process = _raised(
            lambda: LibraryProcess(
                "dv-processing",
                "sliplab.rigs.devices.dvxplorer.process:serve",
                (settings.model_dump_json(), OPEN_S),
                OPEN_S,
                patient=True,
            )
        )
        self.name: str
        self.resolution: tuple[int, int]
        self.in_force: Json
        self.name, self.resolution, self.in_force = self._process.begun

    def run(self, on: bool, noise_filter_us: int | None = None) -> None:
        """Switch a camera's events and its trigger input. Raises RigError."""
        self._call("run", on, noise_filter_us)

    def look(self) -> Look:
        """Take all that has come. Raises RigError where the library failed, died or hangs."""
        found: Look = self._call("look")
        return found

    def health(self, settings: DvxplorerSettings) -> DeviceHealth:
        """Return the report of the camera, or of the stream. Raises RigError."""
        found: DeviceHealth = self._call("health", settings)
        return found

    def close(self) -> None:
        """End the process; any number of times."""
        self._process.end()

    def _call(self, name: str, *arguments: Any) -> Any:
        return _raised(lambda: self._process.call(name, *arguments, within_s=ANSWER_S))


def _raised(work: Callable[[], Any]) -> Any:
    try:
        return work()
    except LibraryError as error:
        # the call is ours, the reason is what a person needs
        reason = str(error).partition(": ")[2]
        raise RigError(DEVICE, reason.removeprefix(f"{DEVICE}: ")) from None


def serve(fd: int, settings_json: str, start_s: float) -> None:
    """The child: take calls from the pipe on `fd` until it closes.

    A timer of the kernel ends it if a call outlives its bound: that needs no lock of Python's.
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
                # what comes next is worth a short wait here: it costs less than to be asked again
                while name == "look" and answer[1].empty and answer[1].running:
                    if time.monotonic() > end or pipe.poll(_LOOK_S):
                        break
                    answer = (True, source.look())
            except Exception as error:
                answer = (False, str(error))
            pipe.send(answer)
    signal.setitimer(signal.ITIMER_REAL, _CLOSE_S)
    with suppress(Exception):
        source.run(False)
    del source  # the library closes what nobody holds any more
    os._exit(0)
