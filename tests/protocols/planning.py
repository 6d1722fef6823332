"""Plans of protocols that a test changes, and the error of one that is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

from sliplab.protocols import InputError, Plan, load_plan


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
