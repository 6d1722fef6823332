"""Trials with a force sensor through the real drivers: an ATI Net F/T on the wire."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sliplab.analysis.force import plate_forces
from sliplab.flows.collecting.session import TrialCollector
from sliplab.flows.planning.run_request import RunRequest, describe_campaign
from sliplab.protocols import InputError
from sliplab.rigs.build import build_rig
from sliplab.rigs.core.capabilities import RigError
from sliplab.storage.trials.store import Store
from sliplab.storage.trials.verify import verify
from tests.conftest import ROOT
from tests.flows.conftest import write
from tests.flows.live import at_work, quick, request_in, stage_of, take_all
from tests.rigs.waiting import own_address

pytestmark = pytest.mark.realtime

LONGEST_US = 400_000
"""What a busy machine may add to the 20 ms by which the scene follows the clock."""
AGREE_N = 0.3


def force_yaml(folder: Path, **mock: Any) -> Path:
    """The shipped loopback rig with a fake of an ATI Net F/T."""
    host = own_address()
    data = {
        "extends": str(ROOT / "rigs" / "loopback.yaml"),
        "name": "loopback",
        "devices": {
            "arm": {"host": own_address()},
            "force_sensor": {"driver": "ati_net_ft", "host": host},
        },
        "timing": {"force": {"delay": {"shortest_us": 0, "longest_us": LONGEST_US}}},
        "mock": {"arm": {"start_xyz_mm": [397, 0, 300]}, "force": {}, **mock},
    }
    return write(folder / "rig.yaml", data)


def wide() -> dict[str, Any]:
    """A slide whose gate of host times allows for a busy machine."""
    data = quick()
    data["collection"].setdefault("gates", {})["sync_uncertainty"] = {"host_time": "0.5 s"}
    return data


@pytest.fixture(scope="module")
def run_request(tmp_path_factory: pytest.TempPathFactory) -> RunRequest:
    folder = tmp_path_factory.mktemp("loopback-force")
    return request_in(folder / "live", wide(), force_yaml(folder))


def test_forces_come_through_the_wire_as_the_mock_has_them(
    run_request: RunRequest, tmp_path: Path
) -> None:
    with stage_of(run_request.rig) as stage, at_work(run_request, stage) as (work, campaign):
        take_all(work)
        assert [failed["cause"] for failed in campaign.quarantined()] == []
        (live,) = campaign.recordings()
    assert verify(Store.open(run_request.store)) == []
    counts = (live.record.devices or {})["force_sensor"]["counts"]
    assert (counts["lost"], counts["late"], counts["malformed"]) == (0, 0, 0)
    mock = request_in(tmp_path / "mock", wide(), run_request.store.parent.parent / "rig.yaml")
    file = run_request.rig.model_copy(update={"driver": "mock", "devices": None})
    other = describe_campaign(Store.create(mock.store), mock)
    rig = build_rig(file)
    rig.connect()
    take_all(TrialCollector(mock.plan, file, rig, other))
    (by_mock,) = other.recordings()
    found = []
    for recording in (live, by_mock):
        forces = plate_forces(recording)
        held = forces.between(*recording.step("hold"))
        slid = forces.between(*recording.step("slide"))
        found.append([held.normal_n.mean(), slid.tangential_n.max(), slid.normal_n.mean()])
        assert np.all(np.diff(forces.t_ns) > 0)
    print(f"simulated forces, N: drivers {found[0]}, mock {found[1]}")
    assert found[0] == pytest.approx(found[1], abs=AGREE_N)


@pytest.mark.parametrize(
    ("kind", "said"),
    [("silence", "nothing came for"), ("overload", "force or torque out of range")],
)
def test_a_sensor_at_fault_stops_the_arm_first(
    run_request: RunRequest, tmp_path: Path, kind: str, said: str
) -> None:
    request = request_in(tmp_path / "live", wide(), run_request.store.parent.parent / "rig.yaml")
    with stage_of(request.rig) as stage, at_work(request, stage) as (work, campaign):
        look = work.rig.should_stop

        def happens() -> bool:
            if stage.arm_place()[2] > 1.0:
                stage.inject("force_sensor", kind)
            return look()

        work.rig.should_stop = happens
        with pytest.raises(RigError, match=f"force sensor: .*{said}"):
            take_all(work)
        assert stage.at_rest()
        assert campaign.committed() == set()


def test_a_loopback_rig_needs_the_scene_of_its_sensor(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"mock.force: .*is needed: it is what the fake"):
        request_in(tmp_path / "a", quick(), force_yaml(tmp_path, force=None))


def test_the_arm_presses_to_a_force_through_the_wire(
    run_request: RunRequest, tmp_path: Path
) -> None:
    data = wide()
    data["collection"]["motion"][1] = {
        "phase": "press", "force": "1 N", "depth": "3 mm", "speed": "1 mm/s",
    }  # fmt: skip
    data["collection"]["factors"].pop("depth")
    request = request_in(tmp_path / "live", data, run_request.store.parent.parent / "rig.yaml")
    with stage_of(request.rig) as stage, at_work(request, stage) as (work, campaign):
        take_all(work)
        assert [failed["cause"] for failed in campaign.quarantined()] == []
        (recording,) = campaign.recordings()
    figures = recording.record.streams["force"].figures
    # a busy machine reads late, so that it presses a little further; the skin relaxes in the hold
    assert 0.7 < figures["normal_hold_n"] < 1.5
    assert 0.8 < figures["pressed_mm"] < 2.6
