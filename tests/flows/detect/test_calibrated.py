"""Live detection by a calibration of `sliplab calibrate detector`."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from sliplab.analysis.detectors.at_level import AtLevel
from sliplab.analysis.detectors.feeding import feed
from sliplab.analysis.detectors.registry import contents, make_detector
from sliplab.flows.detect import detect
from sliplab.flows.detecting.detector_process import DetectorProcess, OwnProcess
from sliplab.flows.detecting.request import make_detect_request
from sliplab.flows.detecting.sources import named_source
from sliplab.protocols import InputError
from sliplab.rigs.rig_file import load_rig_file
from sliplab.storage.files import read_json, write_json
from tests.command_line import here
from tests.conftest import ROOT
from tests.flows.detect.detecting import RIG
from tests.flows.detect.test_named import Recording
from tests.patching import loose


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


def test_it_is_known_by_its_contents(document: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.json"
    write_json(other, {**read_json(document), "level": 99.0})
    assert contents(str(document)) != contents(str(other))
    with pytest.raises(InputError, match="cannot be read"):
        make_detector(str(tmp_path / "gone.json"))
