"""Messages about a store to receivers that do not always take them."""

from __future__ import annotations

import random
from collections import Counter
from datetime import UTC, datetime
from itertools import pairwise

from sliplab.flows.status import StatusReader
from sliplab.plugins.alerts.outbox import BEGAN, FOLDER
from sliplab.plugins.alerts.settings import AlertSettings, QuietHours
from sliplab.plugins.alerts.watcher import AlertWatcher
from sliplab.storage.files import read_json
from sliplab.storage.streams import Json
from sliplab.storage.trials import control
from sliplab.storage.trials.store import TrialStore
from tests.storm.virtual import Host, Notes

LOOKS, CALM_LOOKS, LOOK_S = 40, 20, 1800.0
"""How often the store is looked at, at last by receivers that take all, and how long apart, s."""


class Receiver:
    """Takes messages, but for a share of them."""

    def __init__(self, name: str, host: Host, rng: random.Random, lost: float) -> None:
        self.name, self.lost = name, lost
        self._host, self._rng = host, rng
        self.got: list[tuple[datetime, str]] = []

    def send(self, title: str, text: str) -> bool:
        """Return whether the message was taken."""
        if self._rng.random() < self.lost:
            return False
        self.got.append((_now(self._host), text))
        return True


def _now(host: Host) -> datetime:
    return datetime.fromtimestamp(host.wall_s, UTC)


def _kept(store: TrialStore) -> dict[str, Json]:
    """Return the events of the outbox by their files' names."""
    paths = (store.folder / FOLDER).glob("*.json")
    return {path.name: read_json(path) for path in paths if path.name != BEGAN}


def watch(store: TrialStore, host: Host, notes: Notes, seed: int, lost: float) -> None:
    """Look at a store for some hours; each event must reach each receiver, once and in its time."""
    quiet = QuietHours.model_validate({"from": "22:00", "until": "06:00"})
    settings = AlertSettings(to=["simulated"], quiet=quiet, most_per_hour=1)
    people = [Receiver(name, host, random.Random(seed + n), lost) for n, name in enumerate("ab")]
    before = _kept(store)
    watcher = AlertWatcher(store, settings, [*people], _now(host), lambda text: None)
    for look in range(LOOKS):
        host.wall_s += LOOK_S
        if look == LOOKS // 4:  # the program begins anew, an hour later
            host.wall_s += 3600
            watcher = AlertWatcher(store, settings, [*people], _now(host), lambda text: None)
        for person in people:
            person.lost = lost if look < LOOKS - CALM_LOOKS else 0.0
        watcher.look(_now(host))
    new = [event for name, event in _kept(store).items() if name not in before]
    wanted = Counter(event["text"] for event in new)
    calm = {event["text"] for event in new if not event["urgent"]}
    for person in people:
        lines = [(when, line) for when, text in person.got for line in text.splitlines()]
        if Counter(line for _, line in lines) != wanted:
            what = f"{sorted(line for _, line in lines)}, and not {sorted(wanted.elements())}"
            notes.add(wrong="an event is told once", what=what)
        for when, line in lines:
            if line in calm and not 6 <= when.hour < 22:
                notes.add(wrong="quiet hours are quiet", what=f"{when}: {line}")
        for (one, _), (other, _) in pairwise(person.got):
            if (other - one).total_seconds() < 3600:
                notes.add(wrong="messages are few", what=f"one at {one}, the next at {other}")
    kinds = {event["kind"] for event in _kept(store).values()}
    state = StatusReader(store).read(_now(host))
    began = datetime.fromisoformat(read_json(store.folder / FOLDER / BEGAN)["began"])
    done = any(
        each.committed
        and not each.missing
        and each.last_ended is not None
        and datetime.fromisoformat(each.last_ended) > began
        for each in state.campaigns
    )
    for kind, holds in {"paused": control.paused(store), "campaign done": done}.items():
        if holds and kind not in kinds:
            notes.add(wrong="what happens is told", what=f"nobody was told: {kind}")
    notes.add(told=len(new))
