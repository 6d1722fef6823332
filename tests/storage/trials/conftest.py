"""A campaign to take trials in."""

from __future__ import annotations

from pathlib import Path

import pytest

from sliplab.storage.trials.store import Campaign
from tests.storage.trial_files import campaign


@pytest.fixture
def where(tmp_path: Path) -> Campaign:
    """A campaign without trials in the store `s`."""
    return campaign(tmp_path / "s")
