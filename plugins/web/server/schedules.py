"""Parameters of each deployment, and the file of schedules.

timezone: Europe/Rome
schedules:
  - {name: nights, flow: collect, protocol: kinematic.yaml,
     days: [mon, tue, wed, thu], from: "22:00", until: "06:00"}
  - {name: morning report, flow: report, cron: "30 7 * * mon-fri"}
  - {name: weekly report, flow: report, period: week, cron: "0 8 * * mon"}
  - {name: copy, flow: push, url: "s3://lab/kinematic", cron: "5 6 * * tue-fri"}

Store and rig are no parameters: they are those that `sliplab serve` was started with, so that an
arm's data cannot be sent elsewhere from a page; `url` is one of those in the file. A window is
computed from when its run was due and not from when it began: a run that starts late, because the
computer was off, must not take the rest of its night out of the next day.
"""

from __future__ import annotations

import asyncio
import os
import re
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Annotated, Any, Literal, get_args
from zoneinfo import ZoneInfo

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, create_model

from sliplab.flows.planning import parameters
from sliplab.flows.planning.clock_times import CLOCK, From, Zone, matching
from sliplab.flows.planning.parameters import (
    CollectOptions,
    Period,
    RuleOptions,
    SessionMetadata,
)
from sliplab.protocols import InputError
from sliplab.protocols.key_errors import KeyedError
from sliplab.protocols.shipped import shipped_protocols
from sliplab.protocols.shown import one_of
from sliplab.protocols.yaml_file import (
    StrictModel,
    parse_leniently,
    parse_yaml,
    read_text,
    rule,
    validate,
)

DAYS = ("mon", "tue", "wed", "thu", "fri", "sat", "sun")
_UNTIL = re.compile(rf"(?:({'|'.join(DAYS)}) )?{CLOCK}", re.ASCII)
_NAME = re.compile(r"[a-z0-9][a-z0-9 _-]{0,60}")
_CHANGE = timedelta(hours=3)
"""Longest time from a run that was planned too early to the change of the clocks."""


Name = Annotated[str, matching(_NAME, "must be letters a-z, digits, blanks, - and _")]
Until = Annotated[
    str, matching(_UNTIL, 'must be a time like "06:00", or a day and a time like "mon 06:00"')
]
_FIELDS = (
    "five fields, minute, hour, day of the month, month and day of the week, such as "
    '"0 22 * * mon-thu"'
)


def _five(text: str) -> str:
    fields = text.split()
    if len(fields) != 5 or not text.isascii():
        raise ValueError(f"must have {_FIELDS}")
    return " ".join(fields)


Cron = Annotated[str, AfterValidator(_five)]


def window_end(due: datetime, until: str, zone: str) -> datetime:
    """The first moment after `due` at which the clock on the wall shows `until`.

    Args:
        due: when the run was due, with a time zone.
        until: ``06:00``, or ``mon 06:00``.

    Returns:
        With the zone `zone`; an hour that a change of the clocks leaves out is the one after it.
    """
    found = _UNTIL.fullmatch(until)
    if found is None:
        raise ValueError(f"{until!r} is not a time")
    day, hour, minute = found.groups()
    wall = ZoneInfo(zone)
    first = due.astimezone(wall).replace(
        hour=int(hour), minute=int(minute), second=0, microsecond=0, fold=0
    )
    for days in range(9):
        moment = first + timedelta(days=days)  # by the clock on the wall
        # round over UTC: an hour that does not exist becomes one that does
        if (day is None or DAYS[moment.weekday()] == day) and moment.timestamp() > due.timestamp():
            return datetime.fromtimestamp(moment.timestamp(), wall)
    raise AssertionError("unreachable")


def cron_of(days: list[str], begin: str) -> str:
    """The cron line of a window's begin: ``0 22 * * mon,tue``."""
    hour, minute = begin.split(":")
    return f"{int(minute)} {int(hour)} * * {','.join(days)}"


class OnRig(SessionMetadata):
    """Parameters of every deployment that moves the arm."""

    until: Until | None = Field(
        default=None,
        description='When the rig must be free again: "06:00" or "mon 06:00". No trial is begun '
        "that would not be over by then.",
    )
    timezone: Zone = Field(default="UTC", description="Of `until`, such as Europe/Rome.")
    patience_min: float = Field(
        default=10.0,
        ge=0,
        le=1440,
        description="How long to wait for a rig or a store that another program uses, minutes; "
        "with `until`, as long as the window lasts.",
    )


class Collect(OnRig, CollectOptions):
    """Parameters of collecting the missing trials of a protocol."""

    protocol: Path = Field(description="A protocol file (.yaml) below the service's own folder.")


class ScheduledChain(Collect):
    """Parameters of collecting, then labelling, training and evaluating."""

    train: bool = Field(
        default=True,
        description="Train again where trials came in; else evaluate a fresh model only.",
    )


class ScheduledStudy(OnRig):
    """Parameters of the whole study of the shipped protocols, up to the report."""

    pilot: bool = Field(default=False, description="Use the small pilot protocols.")
    extra: bool = Field(
        default=True, description="Include the 125 % disturbance that the paper left out."
    )


class ScheduledStep(StrictModel):
    """Parameters of an analysis step on stored trials."""

    campaigns: list[str] = Field(default=[], description="Only these campaigns; all by default.")


class ScheduledReport(ScheduledStep):
    """Parameters of the report."""

    period: Period | None = Field(
        default=None,
        description="Report the last week or month instead: trials, failures, drift, disk, log.",
    )


def _url(text: str) -> str:
    from sliplab.storage.remote.objects import check_url

    try:
        return check_url(text) if text else text
    except InputError as error:
        raise ValueError(error.expected) from None


class ScheduledPush(ScheduledStep):
    """Parameters of sending committed trials to a remote store."""

    url: Annotated[str, AfterValidator(_url)] = Field(
        default="", description="One that the schedules name; by default the first of these."
    )
    quarantine: bool = Field(default=False, description="Quarantined trials, too.")


class Evaluate(RuleOptions, ScheduledStep):
    """Parameters of evaluating the network on the test trials."""


class Ask(parameters.ControlOptions):
    """Parameters of a request from Prefect's page to the current collection."""

    who: str = Field(default="", description="Your name; default: Prefect's page.")


FlowName = Literal["collect", "label", "train", "evaluate", "report", "study", "chain", "push"]
SCHEDULED: dict[FlowName, type[StrictModel]] = {
    "collect": Collect,
    "label": ScheduledStep,
    "train": ScheduledStep,
    "evaluate": Evaluate,
    "report": ScheduledReport,
    "study": ScheduledStudy,
    "chain": ScheduledChain,
    "push": ScheduledPush,
}
"""Flows that a schedule may start; `pause`, `resume` and `stop` are for people."""


Day = Literal["mon", "tue", "wed", "thu", "fri", "sat", "sun"]


class StartTimes(StrictModel):
    """Start times of a flow: days and an hour, or a cron line."""

    model_config = ConfigDict(populate_by_name=True)

    name: Name
    days: list[Day] | None = Field(default=None, min_length=1)
    from_: From | None = Field(default=None, alias="from")
    cron: Cron | None = None
    active: bool = True

    @rule
    def _has_a_time(self) -> StartTimes:
        _cron(self)
        return self


_TIMING = {*StartTimes.model_fields, "flow", "timezone"}


def _schedule(flow: FlowName, model: type[StrictModel]) -> type[BaseModel]:
    """Timing and the parameters of one flow in one mapping, as a person writes it."""
    kind: Any = Literal[flow]
    made: type[BaseModel] = create_model(
        f"{flow} schedule", __base__=(StartTimes, model), flow=(kind, ...)
    )
    return made


_MODELS = {flow: _schedule(flow, model) for flow, model in SCHEDULED.items()}


class Scheduled(StrictModel):
    """One schedule, ready for Prefect.

    Attributes:
        parameters: of the flow, as JSON.
    """

    name: str
    flow: FlowName
    cron: str
    timezone: str
    active: bool
    parameters: dict[str, Any]

    @property
    def slug(self) -> str:
        """By which Prefect tells the schedules of one deployment apart; it takes no blanks."""
        return self.name.replace(" ", "-")

    def end(self, begin: datetime) -> datetime | None:
        """The end of the window of a run that is due at `begin`; None without one.

        A run in an hour that a change of the clocks leaves out begins after it, and its window may
        be over by then: it counts from the time that is written, as the run's own.
        """
        until = self.parameters.get("until")
        minute, hour, *_ = self.cron.split()
        written = f"{hour:>02}:{minute:>02}"
        if _UNTIL.fullmatch(written) and written != f"{begin:%H:%M}":
            begin = begin.replace(hour=int(hour), minute=int(minute), fold=1).astimezone(UTC)
        return None if until is None else window_end(begin, until, self.timezone)


class _File(StrictModel):
    """The file before each schedule is checked by its flow."""

    timezone: Zone
    schedules: list[dict[str, Any]]
    alerts: dict[str, Any] | None = None
    """`sliplab alerts` reads it."""


def load_schedules(path: Path) -> list[Scheduled]:
    """The schedules of a file; protocols are named from the file's own folder.

    Raises:
        InputError: anything wrong, with file, key, value and what would be right.
    """
    read = parse_leniently(read_text(path, "schedule file"), path)
    file = validate(_File, read, path)
    made: list[Scheduled] = []
    faults: list[InputError] = []
    for number, data in enumerate(file.schedules):
        where = f"schedules[{number}]"
        try:
            made.append(_one(data, file.timezone, path))
        except InputError as error:
            for each in error.faults:
                key = f"{where}.{each.key}" if each.key else where
                value = each.value and read.written.get(key, each.value)
                faults.append(InputError(path, key, value, each.expected))
            continue
        if made[-1].slug in {item.slug for item in made[:-1]}:
            why = "is used twice (blanks count as hyphens)"
            faults.append(InputError(path, f"{where}.name", made[-1].name, why))
    if faults:
        raise InputError.joined(faults)
    return made


def has_alerts(path: Path) -> bool:
    """Return whether a file of schedules, or a rig file, has the section ``alerts:``.

    Raises:
        InputError: it is not YAML.
    """
    return parse_yaml(read_text(path, "file"), path).get("alerts") is not None


def _one(data: dict[str, Any], timezone: str, path: Path) -> Scheduled:
    flow = data.get("flow")
    if not isinstance(flow, str) or flow not in _MODELS:
        raise InputError(path, "flow", flow, one_of(flow, get_args(FlowName)))
    if "timezone" in data:
        raise InputError(
            path, "timezone", data["timezone"], "applies to the whole file; give it once at the top"
        )
    model: Any = validate(_MODELS[flow], data, path)
    parameters = model.model_dump(mode="json", exclude=_TIMING, exclude_unset=True)
    if issubclass(SCHEDULED[flow], OnRig):
        parameters["timezone"] = timezone
    if flow == "push" and not model.url:
        raise InputError(path, "url", None, "is missing; give one like s3://bucket/folder")
    if "protocol" in parameters:
        parameters["protocol"] = _protocol(path, model.protocol, model.enable)
        _check_campaign(path, model.campaign)
    return Scheduled(
        name=model.name,
        flow=flow,
        cron=_cron(model),
        timezone=timezone,
        active=model.active,
        parameters=parameters,
    )


def _cron(model: Any) -> str:
    """The cron line.

    Raises:
        KeyedError: it does not exist, or there are two ways of saying it.
    """
    if model.cron is None:
        if model.days is None or model.from_ is None:
            missing = "days" if model.days is None else "from"
            raise KeyedError(f".{missing}", None, "is missing; give days and from, or else cron")
        return cron_of(model.days, model.from_)
    for key, value in (("days", model.days), ("from", model.from_)):
        if value is not None:
            raise KeyedError(f".{key}", value, "cannot be combined with cron")
    return str(model.cron)


def upcoming_runs(
    path: Path, schedules: Sequence[Scheduled], count: int, after: datetime | None = None
) -> list[list[datetime]]:
    """The next runs of each schedule, as Prefect's server plans them, whether it is active or not.

    It loads Prefect, which must have been pointed at its home.

    Args:
        path: the schedules' file, for messages.
        count: number of runs of each. after: now by default.

    Returns:
        In each schedule's time zone.

    Raises:
        InputError: a cron line is wrong or has no run, or a window ends at the time it begins.
    """
    found = []
    faults: list[InputError] = []
    for number, item in enumerate(schedules):
        try:
            found.append(_runs_of(item, count, after))
        except KeyedError as error:
            key = f"schedules[{number}]{error.key}"
            faults.append(InputError(path, key, error.value, str(error)))
    if faults:
        raise InputError.joined(faults)
    return found


async def begin_of(cron: str, zone: str, planned: datetime) -> datetime | None:
    """Return when a run that Prefect planned begins, UTC; None where the cron line has no such run.

    Prefect plans an hour that a change of the clocks leaves out before that change, an hour early.
    It begins after it, as a window ends: the arm must not move earlier than is written.
    """
    from prefect.server.schemas.schedules import CronSchedule

    wall = planned.astimezone(ZoneInfo(zone))
    later = (planned + _CHANGE).astimezone(wall.tzinfo)
    jump = (later.utcoffset() or timedelta()) - (wall.utcoffset() or timedelta())
    for shift in (timedelta(), max(jump, timedelta())):
        # by the clock on the wall, where every hour exists
        shown = wall.replace(tzinfo=UTC) + shift
        if await CronSchedule(cron=cron, timezone="UTC").get_dates(1, shown) == [shown]:
            return planned.astimezone(UTC) + shift
    return None


async def begin_of_run(run: Any, schedules: Sequence[Scheduled]) -> datetime | None:
    """Return when a run of Prefect's begins by the schedule that planned it; None if none did."""
    for item in schedules:
        if item.active and run.parameters == {"wanted": item.parameters}:
            begins = await begin_of(item.cron, item.timezone, run.expected_start_time)
            if begins is not None:
                return begins
    return None


def _runs_of(item: Scheduled, count: int, after: datetime | None) -> list[datetime]:
    """Return the next runs of a schedule. Raises KeyedError as `upcoming_runs`."""
    from prefect.server.schemas.schedules import CronSchedule

    async def begins(planned: Sequence[datetime]) -> list[datetime]:
        return [await begin_of(item.cron, item.timezone, run) or run for run in planned]

    try:
        schedule = CronSchedule(cron=item.cron, timezone=item.timezone)
    except ValueError:
        raise KeyedError(".cron", item.cron, f"must have {_FIELDS}") from None
    try:
        runs = asyncio.run(schedule.get_dates(count, after))
    except ValueError:  # it looks 50 years ahead
        raise KeyedError(".cron", item.cron, "never runs: no month has such a day") from None
    until = item.parameters.get("until")
    if until is not None and any(_ends_as_it_begins(run, until) for run in runs):
        raise KeyedError(
            ".until",
            until,
            "is when the window begins, which would last a whole day or week; give another time",
        )
    zone = ZoneInfo(item.timezone)
    begun = asyncio.run(begins(runs))
    return [datetime.fromtimestamp(run.timestamp(), zone) for run in begun]


def _ends_as_it_begins(begin: datetime, until: str) -> bool:
    return until in (f"{begin:%H:%M}", f"{DAYS[begin.weekday()]} {begin:%H:%M}")


def _protocol(path: Path, name: Path, enable: list[str]) -> str:
    """A protocol's path, found now: a night must not fail for a name.

    Raises:
        InputError: it does not exist, or it or a level to be enabled is wrong.
    """
    from sliplab.protocols import load_plan

    found = (path.parent / name).resolve()
    if not os.path.exists(found):  # else a file of that name comes first, as for other commands
        found = shipped_protocols().get(str(name).replace("-", "_"), found).resolve()
    if not found.is_file():
        raise InputError(path, "protocol", str(name), f"no such file ({found})")
    try:
        load_plan(found, enable)
    except InputError as error:
        if error.file == "--enable":
            raise InputError(path, "enable", enable, error.expected) from None
        raise InputError(path, "protocol", str(name), error.message) from None
    return str(found)


def _check_campaign(path: Path, name: str | None) -> None:
    from sliplab.storage.files import safe_name
    from sliplab.storage.trials.store import StoreError

    try:
        safe_name("any" if name is None else name)
    except StoreError as error:
        raise InputError(path, "campaign", name, str(error)) from None
