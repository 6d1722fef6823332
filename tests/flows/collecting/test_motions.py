"""Motions that are written as data go through collection and labels on the simulated rig."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from sliplab.flows.planning.run_request import make_request
from sliplab.protocols import InputError
from sliplab.storage.files import read_json
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import TrialStore
from tests.command_line import answer
from tests.conftest import ROOT
from tests.flows.conftest import tiny, write
from tests.flows.live import free_udp_port, rig_yaml
from tests.rigs.waiting import own_address

RIG = ROOT / "rigs" / "rehearsal.yaml"


def template(name: str, **values: str) -> dict[str, str]:
    """A template's motion with the depth and the speed as factors."""
    shared = {"depth": "$depth", "speed": "$speed", "settle": "0.5 s", "hold": "1.5 s"}
    return {"template": name, **shared, **values}


def agrees(recording: Recording, store: Path) -> dict[str, Any]:
    """The label of a store's only trial, whose onsets are the true ones within three frames."""
    (path,) = (store / "derived" / "labels").rglob("*.json")
    found, truth = read_json(path), recording.simulation_truth() or {}
    for onset in ("incipient_ns", "gross_ns"):
        assert abs(found[onset] - truth["from_hold"][onset]) < 30e6
    return found


def collected(folder: Path, motion: Any, rig: Path = RIG, **factors: Any) -> TrialStore:
    """The only trial of a protocol with another motion and other factors, labelled."""
    data = tiny()
    data["name"] = "moves"
    collection = data["collection"]
    collection["motion"] = motion
    collection["factors"].pop("direction")
    collection["factors"] |= factors
    # one press through real drivers, in real time, is as good as three
    collection["maintenance"]["warm_up"] |= {"presses": 1, "speed": "6 mm/s", "clearance": "2 mm"}
    collection["limits"] |= {"twist": "60 deg", "twist_speed": "20 deg/s"}
    data["analysis"]["split"] = {"method": "ranked", "strata": ["depth"]}
    protocol = write(folder / "moves.yaml", data)
    done = answer("collect", protocol, "--rig", rig, "--store", folder / "store")
    assert (done["committed"], done["missing"]) == (1, 0)
    assert answer("label", folder / "store")["done"] == 1
    return TrialStore.open(folder / "store")


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
    motion = template("kinematic", distance="5 mm", direction="90 deg")
    store = collected(tmp_path, motion)
    kept = yaml.safe_load(store.campaign("moves").protocol_file.read_text())
    phases = [phase["phase"] for phase in kept["collection"]["motion"]]
    assert phases == ["approach", "press", "hold", "slide", "release", "return"]
    # and goes on with the protocol that names the template
    make_request(tmp_path / "moves.yaml", RIG, tmp_path / "store")


def test_a_twist_is_collected_and_labelled_as_it_was(tmp_path: Path) -> None:
    """The outer papillae slip first; gross slip begins with the last besides the centre one."""
    motion = template("press_twist", angle="-40 deg")
    store = collected(tmp_path, motion, speed={"unit": "deg/s", "values": [8]})
    (recording,) = store.campaign("moves").recordings()
    assert recording.motion_phase == "twist"
    begin, end = recording.motion_ns
    assert abs((end - begin) / 1e9 - 5.0) < 0.02
    found = agrees(recording, store.folder)
    assert begin < found["incipient_ns"] < found["gross_ns"] < end
    truth = recording.simulation_truth()
    assert truth["per_papilla_ns"][0] is None  # the centre turns on the spot
    assert found["gross_ns"] - found["incipient_ns"] > 1e9

    with recording.open() as reader:
        poses = reader.poses()
    t_ns = np.asarray(recording.clock("arm").to_reference(poses.t_ns))
    during = (t_ns > begin + 50_000_000) & (t_ns < end - 50_000_000)
    turned = Rotation.from_rotvec(poses.rotvec_deg, degrees=True)
    angle = (turned[0].inv() * turned).as_rotvec(degrees=True)[during]
    expected = -8e-9 * (t_ns[during] - begin)
    assert np.abs(angle[:, 2] - expected).max() < 0.05
    assert np.abs(angle[:, :2]).max() < 1e-3
    moved = poses.xyz_mm[during] - poses.xyz_mm[during][0]
    assert np.abs(moved).max() < 0.02  # noise of the poses alone


@pytest.mark.long
@pytest.mark.realtime
@pytest.mark.xdist_group("scene")
def test_a_twist_of_a_ur_arm_is_labelled_as_it_was(tmp_path: Path) -> None:
    """The real driver on its fake, which moves the sensor in the simulated scene."""
    motion = template("press_twist", angle="40 deg", press="4 mm/s")
    speed = {"unit": "deg/s", "values": [10]}
    store = collected(tmp_path, motion, rig_yaml(tmp_path), speed=speed)
    (recording,) = store.campaign("moves").recordings()
    begin, end = recording.motion_ns
    assert (end - begin) / 1e9 == pytest.approx(40 / 10 + 0.2, abs=0.1)  # with its ramps
    agrees(recording, store.folder)


def abb_yaml(folder: Path, driver: str = "abb") -> Path:
    """The loopback rig with the arm of rigs/irb120.yaml, whose poses are timed by their arrival."""
    loopback = yaml.safe_load((ROOT / "rigs" / "loopback.yaml").read_text())["devices"]["arm"]
    irb120 = yaml.safe_load((ROOT / "rigs" / "irb120.yaml").read_text())
    reached: dict[str, Any] = {"driver": driver, "host": own_address()}
    if driver == "abb":
        reached |= {"rws_port": 8080, "egm_bind": "127.0.0.1", "egm_port": free_udp_port()}
    arm = {**reached, "tool": irb120["devices"]["arm"]["tool"], "limits": loopback["limits"]}
    timing = {**irb120["timing"], "pose_delay": {"shortest_us": 0, "longest_us": 200_000}}
    return rig_yaml(folder, devices={"arm": arm}, timing=timing)


def twists(*angles_deg: int) -> dict[str, Any]:
    """Press-twists of one depth and speed."""
    data: dict[str, Any] = yaml.safe_load((ROOT / "protocols" / "press_twist.yaml").read_text())
    collection = data["collection"]
    collection["factors"] |= {
        "depth": {"unit": "mm", "values": [2.4]},
        "speed": {"unit": "deg/s", "values": [10]},
        "angle": {"unit": "deg", "values": list(angles_deg)},
    }
    collection["motion"] |= {"settle": "0.5 s", "hold": "1.5 s"}
    collection |= {"repetitions": 1, "maintenance": {}}
    data["analysis"]["split"] = {"method": "ranked"}
    return data


@pytest.mark.long  # a twist of the simulated arm is labelled above, and this driver tried apart
@pytest.mark.realtime
@pytest.mark.xdist_group("scene")
def test_a_twist_of_an_abb_arm_is_labelled_as_it_was(tmp_path: Path) -> None:
    """Through the real driver, motion programs and EGM, on its fake."""
    data = twists(-40)
    data["collection"]["motion"]["press"] = "4 mm/s"
    data["collection"]["gates"] = {"sync_uncertainty": {"host_time": "0.5 s"}}
    protocol, store = write(tmp_path / "twists.yaml", data), tmp_path / "store"
    done = answer("collect", protocol, "--rig", abb_yaml(tmp_path), "--store", store)
    assert (done["committed"], done["missing"]) == (1, 0)
    assert answer("label", store)["done"] == 1
    (recording,) = TrialStore.open(store).campaign("press_twist").recordings()
    begin, end = recording.motion_ns
    assert (end - begin) / 1e9 == pytest.approx(40 / 10, abs=0.3)
    agrees(recording, store)


def test_an_arm_that_rests_between_pieces_is_refused_a_twist_beforehand(tmp_path: Path) -> None:
    protocol, rig = write(tmp_path / "twists.yaml", twists(40)), abb_yaml(tmp_path, "abb_socket")
    with pytest.raises(
        InputError, match=r"devices.arm.driver = abb_socket: cannot turn the tool evenly.*'abb'"
    ):
        make_request(protocol, rig, tmp_path / "store")


@pytest.mark.long
def test_a_network_is_trained_and_judged_on_twists(tmp_path: Path) -> None:
    """One twist to learn from, two to judge by."""
    data = twists(-40, 35, 40)
    data["analysis"]["split"] = {
        "method": "leave_conditions_out",
        "validation_levels": {"angle": ["35 deg"]},
        "test_levels": {"angle": ["40 deg"]},
    }
    data["analysis"]["training"] = {"epochs": 2}
    protocol, store = write(tmp_path / "twists.yaml", data), tmp_path / "store"
    assert answer("collect", protocol, "--rig", RIG, "--store", store)["committed"] == 3
    assert answer("label", store)["done"] == 3
    for step in ("train", "evaluate", "report"):
        answer(step, store)
    summary = read_json(store / "report" / "summary.json")
    (trial,) = summary["trials"]
    assert trial["trial"].startswith("angle=40deg,")
    assert trial["outcome"] != "without_onsets"
    assert summary["kinematic"]["accuracy"]["argmax"] > 0.5
