"""Nights and weekends: from which hour, on which days, until when, by the clock on the lab's wall.

A window is reckoned from when its run was due and not from when it began: a run that starts late,
because the computer was off, must not take the rest of its night out of the next day.
"""

from __future__ import annotations

import re
from datetime import datetime, timedelta
from typing import Annotated
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

from pydantic import AfterValidator

DAYS = ("mon", "tue", "wed", "thu", "fri", "sat", "sun")
_CLOCK = r"([01]\d|2[0-3]):([0-5]\d)"
_UNTIL = re.compile(rf"(?:({'|'.join(DAYS)}) )?{_CLOCK}", re.ASCII)
_FROM = re.compile(_CLOCK, re.ASCII)


def _zone(name: str) -> str:
    try:
        ZoneInfo(name)
    except (ZoneInfoNotFoundError, ValueError, OSError):
        raise ValueError("is no time zone; write one like Europe/Rome or UTC") from None
    return name


def _until(text: str) -> str:
    if not _UNTIL.fullmatch(text):
        raise ValueError('must be a time like "06:00", or a day and a time like "mon 06:00"')
    return text


def _from(text: str) -> str:
    if not _FROM.fullmatch(text):
        raise ValueError('must be a time like "22:00", quoted')
    return text


Zone = Annotated[str, AfterValidator(_zone)]
Until = Annotated[str, AfterValidator(_until)]
From = Annotated[str, AfterValidator(_from)]


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
        raise ValueError(f"{until!r} is no time")
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
