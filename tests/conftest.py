"""Shared by all tests: where the shipped files are, and small protocols to change."""

from __future__ import annotations

import copy
import os
import tempfile
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import settings

ROOT = Path(__file__).parents[1]
settings.register_profile("sliplab", deadline=None, derandomize=True, print_blob=True)
settings.load_profile("sliplab")

# tests that run at the same time have stand-ins of their own, at the same addresses
os.environ["SLIPLAB_RUNTIME"] = tempfile.mkdtemp(prefix="sliplab-rigs-")

SMALL: dict[str, Any] = yaml.safe_load((ROOT / "protocols" / "pilot.yaml").read_text())


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Do not import files without the mark that ``-m 'MARK and ...'`` requires."""
    mark = config.option.markexpr.split(" and ")[0]
    if mark not in {"realtime", "programs"} or collection_path.suffix != ".py":
        return None
    return f"mark.{mark}" not in collection_path.read_text() or None


@pytest.fixture
def root() -> Path:
    """The checkout."""
    return ROOT


@pytest.fixture
def small() -> dict[str, Any]:
    """The pilot protocol as data, to be changed at will."""
    return copy.deepcopy(SMALL)
