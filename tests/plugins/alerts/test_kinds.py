"""Each kind of alert, a row a kind: received by a web and a mail server, once, whatever is down."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any
from uuid import uuid4

import pytest

from sliplab.flows.running import run_records
from sliplab.flows.status import StatusReader, StoreStatus
from sliplab.plugins.alerts import watcher
from sliplab.plugins.alerts.settings import KINDS
from sliplab.plugins.alerts.targets import AppriseTarget
from sliplab.plugins.alerts.watcher import POLL_S, AlertWatcher
from sliplab.storage.files import read_json, write_json
from sliplab.storage.trials import control
from sliplab.storage.trials.checksums import RECORD
from sliplab.storage.trials.store import TrialStore
from tests.plugins.alerts.receivers import http_server, mail_server
from tests.plugins.alerts.test_alerts import RUNNING, Receiver, settings, state
from tests.rigs.waiting import free_port
from tests.storage.trial_files import campaign, commit, fail

WITHIN_S = 10.0
DOWN_S = 300
Cause = Callable[[TrialStore], StoreStatus]
"""Lets something happen in a store, and returns its state then."""


@dataclass(frozen=True)
class Row:
    """A kind of alert.

    Attributes:
        text: part of its message.
        later_s: from its cause until it is due.
        urgent: sent in quiet hours, too.
    """

    kind: str
    cause: Cause
    text: str
    later_s: float = 0.0
    urgent: bool = False


def run_fails(store: TrialStore) -> StoreStatus:
    run = str(uuid4())
    run_records.begin(store.folder, run, "collect", run_records.EMBEDDED, "nightly")
    run_records.end(store.folder, run, "FAILED", "the arm did not answer", "flow")
    return state()


def pause(store: TrialStore) -> StoreStatus:
    control.ask(store, "pause", who="anna", why="lunch")
    return state()


def set_aside(store: TrialStore) -> StoreStatus:
    for attempt in (1, 2, 3):
        fail(store.campaign("tiny"), "b", attempt)
    return state()


def grade_falls(store: TrialStore) -> StoreStatus:
    for name, grade in (("t0", "digital input"), ("t1", "host time")):
        path = commit(store.campaign("tiny"), name) / RECORD
        record = read_json(path)
        record["clocks"]["arm"]["grade"] = grade
        write_json(path, record)
    return state()


def idle(store: TrialStore) -> StoreStatus:
    since = datetime.now().astimezone().isoformat()
    item = replace(RUNNING, last_ended=since, drift=[], nights_of_disk=None)
    return state(collects="tiny", since=since, campaigns=[item])


def drift(store: TrialStore) -> StoreStatus:
    return state(campaigns=[replace(RUNNING, nights_of_disk=None)])


def disk(store: TrialStore) -> StoreStatus:
    return state(campaigns=[replace(RUNNING, drift=[])])


def done(store: TrialStore) -> StoreStatus:
    ended = (datetime.now().astimezone() + timedelta(seconds=1)).isoformat()
    item = replace(RUNNING, missing=0, planned=4, drift=[], nights_of_disk=None, last_ended=ended)
    return state(campaigns=[item])


TABLE = (
    Row("run failed", run_fails, "collect of nightly failed: the arm did not", urgent=True),
    Row("paused", pause, "paused for 30 min (pause by anna", later_s=1801),
    Row("trial set aside", set_aside, "tiny: b failed 3 times"),
    Row("drift", drift, "drift of event_rate at the reference trial r2: -17.0 %"),
    Row("disk", disk, "the disk has room for 1.0 nights", urgent=True),
    Row("idle", idle, "has committed no trial for 60 min", later_s=3601, urgent=True),
    Row("clock grade", grade_falls, "from digital input to host time with trial t1"),
    Row("campaign done", done, "tiny (simulated): done, 4 of 4 trials"),
)
ROWS = pytest.mark.parametrize("row", TABLE, ids=lambda row: row.kind)


class Case:
    """A store in which something has happened since alerts began, and its watchers.

    Attributes:
        now: the injected clock; `look` moves it on by the period of the program.
    """

    def __init__(self, row: Row, folder: Path, patch: pytest.MonkeyPatch) -> None:
        campaign(folder / "s", "tiny")
        self.store = TrialStore.open(folder / "s")
        self.now = datetime.now().astimezone() - timedelta(seconds=2)
        self.watch([])  # alerts begin
        found = row.cause(self.store)
        patch.setattr(StatusReader, "read", lambda reader, now: found)
        self.now += timedelta(seconds=2 + row.later_s)

    def watch(self, targets: list[Any], **changes: Any) -> AlertWatcher:
        """A program that watches the store, as it is after a start."""
        self.watcher = AlertWatcher(
            self.store, settings(**changes), targets, self.now, lambda text: None
        )
        return self.watcher

    def look(self, seconds: float = POLL_S) -> None:
        """Look as often as the program does in so many seconds."""
        end = self.now + timedelta(seconds=seconds)
        while self.now < end:
            self.watcher.look(self.now)
            self.now += timedelta(seconds=POLL_S)


def mail(port: int) -> str:
    return f"mailto://127.0.0.1:{port}/?from=lab@example.org&to=anna@example.org"


def test_table_has_every_kind() -> None:
    assert [row.kind for row in TABLE] == list(KINDS)
    assert {row.kind for row in TABLE if row.urgent} == set(settings().urgent)


@pytest.mark.quick(4)
@ROWS
def test_received_within_ten_seconds_and_once(
    row: Row, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    case = Case(row, tmp_path, monkeypatch)
    with http_server() as (web, posted), mail_server() as (port, mails):
        case.watch([AppriseTarget(f"json://127.0.0.1:{web}"), AppriseTarget(mail(port))])
        began = time.monotonic()
        while not (posted and mails):
            case.look()
            assert time.monotonic() - began < WITHIN_S - POLL_S
        case.look(60)
        case.watch([AppriseTarget(f"json://127.0.0.1:{web}"), AppriseTarget(mail(port))])
        case.look(15)  # after another start
    assert (len(posted), len(mails)) == (1, 1)
    assert row.text in posted[0]["message"]
    assert row.text in mails[0]


@pytest.mark.quick(2)
@ROWS
def test_not_lost_while_receivers_are_down_for_five_minutes(
    row: Row, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nor when the program that sends is ended and started again meanwhile."""
    case = Case(row, tmp_path, monkeypatch)
    web, port = free_port(), free_port()
    addresses = f"json://127.0.0.1:{web}", mail(port)
    case.watch([AppriseTarget(address) for address in addresses])
    case.look(DOWN_S / 2)
    case.watch([AppriseTarget(address) for address in addresses])
    case.look(DOWN_S / 2)
    with http_server(web) as (_, posted), mail_server(port) as (_, mails):
        case.look(330)  # tried again after 300 s at the latest
    assert (len(posted), len(mails)) == (1, 1)
    assert row.text in posted[0]["message"]
    assert row.text in mails[0]


@pytest.mark.quick(2)
@ROWS
def test_quiet_hours_hold_what_is_not_urgent(
    row: Row, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    case, receiver = Case(row, tmp_path, monkeypatch), Receiver()
    ends = case.now + timedelta(minutes=10)
    begins = case.now - timedelta(minutes=10)
    zone = {"timezone": "UTC"}
    utc = [moment.astimezone().utctimetuple() for moment in (begins, ends)]
    hours = [f"{moment.tm_hour:02}:{moment.tm_min:02}" for moment in utc]
    case.watch([receiver], quiet={"from": hours[0], "until": hours[1]}, **zone)
    case.look(300)
    assert len(receiver.taken) == (1 if row.urgent else 0)
    case.look(600)
    assert len(receiver.taken) == 1
    assert row.text in receiver.taken[0]


def test_morning_summary_is_sent_once_a_day_though_the_receiver_was_down(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    case, receiver = Case(TABLE[0], tmp_path, monkeypatch), Receiver(up=False)
    due = (case.now + timedelta(days=1)).replace(hour=7, minute=30, second=0, microsecond=0)
    zone = {"timezone": "UTC", "quiet": {"from": "22:00", "until": "07:00"}, "about": ["paused"]}
    offset = case.now.utcoffset() or timedelta()
    hour = (due - offset).strftime("%H:%M")
    case.now = due - timedelta(seconds=30)
    case.watch([receiver], summary=hour, **zone)
    receiver.up = True
    case.look(30)
    assert receiver.taken == []
    receiver.up = False
    case.look(DOWN_S)
    receiver.up = True
    case.look(600)
    assert len(receiver.taken) == 1
    assert "nothing runs" in receiver.taken[0]
    case.now += timedelta(days=1)
    case.look(60)
    assert len(receiver.taken) == 2


def test_dead_man_ping_is_fetched_within_ten_seconds_of_a_trial_and_delays_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    case = Case(TABLE[0], tmp_path, monkeypatch)
    committed = iter(range(100))
    monkeypatch.setattr(
        StatusReader,
        "read",
        lambda reader, now: state(campaigns=[replace(RUNNING, committed=next(committed) // 2)]),
    )
    monkeypatch.setattr(watcher, "PING_LIMIT_S", 1.0)
    ping = f"http://127.0.0.1:{free_port()}/down"
    case.watch([Receiver()], ping=ping, about=["paused"])
    began = time.monotonic()
    case.look(60)
    assert time.monotonic() - began < WITHIN_S  # nobody answers
    with http_server() as (web, fetched):
        case.watch([Receiver()], ping=f"http://127.0.0.1:{web}/alive", about=["paused"])
        began, pause = time.monotonic(), threading.Event()
        case.look(5 * POLL_S)  # a start and two trials
        while len(fetched) < 3:
            assert time.monotonic() - began < WITHIN_S
            pause.wait(0.01)
    assert fetched == ["/alive"] * 3
