"""The section `alerts:` of a file: to whom messages go, about what, and when not.

alerts:
  to: ["${LAB_CHAT}", "mailto://lab:${MAIL_PASSWORD}@example.org"]
  timezone: Europe/Rome
  summary: "07:30"
"""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import Annotated
from zoneinfo import ZoneInfo

from pydantic import AfterValidator, Field

from sliplab.flows.planning.clock_times import From, Zone
from sliplab.plugins.alerts.targets import expanded, make_sender
from sliplab.protocols import InputError
from sliplab.protocols.shown import one_of
from sliplab.protocols.yaml_file import StrictModel, parse_leniently, read_text, validate

KINDS = (
    "run failed",
    "paused",
    "trial set aside",
    "drift",
    "disk",
    "idle",
    "clock grade",
    "campaign done",
)
"""What a message may be about."""


def _kind(text: str) -> str:
    if text not in KINDS:
        raise ValueError(one_of(text, KINDS))
    return text


Kind = Annotated[str, AfterValidator(_kind)]
Minutes = Annotated[float, Field(gt=0, le=100_000)]


class QuietHours(StrictModel):
    """Hours in which only urgent messages are sent; others are sent when they are over."""

    from_: From = Field(alias="from")
    until: From


class AlertSettings(StrictModel):
    """To whom messages go, about what, and when not."""

    to: list[str] = Field(min_length=1)
    """Addresses of Apprise, such as ``mailto://user:password@example.org``. ``${NAME}`` is replaced
    by a variable of the environment, so that the file has no password."""
    timezone: Zone = "UTC"
    """Of `quiet` and `summary`."""
    about: list[Kind] = Field(default=list(KINDS))
    urgent: list[Kind] = Field(default=["run failed", "disk", "idle"])
    """Sent in quiet hours, too."""
    paused_min: Minutes = 30.0
    """A pause of this length is reported, minutes."""
    idle_min: Minutes = 60.0
    """Time without a committed trial while one collects, minutes."""
    attempts: int = Field(default=2, ge=1, le=100)
    """Failed attempts at a trial that are reported."""
    drift_share: float = Field(default=0.8, gt=0, le=10)
    """Drift of a reference trial that is reported, as a share of what the protocol allows."""
    disk_nights: float = Field(default=3.0, gt=0, le=10_000)
    """Nights of room on the disk below which it is reported."""
    quiet: QuietHours | None = None
    summary: From | None = None
    """When a summary is sent each day."""
    ping: str | None = None
    """An http(s) address that is fetched after each trial, and each hour while a trial is expected
    or not: a service that misses it (a dead-man switch) reports that this computer is gone."""
    most_per_hour: int = Field(default=30, ge=1, le=10_000)
    """Further messages of an hour are sent as one, when it is over."""

    def is_quiet(self, now: datetime) -> bool:
        """Return whether a moment is in the quiet hours."""
        if self.quiet is None:
            return False
        begin, end = self.quiet.from_, self.quiet.until
        clock = f"{now.astimezone(ZoneInfo(self.timezone)):%H:%M}"
        return begin <= clock < end if begin <= end else clock >= begin or clock < end


class _File(StrictModel):
    """A file that has nothing but alerts."""

    alerts: AlertSettings


def load_alerts(path: Path) -> AlertSettings:
    """Read the section `alerts:` of a file, which may be a file of schedules.

    Raises:
        InputError: all that is wrong with it; no address is quoted.
    """
    read = parse_leniently(read_text(path, "file with alerts"), path)
    if "alerts" in read:
        for other in set(read) - {"alerts"}:
            del read[other]
    settings = validate(_File, read, path).alerts
    faults = []
    for number, address in enumerate(settings.to):
        try:
            make_sender(address)
        except ValueError as error:
            faults.append(InputError(path, f"alerts.to[{number}]", "****", str(error)))
    if settings.ping is not None:
        try:
            ping = expanded(settings.ping)
            if not ping.startswith(("http://", "https://")):
                raise ValueError("must begin with http:// or https://")
        except ValueError as error:
            faults.append(InputError(path, "alerts.ping", "****", str(error)))
    if faults:
        raise InputError.joined(faults)
    return settings
