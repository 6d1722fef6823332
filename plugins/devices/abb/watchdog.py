"""The heartbeat for the watchdog on an ABB controller, `docs/rapid/sliplab_watchdog.mod`.

A background task of the controller stops the arm when the heartbeat signal has not changed for a
given time. It echoes each value, so that this host knows that the task is running. The signals are
analog outputs: writing one needs no mastership, so the heartbeat never interferes with commands.
"""

from __future__ import annotations

import contextlib
import threading
import time

from sliplab.plugins.devices.abb.rws import WebError, WebRefused, WebServices
from sliplab.plugins.devices.abb.settings import AbbSettings

BEAT, ECHO, LIMIT = "sliplab_beat", "sliplab_echo", "sliplab_limit"
"""Signals: the heartbeat; its echo by the task; the timeout after which the task stops the arm, s,
0 for never. The task sets the timeout to 0 when it has stopped the arm."""
BEAT_S = 0.2
"""Period of the heartbeat, or the controller's answer time if longer, s."""
ECHO_S = 1.0
"""Timeout from a heartbeat to its echo, s; the task's cycle is 0.02 s."""
_WRAP = 10_000


class Watchdog:
    """Sends the heartbeat from a separate thread and over a separate session.

    Args:
        settings: settings of the arm.
        limit_s: time without a heartbeat after which the controller stops the arm, s.
    """

    def __init__(self, settings: AbbSettings, limit_s: float) -> None:
        self._web = WebServices(settings)
        self._limit_s = limit_s
        self._count = int(time.monotonic() * 10) % _WRAP  # differs from an earlier client's last
        self._counting = threading.Lock()
        self._begun = self._beating = False
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._work, daemon=True)

    def begin(self, web: WebServices) -> None:
        """Start the heartbeat, and check that the controller's task is active.

        Takes at most 5 requests and `ECHO_S`. An echo from before does not count: signals
        keep their values when a task has ended.

        Args:
            web: another session, so that these requests do not delay the heartbeat.

        Raises:
            WebRefused: the controller has no such task, or it is not running.
            WebError: no answer.
        """
        before = web.read_signal(ECHO)
        first = self._beat()
        self._begun = self._beating = True
        if not self._thread.is_alive():
            self._thread.start()
        web.write_signal(LIMIT, self._limit_s)
        deadline = time.monotonic() + ECHO_S
        while (echo := web.read_signal(ECHO)) == before or not (echo - first) % _WRAP < _WRAP / 2:
            if time.monotonic() > deadline:
                raise WebRefused(f"{ECHO} does not follow {BEAT}: the task is not running")

    def pause(self) -> None:
        """Suspend the heartbeat; unless it resumes, the controller stops the arm."""
        self._beating = False

    def resume(self) -> None:
        """Resume the heartbeat; a task that has stopped the arm meanwhile needs `begin`."""
        self._beating = self._begun

    def stopped_it(self, web: WebServices) -> bool:
        """Return whether the watchdog task has stopped the arm. Raises WebError."""
        return not web.read_signal(LIMIT) > 0

    def close(self, watch: bool) -> None:
        """End the heartbeat and log out; takes at most 5 requests.

        Args:
            watch: True to leave the task active, so that it stops an arm that still moves.
        """
        self._beating = False
        self._closing.set()
        if self._thread.is_alive():
            self._thread.join()
        if self._begun and not watch:
            with contextlib.suppress(WebError):  # then the timeout expires with the arm at rest
                self._web.write_signal(LIMIT, 0.0)
        self._web.close()

    def _work(self) -> None:
        wait_s = 0.0
        while not self._closing.wait(wait_s):
            began = time.monotonic()
            if self._beating:
                with contextlib.suppress(WebError):  # the monitor reports a lost connection
                    self._beat()
            wait_s = max(0.0, BEAT_S - (time.monotonic() - began))

    def _beat(self) -> int:
        with self._counting:
            self._count = (self._count + 1) % _WRAP
            self._web.write_signal(BEAT, float(self._count))
            return self._count
