"""Live detection by a calibration of `sliplab calibrate detector`."""

from __future__ import annotations

import json
from dataclasses import replace
from datetime import date, timedelta
from pathlib import Path
from types import SimpleNamespace

import pytest

from sliplab.analysis.detectors.at_level import AtLevel
from sliplab.analysis.detectors.feeding import feed
from sliplab.analysis.detectors.registry import contents, make_detector
from sliplab.flows.detect import detect
from sliplab.flows.detecting.detector_process import DetectorProcess, OwnProcess
from sliplab.flows.detecting.request import make_detect_request
from sliplab.flows.detecting.sources import named_source
from sliplab.protocols import InputError
from sliplab.rigs.build import ShouldStop, build_rig
from sliplab.rigs.core.rig import Rig
from sliplab.rigs.rig_file import RigFile, load_rig_file
from sliplab.storage.files import read_json, write_json
from tests.command_line import here
from tests.conftest import ROOT
from tests.flows.detect.detecting import RIG
from tests.flows.detect.test_named import Recording
from tests.patching import loose, put


def test_live_evidence_is_the_stored_one_to_the_bit(
    document: Path, protocol: Path, tmp_path: Path
) -> None:
    source, out = named_source(str(document), None, None), tmp_path / "d.jsonl"
    assert source.level == loose(source.skin).level
    order = make_detect_request(RIG, None, protocol=protocol, trial="", detector=source)
    recording = Recording(str(document))
    result = detect(order, out, detector=AtLevel(recording, source.level), show=False)
    lines = [json.loads(line) for line in out.read_text().splitlines()]
    whole = feed(make_detector(str(document)), recording.scene())
    assert [line["value"] for line in lines] == whole.value.tolist()
    assert result["onsets"]["incipient"] is not None
    again = detect(order, tmp_path / "again.jsonl", show=False)
    assert again["states"] == result["states"]
    assert again["promise"] is not None
    assert again["promise"]["per_hour"] == loose(source.skin).hold.high


@pytest.mark.long  # `test_named` has another detector in its process
def test_in_its_process_it_has_the_level_of_the_document(document: Path) -> None:
    source = named_source(str(document), None, None)
    process = DetectorProcess(source.name, source.level, None, None, OwnProcess(30.0))
    assert process.level == source.level
    process.close()


def test_the_command_takes_it_in_place_of_a_network(document: Path) -> None:
    asked = ("detect", "--rig", RIG, "--model", document, "--seconds", "0.5", "--json")
    found = json.loads(here(*asked).stdout)
    assert found["detector"] == str(document)
    assert found["model"] is None
    assert found["simulated"]
    wrong = json.loads(here(*asked, "--detector", "rate").stdout)["error"]
    assert (wrong["key"], wrong["value"]) == ("--detector", "rate")


def test_another_skin_and_a_real_rig_are_refused(document: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.json"
    write_json(other, {**read_json(document), "skin": "T7"})
    with pytest.raises(InputError, match="skin = T7: must be the skin of the rig rehearsal"):
        make_detect_request(RIG, None, seconds=1, detector=named_source(str(other), None, None))
    file, _ = load_rig_file(ROOT / "rigs" / "ur5.yaml")
    source = named_source(str(document), None, None)
    assert source.skin is not None
    theirs = source.skin.model_copy(update={"skin": file.skin.serial})
    with pytest.raises(InputError, match="simulated = true: must be false: the rig ur5"):
        replace(source, skin=theirs).check_rig(file)


def test_another_camera_is_refused(document: Path) -> None:
    source = named_source(str(document), None, None)
    file, _ = load_rig_file(RIG)
    skin = loose(source.skin).model_copy(update={"camera": "DVX1"})
    theirs = replace(source, skin=skin)
    for camera in (None, "DVX1"):
        theirs.check_rig(file, camera)
    source.check_rig(file, "DVX2")  # an older file
    with pytest.raises(InputError, match=r"camera = DVX1: must be the event camera.*'DVX2'"):
        theirs.check_rig(file, "DVX2")


def test_the_camera_is_asked_for_its_serial_number(document: Path) -> None:
    def build(file: RigFile, should_stop: ShouldStop) -> Rig:
        rig = build_rig(file, should_stop)
        put(rig.event_camera, "health", lambda: SimpleNamespace(serial="DVX2"))
        return rig

    source = named_source(str(document), None, None)
    skin = loose(source.skin).model_copy(update={"camera": "DVX1"})
    order = make_detect_request(RIG, None, seconds=1, detector=replace(source, skin=skin))
    with pytest.raises(InputError, match="camera = DVX1"):
        detect(order, build=build, show=False)


def test_another_rig_and_an_old_measurement_are_said(document: Path) -> None:
    source = named_source(str(document), None, None)
    file, _ = load_rig_file(RIG)
    assert source.doubts(file) == []
    day = (date.today() - timedelta(days=45)).isoformat()
    old = replace(source, skin=loose(source.skin).model_copy(update={"measured": day}))
    said = old.doubts(load_rig_file(ROOT / "rigs" / "mock_noisy.yaml")[0])
    assert [text.partition(" was measured ")[2].partition(":")[0] for text in said] == [
        "on the rig rehearsal, not mock-noisy",
        "45 days ago",
    ]


@pytest.mark.parametrize(
    ("rig", "level", "asked", "promised"),
    [
        ("rehearsal", 0.0, None, True),
        ("rehearsal", 0.0, 1.0, False),  # too short a hold
        ("rehearsal", 0.0, 1e5, True),
        ("rehearsal", 8.0, 1.0, False),
        ("rehearsal", 8.0, None, True),
        ("rehearsal", -8.0, None, None),
        ("rehearsal", -8.0, 1e5, False),
        ("mock_noisy", 0.0, None, None),
        ("mock_noisy", 0.0, 1e5, False),
    ],
)
def test_a_promise_needs_the_hours_of_this_rig_and_level(
    document: Path, rig: str, level: float, asked: float | None, promised: bool | None
) -> None:
    """The level is counted from the document's."""
    source = named_source(str(document), None, None)
    source = replace(source, level=loose(source.level) + level)
    where = ROOT / "rigs" / f"{rig}.yaml"
    order = make_detect_request(where, None, seconds=1, detector=source, promise=asked)
    assert (order.set_by and order.set_by.promised) == promised
    assert order.promise == (loose(source.skin).hold.high if asked is None and promised else asked)


def test_the_command_says_that_the_hold_was_too_short(document: Path) -> None:
    asked = ("detect", "--rig", RIG, "--model", document, "--seconds", "0.1", "--promise", "1")
    done = here(*asked, "--json")
    assert "a rate of 1 an hour cannot be promised" in done.stderr
    assert "it takes 3.69 h without an alarm" in done.stderr


def test_it_is_known_by_its_contents(document: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.json"
    write_json(other, {**read_json(document), "level": 99.0})
    assert contents(str(document)) != contents(str(other))
    with pytest.raises(InputError, match="cannot be read"):
        make_detector(str(tmp_path / "gone.json"))
