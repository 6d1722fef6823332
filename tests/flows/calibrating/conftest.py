"""Fixtures for tests of the commands that teach and calibrate."""

from __future__ import annotations

import pytest


@pytest.fixture
def no_rig(monkeypatch: pytest.MonkeyPatch) -> None:
    """No rig may be built."""

    def never(*_: object) -> None:
        raise AssertionError("a rig was built")

    monkeypatch.setattr("sliplab.rigs.build.build_rig", never)
