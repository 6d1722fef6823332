"""Messages on their way, as files of the store: none is lost when a receiver or we are down.

    STORE/alerts/began.json      when alerts began: what is older is not sent
    STORE/alerts/KEY.json        an event, to whom it goes, and when each took it

An event is written before it is sent, under a name made of its key: it is sent once, however often
it is found. While the disk is full, events are in memory alone. A target that does not answer is
tried again after 10 s, 20 s and so on to 5 minutes; the others do not wait for it: each message is
sent in a thread.
"""

from __future__ import annotations

import hashlib
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path

from sliplab.plugins.alerts.conditions import Event
from sliplab.plugins.alerts.targets import Target
from sliplab.storage.files import inside, make_folder, read_json, write_json
from sliplab.storage.streams import Json
from sliplab.storage.trials.store import TrialStore

FOLDER, BEGAN = "alerts", "began.json"
EVER = datetime.min.replace(tzinfo=UTC)
FIRST_RETRY_S, LONGEST_RETRY_S = 10.0, 300.0
HOUR = timedelta(hours=1)
WAIT_S = 1.0
"""Longest wait for the targets' answers, s; later ones are found at the next look."""


class _Message(threading.Thread):
    """A message on its way to one target; a network that never answers does not delay the end.

    Attributes:
        paths: files of its events. taken: whether the target took it, once the thread has ended.
    """

    def __init__(self, target: Target, title: str, events: Mapping[Path, Json]) -> None:
        super().__init__(name="message", daemon=True)
        self._send = partial(target.send, title, _text(events.values()))
        self.paths, self.taken = list(events), False

    def run(self) -> None:
        """Send it."""
        self.taken = self._send()


@dataclass
class _Line:
    """A target, and when it is tried next."""

    target: Target
    key: str
    failures: int = 0
    next_try: datetime = EVER
    sent: list[datetime] = field(default_factory=list)
    """Of the last hour."""
    message: _Message | None = None
    """The one on its way."""


class Outbox:
    """The messages of one store.

    Args:
        most_per_hour: to each target; further ones wait and are sent as one.
        say: prints a line for the person at the terminal.
    """

    def __init__(
        self,
        store: TrialStore,
        targets: Sequence[Target],
        most_per_hour: int,
        now: datetime,
        say: Callable[[str], None],
    ) -> None:
        self._folder = inside(store.folder / FOLDER, store.folder)
        self._most, self._say, self._fault = most_per_hour, say, ""
        self._unwritten: dict[Path, Json] = {}
        self.began = now
        if (self._folder / BEGAN).exists():
            self.began = datetime.fromisoformat(read_json(self._folder / BEGAN)["began"])
        else:
            self._write(self._folder / BEGAN, {"began": _utc(now)})
        self.correct_begin(now)
        # addresses that differ in their secrets alone have one name
        names = [target.name for target in targets]
        same = [names[:k].count(name) for k, name in enumerate(names)]
        self._lines = [
            _Line(target, _digest(f"{target.name}#{k}" if k else target.name))
            for target, k in zip(targets, same, strict=True)
        ]
        files = {path: read_json(path) for path in self._files()}
        self._known = set(files)
        self._waiting = {path: data for path, data in files.items() if self._waits(data)}

    def correct_begin(self, now: datetime) -> None:
        """Begin now where alerts would begin in the future: the clock was wrong, and is right."""
        if self.began > now:
            self._say(f"the clock was set back: alerts began {_utc(now)}, not {_utc(self.began)}")
            self.began = now
            self._write(self._folder / BEGAN, {"began": _utc(now)})

    def add(self, event: Event, urgent: bool) -> bool:
        """Keep an event to be sent; False if it is known, or older than the alerts."""
        path = self._folder / f"{_digest(event.key)}.json"
        if path in self._known or event.since < self.began:
            return False
        data: Json = {
            "key": event.key,
            "kind": event.kind,
            "text": event.text,
            "when": _utc(event.since),
            "urgent": urgent,
            "sent": {line.key: None for line in self._lines},
        }
        self._known.add(path)
        self._waiting[path] = data
        self._write(path, data)
        return True

    def send(self, title: str, now: datetime, *, quiet: bool = False) -> int:
        """Send what waits, to each target that is due; return the number of messages taken.

        Args:
            quiet: only urgent ones.
        """
        for path, data in list(self._unwritten.items()):
            self._write(path, data)
        taken = self._collect(now)
        for line in self._lines:
            # neither a try nor a message in the future, where the clock was once, delays others
            line.sent = [moment for moment in line.sent if timedelta() <= now - moment < HOUR]
            waits = timedelta() < line.next_try - now <= timedelta(seconds=LONGEST_RETRY_S)
            if line.message is not None or waits or len(line.sent) >= self._most:
                continue
            events = {
                path: data
                for path, data in sorted(self._waiting.items(), key=lambda pair: pair[1]["when"])
                if _unsent(data, line) and (data["urgent"] or not quiet)
            }
            if events:
                line.message = _Message(line.target, title, events)
                line.message.start()
        end = time.monotonic() + WAIT_S
        for line in self._lines:
            if line.message is not None:
                line.message.join(max(end - time.monotonic(), 0.0))
        return taken + self._collect(now)

    def _collect(self, now: datetime) -> int:
        """Note the messages whose targets have answered; return the number of those taken."""
        done = 0
        for line in self._lines:
            message = line.message
            if message is not None and not message.is_alive():
                line.message = None
                self._note(line, message.paths, message.taken, now)
                done += message.taken
        return done

    def _note(self, line: _Line, events: list[Path], well: bool, now: datetime) -> None:
        if not well:
            wait = min(FIRST_RETRY_S * 2**line.failures, LONGEST_RETRY_S)
            line.failures += 1
            line.next_try = now + timedelta(seconds=wait)
            self._say(f"{line.target.name} did not take a message; tried again in {wait:.0f} s")
            return
        line.failures, line.next_try = 0, now
        line.sent.append(now)
        for path in events:
            data = self._waiting[path]
            data["sent"][line.key] = _utc(now)
            self._write(path, data)
            if not self._waits(data):
                del self._waiting[path]

    def _write(self, path: Path, data: Json) -> None:
        """Write a file, or keep it to be written later: a full disk is no reason to be silent."""
        self._unwritten[path] = data
        try:
            make_folder(self._folder)
            write_json(path, data)
        except OSError as error:
            if str(error.strerror) != self._fault:
                self._fault = str(error.strerror)
                self._say(f"messages are sent, but kept in memory only: {error}")
            return
        del self._unwritten[path]
        self._fault = ""

    def _waits(self, data: Json) -> bool:
        return any(_unsent(data, line) for line in self._lines)

    def _files(self) -> list[Path]:
        return sorted(path for path in self._folder.glob("*.json") if path.name != BEGAN)


def _unsent(data: Json, line: _Line) -> bool:
    """Return whether an event goes to a target that has not taken it; not to ones added later."""
    return line.key in data["sent"] and data["sent"][line.key] is None


def _text(events: Iterable[Json]) -> str:
    return "\n".join(str(data["text"]) for data in events)


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:20]


def _utc(moment: datetime) -> str:
    return moment.astimezone(UTC).isoformat(timespec="seconds")
