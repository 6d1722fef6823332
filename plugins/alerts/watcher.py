"""The program that watches a store and tells people: reads its state, keeps events, sends them."""

from __future__ import annotations

import threading
from collections.abc import Callable
from datetime import datetime
from zoneinfo import ZoneInfo

from sliplab.flows.cli.status import state_lines
from sliplab.flows.status import StatusReader, StoreStatus
from sliplab.plugins.alerts.conditions import Event, events
from sliplab.plugins.alerts.outbox import Outbox
from sliplab.plugins.alerts.settings import AlertSettings
from sliplab.plugins.alerts.targets import Target, expanded
from sliplab.storage.errors import StoreError
from sliplab.storage.trials.store import TrialStore

POLL_S = 3.0
PING_S = 3600.0
PING_LIMIT_S = 10.0
"""Longest wait for the answer to a ping."""


class AlertWatcher:
    """Watches one store.

    Args:
        say: prints a line for the person at the terminal.
        ping: fetches an address; by default over the network, in a thread.
    """

    def __init__(
        self,
        store: TrialStore,
        settings: AlertSettings,
        targets: list[Target],
        now: datetime,
        say: Callable[[str], None],
        ping: Callable[[str], None] | None = None,
    ) -> None:
        self._store, self._settings, self._say = store, settings, say
        self._reader = StatusReader(store)
        self._outbox = Outbox(store, targets, settings.most_per_hour, now, say)
        self._ping = ping or _ping
        self._pinged: datetime | None = None
        self._committed: int | None = None
        self._fault = ""

    def look(self, now: datetime) -> int:
        """Read the store, keep what is new, send what waits; return the messages taken.

        Args:
            now: local time with its zone.
        """
        self._outbox.correct_begin(now)
        try:
            state = self._reader.read(now)
            found = list(events(self._store, state, self._settings, now))
            self._fault = ""
        except (StoreError, OSError) as error:  # such as a disk that comes back
            if str(error) != self._fault:
                self._fault = str(error)
                self._say(f"cannot read the store: {error}")
            return self._send(now)
        for event in found:
            if self._outbox.add(event, event.kind in self._settings.urgent):
                self._say(f"{event.kind}: {event.text}")
        self._add_summary(state, now)
        self._ping_if_due(state, now)
        return self._send(now)

    def _send(self, now: datetime) -> int:
        quiet = self._settings.is_quiet(now)
        return self._outbox.send(f"SlipLab: {self._store.folder.name}", now, quiet=quiet)

    def _add_summary(self, state: StoreStatus, now: datetime) -> None:
        if self._settings.summary is None:
            return
        wall = now.astimezone(ZoneInfo(self._settings.timezone))
        hour, minute = map(int, self._settings.summary.split(":"))
        due = wall.replace(hour=hour, minute=minute, second=0, microsecond=0)
        if due <= wall:
            text = "\n".join(state_lines(state))
            self._outbox.add(Event(f"summary {due:%Y-%m-%d}", "summary", text, due), True)

    def _ping_if_due(self, state: StoreStatus, now: datetime) -> None:
        if self._settings.ping is None:
            return
        committed = sum(item.committed for item in state.campaigns)
        # abs: a ping in the future, where the clock was once, counts as none
        late = self._pinged is None or abs((now - self._pinged).total_seconds()) >= PING_S
        if late or committed != self._committed:
            self._pinged, self._committed = now, committed
            self._ping(expanded(self._settings.ping))


def _ping(address: str) -> None:
    """Fetch an address, in a thread: its answer is of no interest, and may never come."""
    from urllib.request import Request, urlopen

    def fetch() -> None:
        try:
            with urlopen(Request(address, method="GET"), timeout=PING_LIMIT_S) as answer:
                answer.read(1)
        except (OSError, ValueError):
            return  # the service at the other end notices that it is missing

    threading.Thread(target=fetch, name="ping", daemon=True).start()
