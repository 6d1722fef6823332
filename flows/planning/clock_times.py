"""Times on a wall clock and time zones, as files give them."""

from __future__ import annotations

import re
from typing import Annotated
from zoneinfo import available_timezones

from pydantic import AfterValidator

from sliplab.protocols.shown import did_you_mean

CLOCK = r"([01]\d|2[0-3]):([0-5]\d)"


def _zone(name: str) -> str:
    if name not in available_timezones():  # not: links of this computer such as posixrules
        hint = did_you_mean(name, available_timezones())
        raise ValueError(f"is not a time zone; write one like Europe/Rome or UTC{hint}")
    return name


def matching(pattern: re.Pattern[str], right: str) -> AfterValidator:
    """Return the check of a text; `right` says in a message what it must be."""

    def check(text: str) -> str:
        if not pattern.fullmatch(text):
            raise ValueError(right)
        return text

    return AfterValidator(check)


From = Annotated[str, matching(re.compile(CLOCK, re.ASCII), 'must be a time like "22:00", quoted')]
Zone = Annotated[str, AfterValidator(_zone)]
