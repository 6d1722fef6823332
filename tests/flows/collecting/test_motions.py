"""Motions that are written as data go through collection and labels on the simulated rig."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from sliplab.flows.planning.run_request import make_request
from sliplab.storage.files import read_json
from sliplab.storage.trials.store import Store
from tests.command_line import answer
from tests.conftest import ROOT
from tests.flows.conftest import tiny, write

RIG = ROOT / "rigs" / "rehearsal.yaml"


def collected(folder: Path, motion: Any) -> Store:
    """The only trial of a protocol with another motion, labelled."""
    data = tiny()
    data["name"] = "moves"
    collection = data["collection"]
    collection["motion"] = motion
    collection["factors"].pop("direction")
    data["analysis"]["split"] = {"method": "ranked", "strata": ["depth"]}
    protocol = write(folder / "moves.yaml", data)
    done = answer("collect", protocol, "--rig", RIG, "--store", folder / "store")
    assert (done["committed"], done["missing"]) == (1, 0)
    assert answer("label", folder / "store")["done"] == 1
    return Store.open(folder / "store")


def test_slip_is_looked_for_in_all_moves_in_contact(tmp_path: Path) -> None:
    """Up and to the right, in two moves with a rest between them."""
    motion = [
        {"phase": "approach", "clearance": "5 mm", "speed": "20 mm/s"},
        {"phase": "move", "to": {"x": "-3 mm"}, "speed": "10 mm/s"},
        {"phase": "press", "depth": "$depth", "speed": "2 mm/s"},
        {"phase": "hold", "settle": "0.5 s", "duration": "1.5 s"},
        {"phase": "move", "by": {"y": "3 mm"}, "speed": "$speed"},
        {"phase": "hold", "duration": "0.3 s"},
        {"phase": "move", "to": {"x": "3 mm"}, "speed": "$speed"},
        {"phase": "release", "clearance": "5 mm", "speed": "10 mm/s"},
        {"phase": "return", "speed": "20 mm/s"},
    ]
    store = collected(tmp_path, motion)
    (recording,) = store.campaign("moves").recordings()
    assert recording.motion_phase == "move"
    begin, end = recording.motion_ns
    assert abs((end - begin) / 1e9 - (3 / 1.6 + 0.3 + 6 / 1.6)) < 0.02
    found = read_json(next((tmp_path / "store" / "derived" / "labels" / "moves").glob("*.json")))
    assert begin < found["incipient_ns"] <= found["gross_ns"] < end


def test_a_campaign_keeps_its_motion_written_out(tmp_path: Path) -> None:
    motion = {
        "template": "kinematic", "depth": "$depth", "distance": "5 mm", "speed": "$speed",
        "direction": "90 deg", "settle": "0.5 s", "hold": "1.5 s",
    }  # fmt: skip
    store = collected(tmp_path, motion)
    kept = yaml.safe_load(store.campaign("moves").protocol_file.read_text())
    assert [phase["phase"] for phase in kept["collection"]["motion"]] == [
        "approach", "press", "hold", "slide", "release", "return",
    ]  # fmt: skip
    # and goes on with the protocol that names the template
    make_request(tmp_path / "moves.yaml", RIG, tmp_path / "store")
