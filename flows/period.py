"""The report of a period: what was taken and set aside, drift, forecasts, and what people did.

    STORE/report/periods/2026-11-22_2026-11-28.html   and .json: first and last day

Needed are committed trials alone, no analysis.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict, dataclass
from datetime import date, datetime, time, timedelta
from pathlib import Path

from sliplab.analysis.campaigns import Collected
from sliplab.analysis.references import last_drift
from sliplab.analysis.report.page import Table, number, render_page
from sliplab.flows.log import LogEntry, log_entries
from sliplab.flows.planning.parameters import Period
from sliplab.flows.running.console import duration, size
from sliplab.flows.status import CampaignStatus, StatusReader, night_of
from sliplab.protocols import InputError
from sliplab.storage.errors import StoreError
from sliplab.storage.files import make_folder, read_json, write_json, write_text
from sliplab.storage.trials.checksums import PROVENANCE
from sliplab.storage.trials.store import Campaign, TrialStore

PROGRAM = {"session", "run", "quarantine"}
"""Entries of the log that programs made: they are counted, not listed."""


@dataclass(frozen=True)
class PeriodCampaign:
    """A campaign in a period.

    Attributes:
        trials: committed in it, by night (the date on whose evening it began).
        causes: attempts that went to quarantine in it, by cause.
        drift: of the last reference trial by its end: ``event_rate -12.0 % (20 % allowed)``.
        status: of the campaign when the report was made; forecasts are in it.
    """

    trials: dict[str, int]
    causes: dict[str, int]
    drift: list[str]
    status: CampaignStatus


@dataclass(frozen=True)
class PeriodReport:
    """Content of the report.

    Attributes:
        since, until: its first moment, and the first one after it; local time, ISO 8601.
        made: when the report was made.
        disk_free: bytes, without the reserve that a collection keeps.
        runs: flow runs that began in it, by their end in words; failed ones are in `failed`.
        log: what people did, oldest first.
        unreadable: files that could not be read.
    """

    store: str
    simulated: bool
    since: str
    until: str
    made: str
    disk_free: int
    campaigns: list[PeriodCampaign]
    runs: int
    failed: list[str]
    log: list[LogEntry]
    unreadable: list[str]


def days(since: str | None, until: str | None, now: datetime) -> tuple[datetime, datetime]:
    """Return the moments from a first to a last day, both included; local time.

    Args:
        since: ``2026-11-22``. until: the current day by default.

    Raises:
        InputError: a date is wrong, or the last day is before the first.
    """
    found = {}
    for option, text in (("--since", since), ("--until", until)):
        try:
            found[option] = date.fromisoformat(text) if text else now.date()
        except ValueError:
            raise InputError(option, "", text, "must be a day such as 2026-11-22") from None
    if since is None:
        raise InputError("--since", "", None, "is required with --until")
    if found["--until"] < found["--since"]:
        if until is None:
            raise InputError("--since", "", since, "is in the future")
        raise InputError("--until", "", until, f"is before --since {since}")
    return _midnight(found["--since"]), _midnight(found["--until"] + timedelta(days=1))


def period_before(now: datetime, period: Period) -> tuple[datetime, datetime]:
    """Return the moments of the week or month before today."""
    import pandas as pd

    last = pd.Timestamp(now.date())
    first = last - (pd.Timedelta(days=7) if period == "week" else pd.DateOffset(months=1))
    return _midnight(first.date()), _midnight(last.date())


def _midnight(day: date) -> datetime:
    return datetime.combine(day, time()).astimezone()


def write_period_report(store: TrialStore, since: datetime, until: datetime, now: datetime) -> Path:
    """Write the report as a page and as JSON; return the page.

    Raises:
        StoreError: the store is damaged.
    """
    found = period_report(store, since, until, now)
    folder = store.folder / "report" / "periods"
    make_folder(folder.parent)
    make_folder(folder)
    name = f"{since:%Y-%m-%d}_{until - timedelta(seconds=1):%Y-%m-%d}"
    write_json(folder / f"{name}.json", asdict(found))
    page = folder / f"{name}.html"
    write_text(page, _render(found, since, until))
    return page


def period_report(
    store: TrialStore, since: datetime, until: datetime, now: datetime
) -> PeriodReport:
    """Collect what happened in a period, from `since` until before `until`."""
    status = StatusReader(store).read(now)
    unreadable: list[str] = []
    entries = [e for e in log_entries(store, unreadable) if _within(e.when, since, until)]
    runs = [e for e in entries if e.what == "run"]
    campaigns = []
    for item in status.campaigns:
        campaign = store.campaign(item.campaign)
        if item.problem is not None:
            unreadable.append(f"{item.campaign}: {item.problem}")
            continue
        causes = Counter(
            e.text for e in entries if e.what == "quarantine" and e.campaign == item.campaign
        )
        trials, by_then = _taken(campaign, since, until, unreadable)
        campaigns.append(
            PeriodCampaign(trials, dict(causes), _drift(campaign, by_then, unreadable), item)
        )
    return PeriodReport(
        store=status.store,
        simulated=store.simulated,
        since=since.isoformat(timespec="seconds"),
        until=until.isoformat(timespec="seconds"),
        made=now.isoformat(timespec="seconds"),
        disk_free=status.disk_free,
        campaigns=campaigns,
        runs=len(runs),
        failed=[f"{_local(e.when)}: {e.text}" for e in runs if _failed(e.text)],
        log=[e for e in entries if e.what not in PROGRAM],
        unreadable=unreadable,
    )


def _failed(text: str) -> bool:
    return ": failed after " in text or ": crashed after " in text


def _within(when: str, since: datetime, until: datetime) -> bool:
    return since <= datetime.fromisoformat(when) < until


def _taken(
    campaign: Campaign, since: datetime, until: datetime, unreadable: list[str]
) -> tuple[dict[str, int], set[str]]:
    """Return the trials of the period by night, and the ids of all that had ended by its end."""
    nights: Counter[str] = Counter()
    by_then = set()
    for trial in campaign.committed():
        path = campaign.folder / "trials" / trial / PROVENANCE
        try:
            ended = datetime.fromisoformat(str(read_json(path)["ended"])).astimezone()
        except (OSError, ValueError, KeyError) as error:
            unreadable.append(f"{path}: {error}")
            continue
        if ended < until:
            by_then.add(trial)
            if ended >= since:
                nights[night_of(ended).isoformat()] += 1
    return dict(sorted(nights.items())), by_then


def _drift(campaign: Campaign, by_then: set[str], unreadable: list[str]) -> list[str]:
    try:
        found = last_drift(Collected(campaign).plan, campaign, by_then)
    except (StoreError, InputError) as error:
        unreadable.append(str(error))
        return []
    return [
        f"{item.key} {item.percent:+.1f} % at {item.trial} ({item.bound_percent:g} % allowed)"
        + (": TOO MUCH" if item.beyond else "")
        for item in found
    ]


def _render(report: PeriodReport, since: datetime, until: datetime) -> str:
    nights = [
        [night, item.status.campaign, str(count)]
        for item in report.campaigns
        for night, count in item.trials.items()
    ]
    causes = [
        [str(count), item.status.campaign, cause]
        for item in report.campaigns
        for cause, count in sorted(item.causes.items(), key=lambda pair: -pair[1])
    ]
    log = [[_local(e.when), e.who or "–", e.what, e.campaign or "–", _words(e)] for e in report.log]
    return render_page(
        "period.html",
        simulated=report.simulated,
        report=report,
        title=f"{since:%Y-%m-%d} to {until - timedelta(seconds=1):%Y-%m-%d}",
        made=_local(report.made),
        campaigns=Table(
            ("campaign", "in the period", "in all", "planned", "missing", "excluded", "drift"),
            [_line(item) for item in report.campaigns],
        ),
        nights=Table(("night", "campaign", "trials"), nights, "Trials committed by night."),
        causes=Table(("attempts", "campaign", "cause"), causes, "Attempts that were set aside."),
        forecasts=Table(
            ("campaign", "rig time left", "nights left", "last night", "disk full in"),
            [_forecast(item.status) for item in report.campaigns],
            f"By the pace so far. {size(report.disk_free)} of disk are free.",
        ),
        log=Table(("when", "who", "what", "campaign", "text"), log),
    )


def _line(item: PeriodCampaign) -> list[str]:
    of = item.status
    counts = (sum(item.trials.values()), of.committed, of.planned, of.missing, len(of.excluded))
    return [of.campaign, *map(str, counts), "; ".join(item.drift) or "–"]


def _forecast(item: CampaignStatus) -> list[str]:
    left = item.nights_left
    rig = "–" if item.seconds_left is None else duration(item.seconds_left)
    if not item.missing:
        return [item.campaign, "–", "0", "complete", "–"]
    nights = last = "–"
    if left is not None:
        nights = str(left.expected)
        if left.low is not None:
            nights += f" ({left.low} to {left.high or 'not known'})"
        last = left.first if left.first == left.last else f"{left.first} to {left.last}"
    full = number(item.nights_of_disk, 0, "nights")
    return [item.campaign, rig, nights, last, full]


def _words(entry: LogEntry) -> str:
    trials = ", ".join(entry.trials)
    return ": ".join(part for part in (trials, entry.text) if part) or "–"


def _local(moment: str) -> str:
    return f"{datetime.fromisoformat(moment).astimezone():%Y-%m-%d %H:%M}"
