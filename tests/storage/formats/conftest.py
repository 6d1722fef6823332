"""Fixtures for the tests of foreign file formats."""

import pytest

from sliplab.plugins.formats.lab import events as lab_pickles
from tests.storage.formats.files import SMALL


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make the lab's camera one of few pixels: 307,200 lists take seconds to make."""
    monkeypatch.setattr(lab_pickles, "SIZES", (SMALL,))
