"""The state of a store: who collects, how far each campaign is, when it ends, what needs a person.

Nights are counted from noon to noon, local time, by the end of each committed trial. How many more
are needed follows from the trials of the nights so far; the current night is left out, as it
is not over.
"""

from __future__ import annotations

import math
import shutil
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import UTC, date, datetime, timedelta
from itertools import pairwise
from pathlib import Path
from statistics import mean, median, stdev

from sliplab.analysis.campaigns import Collected
from sliplab.analysis.references import last_drift
from sliplab.flows.planning.campaign_trials import ExcludedTrial, excluded_trials
from sliplab.flows.planning.disk_space import RESERVE
from sliplab.flows.skin_change import to_repeat
from sliplab.protocols import InputError, Plan
from sliplab.storage.errors import StoreError
from sliplab.storage.files import read_json
from sliplab.storage.process import named
from sliplab.storage.trials import control
from sliplab.storage.trials.checksums import PROVENANCE, Checksums, incomplete, read_sums
from sliplab.storage.trials.context import SKIN, LoggedContext, unplanned
from sliplab.storage.trials.lock import STORE_LOCK, current_holder
from sliplab.storage.trials.store import IMPORTED, Campaign, TrialStore

LOOK_BACK = 50
"""Committed trials from which pace and size are estimated."""
CONFIDENCE = 0.9
"""Of the interval of the nights that are left."""
FEWEST = 4
"""Nights, and trials, from which an interval is given."""
_MOST_TIMES = 20
"""Times the expected nights up to which an upper bound is looked for."""
LONGEST_GAP = 3.0
"""Times its planned seconds: where a trial ended later after the one before, something else came
between, such as a person, and the pair says nothing about the pace."""


@dataclass(frozen=True)
class NightsLeft:
    """Nights that the missing trials need.

    Attributes:
        expected: by the mean of the nights so far.
        low, high: 90 % interval; None with fewer than `FEWEST` nights, which do not show how much
            nights differ. `high` is None, too, where nights differ so much that nothing bounds it.
        first, last: dates of the last night by `low` and `high`, or by `expected` without them.
    """

    expected: int
    low: int | None
    high: int | None
    first: str
    last: str


@dataclass(frozen=True)
class DriftStatus:
    """Change of a figure of the reference trials since the first one.

    Attributes:
        key: of the protocol's ``gates.reference``.
        percent: change; None if it is not known, which counts as too much.
        bound_percent: largest change that the protocol allows.
    """

    key: str
    percent: float | None
    bound_percent: float
    trial: str

    def reaches(self, share: float = 1.0) -> bool:
        """Return whether the change is as large as a share of what the protocol allows."""
        return self.percent is None or abs(self.percent) >= share * self.bound_percent


@dataclass(frozen=True)
class CampaignStatus:
    """State of one campaign.

    Attributes:
        planned, committed, missing: numbers of trials; missing ones are still to be taken.
        excluded: trials that no collection takes, with their causes.
        last_ended: when the last committed trial ended, UTC.
        nights: nights on which trials were committed; tonight: trials of the current one.
        seconds_left: at the rig, by the planned times and the pace so far; None without a trial.
        seconds_left_error: half of its 90 % interval; None with few trials.
        nights_left: None while nothing is known, or nothing is missing.
        bytes_per_trial: median on disk; None without a trial.
        nights_of_disk: nights until the disk is full, at the pace so far.
        drift: of the last reference trial.
        context: what people logged of skin, temperature and so on, by name.
        skins: committed trials by skin.
        repeat: what is still to be done since another skin was logged, in order.
        problem: why the campaign could not be read; all else is empty then.
    """

    campaign: str
    simulated: bool
    planned: int = 0
    committed: int = 0
    missing: int = 0
    excluded: list[ExcludedTrial] = field(default_factory=list)
    last_ended: str | None = None
    nights: int = 0
    tonight: int = 0
    seconds_left: float | None = None
    seconds_left_error: float | None = None
    nights_left: NightsLeft | None = None
    bytes_per_trial: int | None = None
    nights_of_disk: float | None = None
    drift: list[DriftStatus] = field(default_factory=list)
    context: dict[str, str] = field(default_factory=dict)
    skins: dict[str, int] = field(default_factory=dict)
    repeat: list[str] = field(default_factory=list)
    problem: str | None = None


@dataclass(frozen=True)
class StoreStatus:
    """State of a store.

    Attributes:
        running: the program that holds the store, in words; None if none does.
        since: when it took the store, UTC.
        collects: name of the campaign that it takes trials for; None if it takes none.
        paused: who paused the store, when and why, in words; None if it is not paused.
        disk_free: bytes, without the reserve that a collection keeps.
        imported: campaigns that were imported, and have no plan.
    """

    store: str
    running: str | None
    since: str | None
    collects: str | None
    paused: str | None
    disk_free: int
    campaigns: list[CampaignStatus]
    imported: list[str]


@dataclass(frozen=True)
class _TrialFolder:
    """When a committed trial ended and with which skin, if that is known; its files' checksums."""

    ended: datetime | None
    skin: str | None
    sums: Checksums
    bytes: int


class StatusReader:
    """Reads the state of a store again and again; what cannot change is read once."""

    def __init__(self, store: TrialStore) -> None:
        self._store = store
        self._known: dict[tuple[Path, int], _TrialFolder] = {}
        self._drift: dict[tuple[str, ...], list[DriftStatus]] = {}
        self._plans: dict[tuple[Path, int], Plan] = {}
        self._logged: dict[str, LoggedContext] = {}

    def read(self, now: datetime | None = None) -> StoreStatus:
        """Return the state.

        Args:
            now: local time with its zone; the clock's by default.

        Raises:
            StoreError: the store is damaged.
        """
        now = now or datetime.now().astimezone()
        holder = current_holder(self._store.folder / STORE_LOCK)
        paused = control.paused(self._store)
        free = max(shutil.disk_usage(self._store.folder).free - RESERVE, 0)
        campaigns, imported = [], []
        for campaign in self._store.campaigns():
            if IMPORTED in campaign.info:
                imported.append(campaign.name)
                continue
            campaigns.append(self._campaign(campaign, free, now))
        return StoreStatus(
            store=str(self._store.folder),
            running=None if holder is None else named(holder),
            since=None if holder is None else holder.get("since"),
            collects=None if holder is None else holder.get("collects") or None,
            paused=None if paused is None else str(paused),
            disk_free=free,
            campaigns=campaigns,
            imported=imported,
        )

    def _campaign(self, campaign: Campaign, free: int, now: datetime) -> CampaignStatus:
        simulated = bool(campaign.info["simulated"])
        try:
            plan = self._plan(campaign)
            folders = self._folders(campaign)
            committed = set(folders)
            excluded = excluded_trials(plan, campaign, committed)
            done = [trial for trial in plan if trial.id in committed]
            out = {item["trial"] for item in excluded}
            missing = [t for t in plan if t.id not in committed and t.id not in out]
            ended = {
                trial.id: moment.astimezone(now.tzinfo)
                for trial in done
                if (moment := folders[trial.id].ended) is not None
            }
            by_night = Counter(night_of(moment) for moment in ended.values())
            tonight = by_night.get(night_of(now), 0)
            nights = [by_night[night] for night in sorted(by_night)]
            over = nights[:-1] if tonight else nights
            sizes = [folders[trial.id].bytes for trial in done[-LOOK_BACK:]]
            size = round(median(sizes)) if sizes else None
            paces = paces_of(plan, ended)
            pace = median(paces) if paces else None
            error = pace_error(paces, len(missing))
            left = sum(plan.seconds(trial) for trial in missing)
            a_night = mean(over or nights) if nights else 0.0
            logged = self._logged.setdefault(
                campaign.name, LoggedContext(self._store, campaign.name)
            )
            context = unplanned(logged.read(), plan)
            skins = {trial.id: folders[trial.id].skin for trial in done}
            change = logged.last() if SKIN in context else None
            repeat = [] if change is None else to_repeat(self._store, campaign, plan, change, skins)
            return CampaignStatus(
                campaign=campaign.name,
                simulated=simulated,
                planned=len(plan),
                committed=len(done),
                missing=len(missing),
                excluded=excluded,
                last_ended=_utc(max(ended.values())) if ended else None,
                nights=len(nights),
                tonight=tonight,
                seconds_left=left * pace if missing and pace is not None else None,
                seconds_left_error=None if error is None or not missing else left * error,
                nights_left=_nights_left(by_night, over, len(missing), now),
                bytes_per_trial=size,
                nights_of_disk=free / (size * a_night) if size and a_night else None,
                drift=self._drifts(plan, campaign, committed),
                context=context,
                skins=dict(Counter(skin for skin in skins.values() if skin)),
                repeat=[str(item) for item in repeat],
            )
        except (InputError, StoreError) as error:
            return CampaignStatus(campaign.name, simulated, problem=str(error))

    def _plan(self, campaign: Campaign) -> Plan:
        try:
            key = campaign.protocol_file, campaign.protocol_file.stat().st_mtime_ns
        except OSError as error:
            raise StoreError(str(error)) from None
        if key not in self._plans:
            self._plans[key] = Collected(campaign).plan
        return self._plans[key]

    def _folders(self, campaign: Campaign) -> dict[str, _TrialFolder]:
        """Return the complete trials by id; a folder is read once, its files' sizes each time."""
        found = {}
        for path in campaign.folders("trials"):
            key = path, path.stat().st_ino  # a trial that is taken again is another folder
            known = self._known.get(key)
            if incomplete(path, None if known is None else known.sums) is not None:
                continue
            if known is None:
                size = sum(each.stat().st_size for each in path.iterdir() if each.is_file())
                ended, skin = _provenance(path / PROVENANCE)
                known = self._known[key] = _TrialFolder(ended, skin, read_sums(path), size)
            found[path.name] = known
        return found

    def _drifts(self, plan: Plan, campaign: Campaign, committed: set[str]) -> list[DriftStatus]:
        known = [t.id for t in plan if t.role == "reference" and t.id in committed]
        key = (campaign.name, *known[:1], *known[-1:])
        if key not in self._drift:
            self._drift[key] = [
                DriftStatus(
                    item.key,
                    item.percent if math.isfinite(item.percent) else None,
                    item.bound_percent,
                    item.trial,
                )
                for item in last_drift(plan, campaign, committed)
            ]
        return self._drift[key]


def night_of(moment: datetime) -> date:
    """Return the date on whose evening the night of a local time began: noon to noon."""
    return (moment - timedelta(hours=12)).date()


def paces_of(plan: Plan, ended: dict[str, datetime]) -> list[float]:
    """Return the seconds that a planned second took, of each of the last trials.

    Args:
        ended: when trials ended, by id.

    Returns:
        Nothing with fewer than two trials in a row.
    """
    planned = {trial.id: plan.seconds(trial) for trial in plan if trial.id in ended}
    order = sorted(ended, key=lambda trial: (ended[trial], trial))
    paces = []
    for before, trial in pairwise(order):
        took = (ended[trial] - ended[before]).total_seconds()
        if planned[trial] > 0 and 0 <= took <= LONGEST_GAP * planned[trial] + 60:
            paces.append(took / planned[trial])
    return paces[-LOOK_BACK:]


def pace_error(paces: Sequence[float], missing: int) -> float | None:
    """Return half of the 90 % interval of the mean pace of the missing trials; None with few.

    The variance of the mean of n further trials, seen from k, is s^2 (1 / n + 1 / k).
    """
    if len(paces) < FEWEST or not missing:
        return None
    from scipy.special import stdtrit

    t = float(stdtrit(len(paces) - 1, (1 + CONFIDENCE) / 2))
    return t * stdev(paces) * math.sqrt(1 / missing + 1 / len(paces))


def nights_needed(trials: Sequence[int], missing: int) -> tuple[int, int | None, int | None]:
    """Return how many nights the missing trials need, and a 90 % interval.

    The sum of N further nights has mean N m and variance N s^2 + N^2 s^2 / k, where m and s are the
    mean and standard deviation of the k nights so far; its bounds are those of Student's t with
    k - 1 degrees of freedom. Nights are taken as independent.

    Args:
        trials: of each night so far, at least one night, not all of them 0.
        missing: trials that are left.
    """
    m = mean(trials)
    expected = math.ceil(missing / m)
    if len(trials) < FEWEST:
        return expected, None, None
    from scipy.special import stdtrit

    k, s = len(trials), stdev(trials)
    t = float(stdtrit(k - 1, (1 + CONFIDENCE) / 2))

    def nights(sign: int) -> int | None:
        for n in range(1, _MOST_TIMES * expected + 1):
            if n * m + sign * t * s * math.sqrt(n + n * n / k) >= missing:
                return n
        return None

    return expected, nights(+1), nights(-1)


def _nights_left(
    by_night: Counter[date], over: Sequence[int], missing: int, now: datetime
) -> NightsLeft | None:
    """Return the nights that are left and their dates, at the share of nights used so far."""
    if not missing or not over:
        return None
    expected, low, high = nights_needed(over, missing)
    days = (max(by_night) - min(by_night)).days + 1
    each = days / len(by_night)  # days a night: weekends and other work come between
    tonight = night_of(now)

    def ends(nights: int) -> str:
        return (tonight + timedelta(days=math.ceil(nights * each) - 1)).isoformat()

    return NightsLeft(expected, low, high, ends(low or expected), ends(high or expected))


def _provenance(path: Path) -> tuple[datetime | None, str | None]:
    """Return when a trial ended, and with which skin it was taken."""
    try:
        found = read_json(path)
        return datetime.fromisoformat(str(found["ended"])), found.get("skin")
    except (OSError, ValueError, KeyError):
        return None, None


def _utc(moment: datetime) -> str:
    return moment.astimezone(UTC).isoformat(timespec="seconds")
