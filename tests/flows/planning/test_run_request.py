"""A changed protocol is refused with what changed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

from sliplab.flows.planning.run_request import describe_campaign, make_request
from sliplab.protocols import load_plan
from sliplab.rigs.rig_file import load_rig_file
from sliplab.storage.trials.store import StoreError, TrialStore
from tests.conftest import ROOT
from tests.flows.conftest import tiny, write
from tests.storage.trial_files import commit

RIG = ROOT / "rigs" / "rehearsal.yaml"


def begin(folder: Path, data: dict[str, Any]) -> TrialStore:
    """A store in which a campaign under `data` was begun."""
    run_request = make_request(write(folder / "p.yaml", data), RIG, folder / "store")
    store = TrialStore.create(folder / "store")
    describe_campaign(store, run_request)
    return store


def refused(folder: Path, data: dict[str, Any], rig: Path = RIG) -> str:
    with pytest.raises(StoreError) as error:
        make_request(write(folder / "new.yaml", data), rig, folder / "store")
    return str(error.value)


def test_what_changed_in_the_collection_is_said(tmp_path: Path) -> None:
    begin(tmp_path, tiny())
    data = tiny()
    data["collection"]["motion"][1]["speed"] = "1 mm/s"
    data["collection"]["gates"]["retakes"] = 5
    data["collection"]["maintenance"]["rezero"] |= {"every": 4, "touches": 5}
    data["collection"]["factors"]["direction"]["values"].append(330)  # this alone would do
    message = refused(tmp_path, data)
    assert "was begun under another `collection:` section" in message
    for line in (
        "collection.motion[1].speed: 2 mm/s -> 1 mm/s",
        "collection.gates.retakes: 2 -> 5",
        "collection.maintenance.rezero.every: 3 -> 4",
        "collection.maintenance.rezero.touches: not there -> 5",
    ):
        assert f"\n  {line}" in message


def test_another_way_to_write_the_same_is_no_change(tmp_path: Path) -> None:
    begin(tmp_path, tiny())
    data = tiny()
    data["collection"]["motion"][1]["speed"] = "0.2 cm/s"
    data["collection"]["gates"]["path_deviation"] = "0.1 mm"  # the default
    data["collection"]["maintenance"]["rezero"]["touches"] = 1  # the default, newer than stores
    make_request(write(tmp_path / "new.yaml", data), RIG, tmp_path / "store")


def test_the_gate_of_references_is_a_change_only_where_it_is_set(tmp_path: Path) -> None:
    begin(tmp_path, tiny())
    data = tiny()
    condition = {"depth": 2.4, "speed": 1.6, "direction": 0}
    data["collection"]["references"] = {"every": 3, "condition": condition}
    make_request(write(tmp_path / "new.yaml", data), RIG, tmp_path / "store")
    data["collection"]["gates"]["reference"] = {"event_rate": "20 %"}
    assert "collection.gates.reference: not there -> {event_rate: 20 percent}" in refused(
        tmp_path, data
    )


def test_hashes_of_protocols_that_ship_stay() -> None:
    """Campaigns that were begun before a key came go on."""
    known = {
        "kinematic": "a3e25ea978e4264238f892545d9bf72cd3fdedd908a3109a2e7768918d960a4b",
        "gravity": "321273f535d61abbd06e7e85b4047352b8591c8e5e62aad11694544842f27e2b",
        "disturbance": "447dae83d2d994b5459cf17d5c125a2a71602de61ee25bd8de5f72ce32c4fd55",
    }
    for name, expected in known.items():
        assert load_plan(ROOT / "protocols" / f"{name}.yaml").collection_hash == expected


def test_hashes_of_protocols_that_shipped_before_stay(tmp_path: Path) -> None:
    """Those that pressed to 3.4 mm, and knew no gate on slips in the hold."""
    known = {
        "gravity": "216c0d7da5cdb00f69778b43dc3ee162182afd0e40aecd176d9ba4a4651909de",
        "disturbance": "373b0f9ad136bbd656036b6b4ebbefa777a53ba8925e8781a5f1bcca7a0652b2",
    }
    for name, expected in known.items():
        data = yaml.safe_load((ROOT / "protocols" / f"{name}.yaml").read_text())
        collection = data["collection"]
        collection["motion"] |= {"depth": "3.4 mm", "distance": "3.6 mm"}
        collection["limits"]["depth"] = "3.6 mm"
        del collection["gates"]["hold_slip"]
        assert load_plan(write(tmp_path / f"{name}.yaml", data)).collection_hash == expected


def test_a_changed_rig_and_levels_that_are_gone_are_said(tmp_path: Path) -> None:
    store = begin(tmp_path, tiny())
    rig = tmp_path / "rig.yaml"
    rig.write_text(f"extends: {RIG}\nsensor: another\n")
    sensor = load_rig_file(RIG)[0].sensor
    assert f"\n  sensor: {sensor} -> another" in refused(tmp_path, tiny(), rig)
    commit(store.campaign("tiny"), "depth=2.4mm,direction=300deg,speed=1.6mmps,r=1")
    data = tiny()
    data["collection"]["factors"]["direction"]["values"].remove(300)
    split = data["analysis"]["split"]
    split["test_levels"]["direction"].remove("300 deg")
    message = refused(tmp_path, data)
    assert "may only add trials" in message
    assert (
        "collection.factors.direction.levels: [0, 60, 120, 180, 240, 300] -> "
        "[0, 60, 120, 180, 240]" in message
    )
