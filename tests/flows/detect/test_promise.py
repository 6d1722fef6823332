"""A promise of false alarms in live detection: watched, and said where it is contradicted."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from sliplab.flows.detect import detect
from sliplab.flows.detecting.request import make_detect_request
from sliplab.flows.detecting.sources import named_source
from tests.command_line import here
from tests.flows.detect.detecting import RIG


def test_alarms_while_listening_contradict_a_promise(capsys: pytest.CaptureFixture[str]) -> None:
    source = named_source("always", 0.5, None)
    order = make_detect_request(RIG, None, detector=source, seconds=5, promise=1.0)
    promise = detect(order)["promise"]
    assert promise is not None
    assert promise["alarms"] == 6, "one a second, and in the tail that is read after five"
    assert promise["hours"] == pytest.approx(5 / 3600, rel=0.03)
    assert not promise["declared"]
    assert promise["broken_h"] == pytest.approx(1 / 3600, rel=0.1)
    assert "at most 1 false alarms an hour" in promise["says"]
    assert promise["says"].endswith("unless something slipped")
    warned = [line for line in capsys.readouterr().err.splitlines() if "warning" in line]
    assert "0 h without slip bound no rate" in warned[0], "nothing was measured at this level"
    assert "2 alarms in" in warned[1]
    assert len(warned) == 2


def test_a_detector_that_says_nothing_keeps_any(capsys: pytest.CaptureFixture[str]) -> None:
    source = named_source("never", 0.5, None)
    order = make_detect_request(RIG, None, detector=source, seconds=1, promise=1.0)
    promise = detect(order)["promise"]
    assert promise is not None
    assert (promise["alarms"], promise["broken_h"]) == (0, None)
    assert "contradict" not in capsys.readouterr().err


def test_in_a_trial_the_hold_counts_and_its_motion_does_not(protocol: Path) -> None:
    """Half a second of hold; a detector that always triggers has one alarm in it."""
    source = named_source("always", 0.5, None)
    order = make_detect_request(
        RIG, None, protocol=protocol, trial="", detector=source, promise=1.0
    )
    promise = detect(order, show=False)["promise"]
    assert promise is not None
    assert promise["declared"]
    assert promise["alarms"] == 1
    assert promise["hours"] == pytest.approx(0.5 / 3600, rel=0.2)
    assert not promise["says"].endswith("slipped")


def test_without_a_promise_nothing_is_watched() -> None:
    asked = ("detect", "--rig", RIG, "--detector", "never", "--level", "1", "--seconds", "0.5")
    assert json.loads(here(*asked, "--json").stdout)["promise"] is None
    assert json.loads(here(*asked, "--promise", "30", "--json").stdout)["promise"]["per_hour"] == 30
    assert here(*asked, "--promise", "0", "--json").returncode == 2
