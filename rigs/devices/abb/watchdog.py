"""The heartbeat of the watchdog on an ABB controller: `docs/rapid/sliplab_watchdog.mod`.

A background task of the controller stops the arm when the beat has not changed for a given time.
It copies each beat that it sees, so that this host knows that the task runs. The signals are
analog outputs: writing one needs no mastership, so a beat never gets into the way of a command.
"""

from __future__ import annotations

import contextlib
import threading
import time

from sliplab.rigs.devices.abb.rws import WebError, WebRefused, WebServices
from sliplab.rigs.devices.abb.settings import AbbSettings

BEAT, ECHO, LIMIT = "sliplab_beat", "sliplab_echo", "sliplab_limit"
"""Signals: the beat; the last one that the task saw; after how many seconds it stops the arm, 0
for never. It sets the limit to 0 when it has stopped the arm."""
BEAT_S = 0.2
"""From one beat to the next, or as long as the controller takes to answer one, s."""
ECHO_S = 1.0
"""From a beat to its echo at most, s; the task looks every 0.02 s."""
_WRAP = 10_000


class Watchdog:
    """Beats for as long as it is asked to, from a thread and over a session of its own.

    Args:
        settings: the arm's.
        limit_s: how long the beat may stay away before the controller stops the arm, s.
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
        """Beat from now on, and see that the controller's task watches.

        Takes at most 4 requests and `ECHO_S`.

        Args:
            web: another session, so that beats need not wait for what is asked here.

        Raises:
            WebRefused: the controller has no such task, or it does not run.
            WebError: no answer.
        """
        first = self._beat()
        self._begun = self._beating = True
        if not self._thread.is_alive():
            self._thread.start()
        web.write_signal(LIMIT, self._limit_s)
        deadline = time.monotonic() + ECHO_S
        while (web.read_signal(ECHO) - first) % _WRAP >= _WRAP / 2:
            if time.monotonic() > deadline:
                raise WebRefused(f"{ECHO} does not follow {BEAT}: its task does not run")

    def pause(self) -> None:
        """Beat no more: if it stays so, the controller stops the arm."""
        self._beating = False

    def resume(self) -> None:
        """Beat again; a task that has stopped the arm meanwhile watches from `begin` on."""
        self._beating = self._begun

    def stopped_it(self, web: WebServices) -> bool:
        """Return whether the controller has stopped the arm for want of a beat. Raises WebError."""
        return web.read_signal(LIMIT) == 0

    def close(self, watch: bool) -> None:
        """Beat no more and log out; takes at most 5 requests.

        Args:
            watch: leave the task watching, which stops the arm if it still moves.
        """
        self._beating = False
        self._closing.set()
        if self._thread.is_alive():
            self._thread.join()
        if self._begun and not watch:
            with contextlib.suppress(WebError):  # then it runs out, and finds an arm that stands
                self._web.write_signal(LIMIT, 0.0)
        self._web.close()

    def _work(self) -> None:
        wait_s = 0.0
        while not self._closing.wait(wait_s):
            began = time.monotonic()
            if self._beating:
                with contextlib.suppress(WebError):  # the monitor tells of a lost link
                    self._beat()
            wait_s = max(0.0, BEAT_S - (time.monotonic() - began))

    def _beat(self) -> int:
        with self._counting:
            self._count = (self._count + 1) % _WRAP
            self._web.write_signal(BEAT, float(self._count))
            return self._count
