"""Plans of protocols that a test changes, the error of one that is refused, tables as text."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml

from sliplab.protocols import InputError, Plan, load_plan
from tests.conftest import ROOT


def plan_of(data: dict[str, Any], folder: Path, *enable: str) -> Plan:
    """Write a protocol into `folder`, and plan it."""
    path = folder / "protocol.yaml"
    path.write_text(yaml.safe_dump(data, sort_keys=False))
    return load_plan(path, enable)


def refused(data: dict[str, Any], folder: Path) -> InputError:
    """Return the error of a protocol that cannot be planned."""
    with pytest.raises(InputError) as caught:
        plan_of(data, folder)
    return caught.value


def rows(table: str) -> list[list[str]]:
    """Return the cells of a table with a line a row and bars between them."""
    return [[cell.strip() for cell in line.split("|")] for line in table.strip().splitlines()]


def put(data: Any, place: str, value: Any) -> None:
    """Put a value at a place like ``motion[1].speed``, or drop what is there if it is None."""
    found = re.findall(r"[^.\[\]]+", place)
    *parts, last = (int(part) if part.isdigit() else part for part in found)
    for part in parts:
        data = data.setdefault(part, {}) if isinstance(data, dict) else data[part]
    if value is None:
        del data[last]
    else:
        data[last] = value


def put_all(data: Any, changes: str, where: str = "") -> None:
    """Put what a text says, such as ``driver: mock; devices:``, below a place."""
    for change in changes.split(";"):
        place, _, value = change.partition(":")
        put(data, f"{where}.{place.strip()}", yaml.safe_load(value))


def said_by(code: str, *words: str, **environment: str) -> str:
    """What code prints in a process of its own, at the checkout's root."""
    line, env = (sys.executable, "-c", code, *words), {**os.environ, **environment}
    how: Any = {"capture_output": True, "text": True, "check": True, "timeout": 120}
    said: str = subprocess.run(line, cwd=ROOT, env=env, **how).stdout
    return said
