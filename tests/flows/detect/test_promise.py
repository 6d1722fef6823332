"""A promise of false alarms in live detection: watched, and said where it is contradicted."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sliplab.analysis.detectors.at_level import AtLevel
from sliplab.analysis.detectors.detector import Detector, Evidence
from sliplab.flows.detect import detect
from sliplab.flows.detecting.request import make_detect_request
from sliplab.flows.detecting.sources import named_source
from sliplab.storage.streams import EventChunk
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


class Lasting(Detector):
    """One alarm at 100 ms, after which tips count as slipped: the label says slip on."""

    def begin(self, width: int, height: int) -> None:
        self._said = 0

    def push(self, events: EventChunk, until_us: int) -> Evidence:
        t_us = np.arange(self._said + 100_000, until_us + 1, 100_000)
        self._said = int(t_us[-1]) if len(t_us) else self._said
        value = (t_us == 100_000).astype(float)
        return replace(Evidence.of(t_us, value), slipped=np.full(len(t_us), 0.5))


def test_a_label_that_lasts_is_one_alarm_as_where_levels_are_set() -> None:
    source = named_source("never", 0.5, None)
    order = make_detect_request(RIG, None, detector=source, seconds=3, promise=1.0)
    result = detect(order, detector=AtLevel(Lasting(), 0.5), show=False)
    assert result["states"]["incipient"] > 20
    assert result["promise"] is not None
    assert result["promise"]["alarms"] == 1


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
