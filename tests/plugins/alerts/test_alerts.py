"""Alerts: each kind once, none lost while a receiver is down, none before it may be sent."""

from __future__ import annotations

import errno
import os
import threading
import time
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any
from uuid import uuid4

import pytest
import yaml

from sliplab.flows.running import run_records, stopping
from sliplab.flows.status import CampaignStatus, DriftStatus, NightsLeft, StoreStatus
from sliplab.plugins.alerts import outbox
from sliplab.plugins.alerts.conditions import Event, events
from sliplab.plugins.alerts.outbox import Outbox
from sliplab.plugins.alerts.settings import KINDS, AlertSettings, load_alerts
from sliplab.plugins.alerts.targets import AppriseTarget
from sliplab.plugins.alerts.watcher import AlertWatcher
from sliplab.plugins.web.server.schedules import has_alerts
from sliplab.protocols import InputError
from sliplab.protocols.yaml_file import mask_secrets
from sliplab.rigs.rig_file import load_rig_file, same_rig
from sliplab.storage.files import read_json, write_json
from sliplab.storage.trials import control, lock
from sliplab.storage.trials.checksums import RECORD
from sliplab.storage.trials.store import TrialStore
from tests.command_line import here
from tests.conftest import ROOT
from tests.plugins.alerts.receivers import http_server, mail_server
from tests.storage.trial_files import campaign, commit, fail

NOW = datetime(2030, 3, 2, 22, 0, tzinfo=UTC)


class Receiver:
    """Takes messages, or does not."""

    def __init__(self, name: str = "json://here", up: bool = True) -> None:
        self.name, self.up = name, up
        self.taken: list[str] = []
        self.tried = 0

    def send(self, title: str, text: str) -> bool:
        self.tried += 1
        if self.up:
            self.taken.append(text)
        return self.up


def settings(**changes: Any) -> AlertSettings:
    return AlertSettings.model_validate({"to": ["json://localhost"], **changes})


def state(**changes: Any) -> StoreStatus:
    one = StoreStatus(
        store="s",
        running=None,
        since=None,
        collects=None,
        paused=None,
        disk_free=10**9,
        campaigns=[],
        imported=[],
    )
    return replace(one, **changes)


def found(store: TrialStore, at: StoreStatus, now: datetime = NOW, **changes: Any) -> list[Event]:
    return list(events(store, at, settings(**changes), now))


def watcher(
    store: TrialStore, receivers: list[Receiver], now: datetime = NOW, **changes: Any
) -> tuple[AlertWatcher, list[str]]:
    pinged: list[str] = []
    made = AlertWatcher(
        store, settings(**changes), list(receivers), now, lambda text: None, pinged.append
    )
    return made, pinged


RUNNING = CampaignStatus(
    "tiny",
    True,
    planned=10,
    committed=4,
    missing=6,
    last_ended="2030-03-02T20:00:00+00:00",
    bytes_per_trial=10**9,
    nights_of_disk=1.0,
    nights_left=NightsLeft(2, None, None, "2030-03-03", "2030-03-03"),
    drift=[DriftStatus("event_rate", -17.0, 20.0, "r2")],
)


def test_each_kind_is_found_and_named(tmp_path: Path) -> None:
    tiny = campaign(tmp_path / "s", "tiny")
    store = TrialStore.open(tmp_path / "s")
    run = str(uuid4())
    run_records.begin(store.folder, run, "collect", run_records.EMBEDDED, "nightly")
    run_records.end(store.folder, run, "FAILED", "the arm did not answer", "flow")
    by_hand = str(uuid4())
    run_records.begin(store.folder, by_hand, "label", run_records.EMBEDDED)
    run_records.end(store.folder, by_hand, "CRASHED", "KeyboardInterrupt: ", "flow")
    lost = str(uuid4())
    run_records.begin(store.folder, lost, "chain", run_records.EMBEDDED)
    over = f"the window is over and {run_records.NOTHING_TAKEN}: in use by ben"
    run_records.end(store.folder, lost, "COMPLETED", over, "flow")
    control.ask(store, "pause", who="anna", why="lunch")
    for attempt in (1, 2):
        fail(tiny, "b", attempt)
    for number, grade in enumerate(("digital input", "host time")):
        folder = commit(tiny, f"t{number}")
        record = read_json(folder / RECORD)
        record["clocks"]["arm"]["grade"] = grade
        write_json(folder / RECORD, record)
    at = state(campaigns=[RUNNING], collects="tiny", since="2030-03-02T19:00:00+00:00")
    done = state(campaigns=[replace(RUNNING, missing=0, planned=4, nights_of_disk=None)])
    texts = {item.kind: item.text for item in [*found(store, at), *found(store, done)]}
    assert set(texts) == set(KINDS)
    fault = "collect of nightly failed: the arm did not answer"
    assert "pause by anna" in texts["paused"]
    assert "event_rate at the reference trial r2: -17.0 %" in texts["drift"]
    assert "no trial for 120 min" in texts["idle"]
    assert "from digital input to host time with trial t1" in texts["clock grade"]
    assert "b failed 2 times" in texts["trial set aside"]
    assert texts["campaign done"] == "tiny (simulated): done, 4 of 4 trials"
    failed = [item.text for item in found(store, at) if item.kind == "run failed"]
    # not the one that a person stopped
    assert sorted(failed) == [f"chain completed: {over}", fault]
    few = found(store, at, about=["disk"])
    assert [item.kind for item in few] == ["disk"]


@pytest.mark.parametrize(
    ("changes", "at"),
    [
        ({"idle_min": 121}, state(campaigns=[RUNNING], collects="tiny", since="2030-03-02T19:00Z")),
        ({}, state(campaigns=[RUNNING], collects="tiny", since="2030-03-02T21:30Z")),
        ({}, state(campaigns=[RUNNING], collects="tiny", since="2030-03-02T19:00Z", paused="x")),
        ({}, state(campaigns=[RUNNING])),
    ],
    ids=["shorter than set", "begun since", "paused", "nothing collects"],
)
def test_a_wait_that_is_expected_is_not_idle(
    tmp_path: Path, changes: dict[str, Any], at: StoreStatus
) -> None:
    store = TrialStore.create(tmp_path / "s")
    assert "idle" not in {item.kind for item in found(store, at, **changes)}


def test_a_drift_that_is_not_known_is_reported(tmp_path: Path) -> None:
    lost = replace(RUNNING, drift=[DriftStatus("friction", None, 10.0, "r2")])
    kinds = {
        item.kind for item in found(TrialStore.create(tmp_path / "s"), state(campaigns=[lost]))
    }
    assert "drift" in kinds


def test_nothing_is_lost_while_a_receiver_is_down_and_nothing_is_told_twice(
    tmp_path: Path,
) -> None:
    store = TrialStore.create(tmp_path / "s")
    up, down = Receiver("json://a"), Receiver("json://b", up=False)
    watching, _ = watcher(store, [up, down])
    run = str(uuid4())
    run_records.begin(store.folder, run, "collect", run_records.EMBEDDED)
    write_json(
        store.folder / "control" / "runs" / f"{run}.end.json",
        {"state": "CRASHED", "message": "killed", "when": NOW.isoformat(), "by": "flow"},
    )
    for second in range(0, 300, 3):
        watching.look(NOW + timedelta(seconds=second))
    assert up.taken == ["collect crashed: killed"]
    assert down.taken == []
    assert 5 <= down.tried <= 8  # ever less often
    down.up = True
    again, _ = watcher(store, [up, down])  # the program began restarted in the meantime
    for second in range(300, 900, 3):
        again.look(NOW + timedelta(seconds=second))
    assert up.taken == down.taken == ["collect crashed: killed"]


def test_a_target_that_never_answers_delays_no_other(tmp_path: Path) -> None:
    """It gets its message when it comes back, once."""
    released = threading.Event()

    class Hanging(Receiver):
        def send(self, title: str, text: str) -> bool:
            released.wait(60)
            return super().send(title, text)

    hanging, other = Hanging("json://a"), Receiver("json://b")
    box = Outbox(TrialStore.create(tmp_path / "s"), [hanging, other], 30, NOW, lambda text: None)
    for number in range(3):
        now = NOW + timedelta(seconds=number)
        box.add(Event(str(number), "paused", f"event {number}", now), urgent=True)
        began = time.monotonic()
        box.send("t", now)
        assert time.monotonic() - began < 5
    assert other.taken == ["event 0", "event 1", "event 2"]
    assert hanging.taken == []
    released.set()
    for second in range(3, 60):
        box.send("t", NOW + timedelta(seconds=second))
    assert hanging.taken == ["event 0", "event 1\nevent 2"]


def test_a_full_disk_is_told_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store, receiver = TrialStore.create(tmp_path / "s"), Receiver()
    said: list[str] = []

    def full(path: Path, data: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device", str(path))

    begun = Outbox(store, [receiver], 30, NOW, said.append)
    with monkeypatch.context() as disk:
        disk.setattr(outbox, "write_json", full)
        for box in (begun, Outbox(TrialStore.create(tmp_path / "new"), [receiver], 30, NOW, print)):
            box.add(Event("a", "disk", "no room", NOW), urgent=True)
            for second in range(0, 60, 3):
                box.send("t", NOW + timedelta(seconds=second))
            assert receiver.taken.count("no room") == 1
            receiver.taken.clear()
    assert len(said) == 1
    assert "No space left" in said[0]
    begun.send("t", NOW + timedelta(seconds=60))
    again = Outbox(store, [receiver], 30, NOW, said.append)
    assert not again.add(Event("a", "disk", "no room", NOW), urgent=True)
    again.send("t", NOW + timedelta(seconds=61))
    assert receiver.taken == []


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EROFS, errno.EINVAL])
def test_alerts_that_begin_on_a_full_disk_are_sent(
    number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(path: Path, *_: object) -> int:
        raise OSError(number, "no", str(path))

    def ended(seconds: float) -> None:
        raise KeyboardInterrupt

    store = TrialStore.create(tmp_path / "s")
    with http_server() as (port, posted):
        address = f"json://127.0.0.1:{port}"
        waiting = Outbox(store, [AppriseTarget(address)], 30, NOW, print)
        waiting.add(Event("key", "idle", "it stands", NOW), True)
        monkeypatch.setattr(lock, "_open", full)
        monkeypatch.setattr(stopping, "wait", ended)
        done = here("alerts", store.folder, write(tmp_path, to=[address]))
    told = [item["message"] for item in posted]
    assert told == ([] if number == errno.EINVAL else ["it stands"]), done.stderr
    assert ("without a lock" in done.stderr) == bool(told)


@pytest.mark.parametrize("restarted", [False, True], ids=["while it runs", "at its next start"])
def test_a_clock_that_was_wrong_once_silences_nothing(tmp_path: Path, restarted: bool) -> None:
    store, receiver, down = TrialStore.create(tmp_path / "s"), Receiver(), Receiver("b", up=False)
    wrong = NOW + timedelta(days=1000)
    changes = {"most_per_hour": 1, "ping": "http://here"}
    watching, pinged = watcher(store, [receiver, down], wrong, **changes)

    def pause(when: datetime) -> None:
        made = control.ask(store, "pause")
        path = store.folder / "control" / f"{made.number:06d}.json"
        write_json(path, {**read_json(path), "when": (when - timedelta(hours=1)).isoformat()})

    pause(wrong)
    watching.look(wrong)
    assert (len(receiver.taken), len(pinged), down.tried) == (1, 1, 1)
    if restarted:
        watching, pinged = watcher(store, [receiver, down], NOW, **changes)
    down.up = True
    pause(NOW)
    watching.look(NOW)
    assert len(receiver.taken) == 2
    assert down.tried == 2
    assert len(pinged) == (1 if restarted else 2)
    assert datetime.fromisoformat(read_json(store.folder / "alerts/began.json")["began"]) == NOW


def test_addresses_that_differ_in_their_secrets_both_get_a_message(tmp_path: Path) -> None:
    one, other = Receiver("tgram://****"), Receiver("tgram://****", up=False)
    box = Outbox(TrialStore.create(tmp_path / "s"), [one, other], 30, NOW, lambda text: None)
    box.add(Event("a", "paused", "text", NOW), urgent=True)
    box.send("t", NOW)
    other.up = True
    box.send("t", NOW + timedelta(seconds=20))
    assert one.taken == other.taken == ["text"]


def test_a_run_that_was_killed_is_told_once(tmp_path: Path) -> None:
    store, receiver = TrialStore.create(tmp_path / "s"), Receiver()
    watching, _ = watcher(store, [receiver])
    run = str(uuid4())
    run_records.begin(store.folder, run, "collect", run_records.EMBEDDED, "nightly")
    watching.look(NOW)
    assert receiver.taken == []
    path = store.folder / "control" / "runs" / f"{run}.json"
    begun = read_json(path)
    write_json(path, {**begun, "process": {**begun["process"], "ticks": 1}})  # another process
    watching.look(NOW + timedelta(seconds=3))
    run_records.end(store.folder, run, "CRASHED", "its process was killed", "next start")
    watching.look(NOW + timedelta(seconds=6))
    assert receiver.taken == ["collect of nightly: its process is gone"]


def test_a_grade_that_fell_between_two_looks_is_told(tmp_path: Path) -> None:
    tiny = campaign(tmp_path / "s", "tiny")
    store, receiver = TrialStore.open(tmp_path / "s"), Receiver()
    began = datetime.now().astimezone() - timedelta(minutes=1)
    watching, _ = watcher(store, [receiver], began)
    for number, grade in enumerate(("digital input", "host time", "digital input")):
        folder = commit(tiny, f"t{number}")
        record = read_json(folder / RECORD)
        record["clocks"]["arm"]["grade"] = grade
        write_json(folder / RECORD, record)
        os.utime(folder, ns=(0, time.time_ns() + number))
    now = datetime.now().astimezone()
    watching.look(now)
    watching.look(now + timedelta(seconds=3))
    assert len(receiver.taken) == 1
    assert "fell from digital input to host time with trial t1" in receiver.taken[0]


def test_a_summary_that_was_missed_is_sent_later_that_day(tmp_path: Path) -> None:
    store, receiver = TrialStore.create(tmp_path / "s"), Receiver()
    watcher(store, [receiver], NOW - timedelta(days=2))  # alerts began then
    watching, _ = watcher(store, [receiver], summary="07:30")
    watching.look(NOW)
    watching.look(NOW + timedelta(minutes=5))
    assert len(receiver.taken) == 1


def test_what_happened_before_alerts_began_is_not_told(tmp_path: Path) -> None:
    store = TrialStore.create(tmp_path / "s")
    receiver = Receiver()
    box = Outbox(store, [receiver], 30, NOW, lambda text: None)
    assert not box.add(Event("a", "paused", "old", NOW - timedelta(seconds=1)), urgent=True)
    assert box.add(Event("b", "paused", "new", NOW), urgent=True)
    assert not box.add(Event("b", "paused", "new", NOW), urgent=True)
    assert box.send("t", NOW) == 1
    assert receiver.taken == ["new"]


def test_an_address_that_is_added_later_is_told_nothing_of_before(tmp_path: Path) -> None:
    store = TrialStore.create(tmp_path / "s")
    first, second = Receiver("json://a", up=False), Receiver("json://b")
    box = Outbox(store, [first], 30, NOW, lambda text: None)
    box.add(Event("a", "paused", "before", NOW), urgent=True)
    box.send("t", NOW)
    first.up = True
    later = NOW + timedelta(hours=1)
    box = Outbox(store, [first, second], 30, later, lambda text: None)
    box.add(Event("b", "paused", "after", later), urgent=True)
    box.send("t", later)
    assert (first.taken, second.taken) == (["before\nafter"], ["after"])


def test_quiet_hours_hold_all_but_urgent_messages(tmp_path: Path) -> None:
    quiet = settings(quiet={"from": "22:00", "until": "07:00"}, timezone="Europe/Rome")
    assert quiet.is_quiet(NOW)
    assert quiet.is_quiet(datetime(2030, 3, 2, 21, 0, tzinfo=UTC))
    assert not quiet.is_quiet(datetime(2030, 3, 2, 20, 59, tzinfo=UTC))
    assert not quiet.is_quiet(datetime(2030, 3, 3, 6, 0, tzinfo=UTC))
    receiver = Receiver()
    box = Outbox(TrialStore.create(tmp_path / "s"), [receiver], 30, NOW, lambda text: None)
    box.add(Event("a", "paused", "later", NOW), urgent=False)
    box.add(Event("b", "disk", "at once", NOW), urgent=True)
    box.send("t", NOW, quiet=True)
    assert receiver.taken == ["at once"]
    box.send("t", NOW + timedelta(hours=9))
    assert receiver.taken == ["at once", "later"]


def test_a_flood_becomes_one_message(tmp_path: Path) -> None:
    receiver = Receiver()
    box = Outbox(TrialStore.create(tmp_path / "s"), [receiver], 3, NOW, lambda text: None)
    for number in range(50):
        now = NOW + timedelta(minutes=number)
        box.add(Event(str(number), "trial set aside", f"trial {number}", now), urgent=False)
        box.send("t", now)
    assert [text.count("\n") + 1 for text in receiver.taken] == [1, 1, 1]
    box.send("t", NOW + timedelta(minutes=61))
    assert receiver.taken[-1].count("\n") + 1 == 47


def test_a_summary_is_sent_once_a_day_and_a_ping_after_each_trial_and_hour(tmp_path: Path) -> None:
    tiny = campaign(tmp_path / "s", "tiny")
    store, receiver = TrialStore.open(tmp_path / "s"), Receiver()
    watching, pinged = watcher(store, [receiver], summary="22:00", ping="http://localhost/x")
    for minute in range(0, 50, 10):
        watching.look(NOW + timedelta(minutes=minute))
    assert len(receiver.taken) == 1
    assert "nothing runs" in receiver.taken[0]
    assert len(pinged) == 1
    watching.look(NOW + timedelta(minutes=61))
    assert len(pinged) == 2
    commit(tiny, "a")
    watching.look(NOW + timedelta(minutes=62))
    assert len(pinged) == 2  # its campaign has no plan here: nothing is expected of it


def write(folder: Path, **changes: Any) -> Path:
    path = folder / "alerts.yaml"
    path.write_text(yaml.safe_dump({"alerts": {"to": ["json://localhost"], **changes}}))
    return path


def test_a_file_names_all_its_faults_and_quotes_no_address(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("LAB_CHAT", raising=False)
    wrong = write(tmp_path, about=["pause"], summary="7:30", timezone="Mars", attempts=0)
    with pytest.raises(InputError) as error:
        load_alerts(wrong)
    for key in ("about[0]", "summary", "timezone", "attempts"):
        assert f"alerts.{key}" in str(error.value)
    to = ["${LAB_CHAT}", "nonsense-hunter2", "json://a"]
    with pytest.raises(InputError) as error:
        load_alerts(write(tmp_path, to=to, ping="ftp://hunter2"))
    text = str(error.value)
    assert "alerts.to[0]" in text
    assert "LAB_CHAT is not set" in text
    assert "alerts.to[1]" in text
    assert "alerts.ping" in text
    assert "hunter2" not in text


def test_a_file_of_schedules_may_hold_the_alerts(tmp_path: Path) -> None:
    path = tmp_path / "schedules.yaml"
    path.write_text("timezone: UTC\nschedules: []\nalerts: {to: ['json://localhost']}\n")
    assert load_alerts(path).to == ["json://localhost"]


def test_a_rig_file_may_hold_the_alerts_and_its_copy_does_not(tmp_path: Path) -> None:
    path, plain = tmp_path / "rig.yaml", (ROOT / "rigs" / "mock.yaml").read_text()
    path.write_text(f"{plain}\nalerts:\n  to: ['mailto://lab:hunter2@example.org']\n")
    assert has_alerts(path)
    assert load_alerts(path).to == ["mailto://lab:hunter2@example.org"]
    _, text = load_rig_file(path)
    copy = mask_secrets(text)
    assert "hunter2" not in copy
    assert same_rig(copy, text)
    assert same_rig(plain, text)
    path.write_text(copy)
    assert load_rig_file(path, stored=True)[0].alerts == "****"


def test_messages_arrive_by_http_and_by_mail() -> None:
    with http_server() as (port, posted):
        target = AppriseTarget(f"json://user:hunter2@127.0.0.1:{port}/x")
        assert "hunter2" not in target.name
        assert target.send("SlipLab: s", "the arm did not answer")
    assert posted[0]["title"] == "SlipLab: s"
    assert posted[0]["message"] == "the arm did not answer"
    assert not target.send("SlipLab: s", "again")  # it is gone
    with mail_server() as (port, mails):
        address = f"mailto://127.0.0.1:{port}/?from=lab@example.org&to=anna@example.org"
        assert AppriseTarget(address).send("SlipLab: s", "the disk is full")
    assert "the disk is full" in mails[0]
    assert "anna@example.org" in mails[0]


def test_the_command_sends_a_test_message_and_says_who_took_it(tmp_path: Path) -> None:
    TrialStore.create(tmp_path / "s")
    with http_server() as (port, posted):
        file = write(tmp_path, to=[f"json://u:hunter2@127.0.0.1:{port}"])
        done = here("alerts", tmp_path / "s", file, "--test")
    assert done.returncode == 0, done.stderr
    assert "taken" in done.stdout
    assert "hunter2" not in done.stdout + done.stderr
    assert posted[0]["message"] == "Alerts of s arrive here."
    assert here("alerts", tmp_path / "s", file, "--test").returncode == 1
