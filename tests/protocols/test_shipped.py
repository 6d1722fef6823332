"""Shipped protocols are found by name, from any folder."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from sliplab.protocols import InputError, load_plan
from sliplab.protocols.shipped import protocol_path, shipped_protocols


@pytest.mark.parametrize("name", ["pilot-gravity", "pilot_gravity"])
def test_a_name_means_the_shipped_file(name: str, tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.chdir(tmp_path)
    assert protocol_path(Path(name)) == shipped_protocols()["pilot_gravity"]
    assert len(load_plan(Path(name)).trials) == 8


def test_a_file_of_ones_own_goes_before_a_shipped_one(tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "pilot").write_text("protocol: 1\n")
    assert protocol_path(Path("pilot")) == Path("pilot")


def test_an_unknown_name_is_answered_with_those_there_are(tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match="built-in: disturbance, gravity, kinematic"):
        load_plan(Path("pilott"))
