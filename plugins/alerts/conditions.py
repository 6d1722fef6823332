"""What is worth a message: found in the state of a store, with a key that names the event.

The state is read from the store and not from the program that collects, so that a collection that
was killed is reported as well, and one that runs is never delayed.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from functools import lru_cache
from itertools import pairwise
from pathlib import Path

from sliplab.flows.running import run_records
from sliplab.flows.status import CampaignStatus, StoreStatus, night_of
from sliplab.plugins.alerts.settings import AlertSettings
from sliplab.protocols.shown import plural
from sliplab.storage.schema.trial import TrialRecord
from sliplab.storage.trials import control
from sliplab.storage.trials.checksums import RECORD
from sliplab.storage.trials.store import FORGIVEN, IMPORTED, QuarantineEntry, TrialStore

FAILED = {"FAILED", "CRASHED"}
GRADES = (
    "trigger input",
    "hardware trigger",
    "exposure line",
    "digital input",
    "arm clock",
    "device time stamps",
    "host time",
    "host arrival",
    "unknown",
)
"""Grades of a clock, best first."""
LOOK_BACK = 50
"""Last committed trials whose clocks are compared: more than are taken between two looks."""


@dataclass(frozen=True)
class Event:
    """Something to be reported.

    Attributes:
        key: names the event, which is reported once.
        kind: one of `settings.KINDS`.
        since: when it happened; local time.
    """

    key: str
    kind: str
    text: str
    since: datetime


def events(
    store: TrialStore, state: StoreStatus, settings: AlertSettings, now: datetime
) -> Iterator[Event]:
    """Yield all that holds now or is on record, each with the key by which it is reported once."""
    for found in _events(store, state, settings, now):
        if found.kind in settings.about:
            yield found


def _events(
    store: TrialStore, state: StoreStatus, settings: AlertSettings, now: datetime
) -> Iterator[Event]:
    yield from _failed_runs(store, now)
    yield from _long_pause(store, settings, now)
    yield from _idle(state, settings, now)
    for item in state.campaigns:
        yield from _campaign(item, state, settings, now)
    for campaign in store.campaigns():
        if IMPORTED in campaign.info:
            continue
        yield from _set_aside(campaign.name, campaign.quarantined(), settings, now)
        yield from _grades(store, campaign.name)


def _failed_runs(store: TrialStore, now: datetime) -> Iterator[Event]:
    for run, ended in run_records.runs(store.folder):
        name = " of ".join(filter(None, [run["flow"], run.get("deployment")]))
        if ended is None:
            if run_records.was_killed(run):  # the next program that opens the store writes its end
                yield Event(f"run {run['run']}", "run failed", f"{name}: its process is gone", now)
        elif (ended.get("state") in FAILED and not run_records.was_stopped(ended)) or (
            run_records.NOTHING_TAKEN in str(ended.get("message"))
        ):
            text = f"{name} {str(ended['state']).lower()}: {ended.get('message') or 'no message'}"
            since = datetime.fromisoformat(ended["when"])
            yield Event(f"run {run['run']}", "run failed", text, since)


def _long_pause(store: TrialStore, settings: AlertSettings, now: datetime) -> Iterator[Event]:
    paused = control.paused(store)
    if paused is None:
        return
    since = datetime.fromisoformat(paused.when)
    minutes = (now - since).total_seconds() / 60
    if minutes >= settings.paused_min:
        text = f"paused for {minutes:.0f} min ({paused}); continue with `sliplab resume`"
        yield Event(f"pause {paused.number}", "paused", text, now)


def _idle(state: StoreStatus, settings: AlertSettings, now: datetime) -> Iterator[Event]:
    if state.collects is None or state.paused is not None or state.since is None:
        return
    ended = [item.last_ended for item in state.campaigns if item.campaign == state.collects]
    last = max(datetime.fromisoformat(moment) for moment in (state.since, *ended) if moment)
    minutes = (now - last).total_seconds() / 60
    if minutes >= settings.idle_min:
        text = f"{state.collects} collects, but has committed no trial for {minutes:.0f} min"
        yield Event(f"idle {state.collects} {last.isoformat()}", "idle", text, now)


def _campaign(
    item: CampaignStatus, state: StoreStatus, settings: AlertSettings, now: datetime
) -> Iterator[Event]:
    name = f"{item.campaign} (simulated)" if item.simulated else item.campaign
    for drift in item.drift:
        if drift.reaches(settings.drift_share):
            change = "not known" if drift.percent is None else f"{drift.percent:+.1f} %"
            text = (
                f"{name}: drift of {drift.key} at the reference trial {drift.trial}: {change}; "
                f"{drift.bound_percent:g} % end the campaign"
            )
            key = f"drift {item.campaign} {drift.trial} {drift.key}"
            yield Event(key, "drift", text, now)
    nights = item.nights_of_disk
    if item.missing and nights is not None and nights < settings.disk_nights:
        needed = (item.bytes_per_trial or 0) * item.missing
        if needed > state.disk_free:
            text = f"{name}: the disk has room for {nights:.1f} nights; the rest does not fit"
            yield Event(f"disk {item.campaign} {night_of(now)}", "disk", text, now)
    if item.committed and not item.missing and item.last_ended is not None:
        out = f", {len(item.excluded)} excluded" if item.excluded else ""
        text = f"{name}: done, {item.committed} of {plural(item.planned, 'trial')}{out}"
        key = f"done {item.campaign} {item.committed} {item.planned}"
        yield Event(key, "campaign done", text, datetime.fromisoformat(item.last_ended))


def _set_aside(
    campaign: str, quarantined: Sequence[QuarantineEntry], settings: AlertSettings, now: datetime
) -> Iterator[Event]:
    attempts: dict[str, list[str]] = {}
    for item in quarantined:
        if str(item["cause"]).startswith("gate") and FORGIVEN not in item:
            attempts.setdefault(item["trial"], []).append(str(item["cause"]))
    for trial, causes in attempts.items():
        if len(causes) >= settings.attempts:
            text = f"{campaign}: {trial} failed {plural(len(causes), 'time')}: {causes[-1]}"
            yield Event(f"aside {campaign} {trial} {len(causes)}", "trial set aside", text, now)


def _grades(store: TrialStore, campaign: str) -> Iterator[Event]:
    """Compare the clocks of each of the last committed trials with those of the one before."""
    folders = {path: path.stat().st_mtime_ns for path in store.campaign(campaign).folders("trials")}
    known = sorted(folders, key=lambda path: (folders[path], path.name))[-LOOK_BACK:]
    for earlier, path in pairwise(known):
        before, last = (_grades_of(each, folders[each]) for each in (earlier, path))
        for device, grade in last.items():
            if device in before and _rank(grade) > _rank(before[device]):
                text = (
                    f"{campaign}: the clock of {device} fell from {before[device]} to {grade} "
                    f"with trial {path.name}"
                )
                since = datetime.fromtimestamp(folders[path] / 1e9).astimezone()
                yield Event(f"grade {campaign} {path.name} {device}", "clock grade", text, since)


@lru_cache(4 * LOOK_BACK)
def _grades_of(folder: Path, changed_ns: int) -> dict[str, str]:
    """Return the grade of each device; nothing of a trial that cannot be read.

    Args:
        changed_ns: when the folder was last changed: another trial has another time.
    """
    try:
        clocks = TrialRecord.load(folder / RECORD).to_json().get("clocks", {})
    except (OSError, ValueError):
        return {}
    return {
        name: str(clock["grade"])
        for name, clock in clocks.items()
        if isinstance(clock, dict) and clock.get("grade")
    }


def _rank(grade: str) -> int:
    return GRADES.index(grade) if grade in GRADES else len(GRADES)
