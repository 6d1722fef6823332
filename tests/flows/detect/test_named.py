"""Detectors by their names on the simulated rig: the bench's and another package's."""

from __future__ import annotations

import json
import os
import signal
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sliplab.analysis.detectors.at_level import AtLevel
from sliplab.analysis.detectors.detector import Detector, DetectorError, Evidence, Scene, Slip
from sliplab.analysis.detectors.feeding import feed
from sliplab.analysis.detectors.registry import make_detector
from sliplab.flows.detect import detect
from sliplab.flows.detecting.detector_process import DetectorProcess, OwnProcess
from sliplab.flows.detecting.request import make_detect_request
from sliplab.flows.detecting.sources import named_source
from sliplab.protocols import InputError
from sliplab.rigs.core.capabilities import RigError
from sliplab.rigs.core.rig import Rig
from sliplab.storage.streams import EventChunk
from tests.command_line import here
from tests.flows.conftest import write
from tests.flows.detect.detecting import RIG, keeping, stands_clear


class Recording(Detector):
    """Another detector, whose events are kept."""

    def __init__(self, name: str) -> None:
        self._detector, self.events = make_detector(name), EventChunk.empty()

    def begin(self, width: int, height: int) -> None:
        self._size = (width, height)
        self._detector.begin(width, height)

    def push(self, events: EventChunk, until_us: int) -> Evidence:
        self.events, self.until_us = EventChunk.concatenate([self.events, events]), until_us
        return self._detector.push(events, until_us)

    def scene(self) -> Scene:
        return Scene("live", self.events, *self._size, self.until_us, Slip(0, 0, 0))


class Failing(Detector):
    """Fails after a second of a scene."""

    def begin(self, width: int, height: int) -> None:
        pass

    def push(self, events: EventChunk, until_us: int) -> Evidence:
        if until_us <= 1_000_000:
            return Evidence.of([], [])
        return Evidence.of([until_us], [np.nan])


@pytest.mark.quick(1)
@pytest.mark.parametrize("name", ["rate", "flow"])
def test_the_bench_says_live_what_it_says_of_the_events(
    name: str, protocol: Path, tmp_path: Path
) -> None:
    """In one piece as in those of the rig, and at the level as judged afterwards."""
    source, out = named_source(name, 40.0, None), tmp_path / "d.jsonl"
    order = make_detect_request(RIG, None, protocol=protocol, trial="", detector=source)
    recording = Recording(name)
    result = detect(order, out, detector=AtLevel(recording, 40.0))
    lines = [json.loads(line) for line in out.read_text().splitlines()]
    whole = feed(make_detector(name), recording.scene())
    assert [line["value"] for line in lines] == whole.value.tolist()
    assert [line["state"] == "incipient" for line in lines] == (whole.value > 40.0).tolist()
    assert len(lines) > 100
    assert result["model"] is None
    assert result["detector"] == name
    assert result["losses"] == {"late": 0, "disordered": 0, "gaps": 0, "longest_gap_us": 0}
    again = detect(order, tmp_path / "again.jsonl")
    assert again["states"] == result["states"]


def test_it_triggers_a_reflex(protocol: Path) -> None:
    rigs: list[Rig] = []
    source = named_source("always", 0.5, None)
    order = make_detect_request(
        RIG, None, protocol=protocol, trial="", detector=source, reflex="stop", hold_s=0.1
    )
    reflex = detect(order, build=keeping(rigs))["reflex"]
    assert (reflex["done"], reflex["phase"]) == (True, "slide")
    assert stands_clear(rigs[0])


def test_the_arm_stops_where_it_fails(protocol: Path) -> None:
    rigs: list[Rig] = []
    source = named_source("never", 0.5, None)
    order = make_detect_request(RIG, None, protocol=protocol, trial="", detector=source)
    for reflex in (
        None,
        make_detect_request(
            RIG, None, protocol=protocol, trial="", detector=source, reflex="stop"
        ).reflex,
    ):
        with pytest.raises(RigError, match="detector: a value of evidence is nan or inf"):
            detect(
                replace(order, reflex=reflex), detector=AtLevel(Failing(), 0), build=keeping(rigs)
            )
        assert stands_clear(rigs[-1])


@pytest.mark.long
def test_in_its_process_it_is_the_same_and_a_hang_ends_in_time() -> None:
    rng = np.random.default_rng(1)
    t_us = np.sort(rng.integers(0, 300_000, 3000))
    x, y = (rng.integers(0, side, 3000).astype(np.uint16) for side in (640, 480))
    given = EventChunk(x, y, rng.integers(0, 2, 3000).astype(np.uint8), t_us)
    scene = Scene("", given, 640, 480, 300_000, Slip(0, 0, 0))
    process = DetectorProcess("flow", 2.5, None, None, OwnProcess(30.0))
    assert process.level == 2.5
    there, here_too = feed(process, scene), feed(make_detector("flow"), scene)
    np.testing.assert_array_equal(there.value, here_too.value)
    process._answer_s = 0.5
    os.kill(process._process.pid, signal.SIGSTOP)
    with pytest.raises(DetectorError, match=r"no answer within 0\.5 s"):
        process.push(given, 300_001)
    process.close()


@pytest.mark.long  # `test_safe_state` has the network in its process
def test_a_safe_state_has_it_in_a_process_of_its_own(protocol: Path, tmp_path: Path) -> None:
    rig = write(tmp_path / "r.yaml", {"extends": str(RIG), "reflex": {"safe_state": "stop"}})
    source = named_source("always", 0.5, None)
    order = make_detect_request(
        rig, None, protocol=protocol, trial="", detector=source, reflex="stop", hold_s=0.1
    )
    assert order.own_process is not None
    assert detect(order)["reflex"]["done"]


def test_what_cannot_be_had_is_said(tmp_path: Path) -> None:
    for name, level, said in (
        ("ours", 1.0, "--model: is needed: 'ours' is trained on the trials of a store"),
        ("rate", None, "--level: is needed, or a store as --model"),
    ):
        with pytest.raises(InputError, match=said):
            named_source(name, level, None)
    asked = ("detect", "--rig", RIG, "--seconds", "1", "--json")
    for options, said in (
        ((), "--model: is needed"),
        (("--detector", "rat", "--level", "1"), "one of a store needs the store as --model"),
        (("--detector", "rate", "--level", "1", "--margin", "2"), "is of the rule"),
    ):
        done = here(*asked, *options)
        assert done.returncode == 2
        assert said in json.loads(done.stdout)["error"]["message"]
    always = here(*asked, "--detector", "rate", "--level", "-5")
    assert always.returncode == 2
    right = "level = -5.0: must be higher: without an event its evidence is 0 already"
    assert right in json.loads(always.stdout)["error"]["message"]
