"""Does a trial's record have what every reader of records relies on?

A record is held against its checksum before it is read, but its checksum stands beside it: whoever
wrote both decides what is in them. What is checked here is looked up elsewhere without a question.
"""

from __future__ import annotations

import math
from typing import Any

from sliplab.storage.clockmap import ClockMap
from sliplab.storage.streams import Json

DEVICES = ("events", "frames", "arm")
"""Those whose clocks have maps; what else stands among the clocks is for people."""
_INT64 = range(-(2**63), 2**63)
_TEXT = ("trial", "experiment", "role")
_WHOLE = ("repetition", "block", "attempt")
_COUNTS = ("events", "frames", "poses", "pulses")


def check_record(record: Json) -> None:
    """Look at what is relied on.

    Raises:
        ValueError: it is not there, or is something else; the message names the key.
    """
    for name in _TEXT:
        _is(isinstance(record.get(name), str), name, "must be text")
    for name in _WHOLE:
        _whole(record.get(name), name)
    _is(isinstance(record.get("simulated"), bool), "simulated", "must be true or false")
    _number(record.get("recorded_s"), "recorded_s")
    counts = _mapping(record.get("counts"), "counts")
    for name in _COUNTS:
        _whole(counts.get(name), f"counts.{name}")
    quality = _mapping(record.get("quality"), "quality")
    _is(isinstance(quality.get("passed"), bool), "quality.passed", "must be true or false")
    for name, level in _mapping(record.get("condition"), "condition").items():
        _level(level, f"condition.{name}")
    _clocks(_mapping(record.get("clocks"), "clocks"))
    _steps(record.get("steps", []))


def check_clocks(clocks: Any) -> None:
    """The same of a trial's clocks alone.

    Raises:
        ValueError: as `check_record`.
    """
    _clocks(_mapping(clocks, "clocks"))


def _clocks(clocks: Json) -> None:
    _is("events" in clocks, "clocks.events", "is missing")
    for device in DEVICES:
        if device not in clocks:
            continue
        key = f"clocks.{device}"
        known = _mapping(clocks[device], key)
        if (error := known.get("uncertainty_ns")) is not None:
            _number(error, f"{key}.uncertainty_ns")
        try:
            ClockMap.from_json(known["map"])
        except (KeyError, TypeError, ValueError) as fault:
            raise ValueError(f"{key}.map: {fault!r:.120}") from None


def _steps(steps: Any) -> None:
    _is(isinstance(steps, list), "steps", "must be a list")
    for index, step in enumerate(steps):
        key = f"steps[{index}]"
        _is(isinstance(_mapping(step, key).get("phase"), str), f"{key}.phase", "must be text")
        for name in ("start_ns", "end_ns"):
            _whole(step.get(name), f"{key}.{name}")


def _level(level: Any, key: str) -> None:
    """A word, or a number with its unit."""
    _is(isinstance(level, str), key, "must be text")
    number, _, unit = level.partition(" ")
    if unit:
        try:
            _number(float(number), key)
        except ValueError:
            raise ValueError(f"{key} = {level!r:.60}: must be a number with its unit") from None


def _mapping(value: Any, key: str) -> Json:
    _is(isinstance(value, dict), key, "must be a mapping")
    found: Json = value
    return found


def _whole(value: Any, key: str) -> None:
    good = isinstance(value, int) and not isinstance(value, bool) and value in _INT64
    _is(good, key, "must be an integer")


def _number(value: Any, key: str) -> None:
    good = isinstance(value, int | float) and not isinstance(value, bool)
    try:
        good = good and math.isfinite(value)
    except OverflowError:
        good = False
    _is(good, key, "must be a finite number")


def _is(good: bool, key: str, right: str) -> None:
    if not good:
        raise ValueError(f"{key}: {right}")
