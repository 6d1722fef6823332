"""Trials with forces through the real drivers: an ATI Net F/T on the wire, and a UR's wrench."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sliplab.analysis.force import plate_forces
from sliplab.flows.planning.run_request import RunRequest
from sliplab.protocols import InputError
from sliplab.protocols.timing import Delay, ForceTiming
from sliplab.rigs.core.capabilities import RigError
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import TrialStore
from sliplab.storage.trials.verify import verify
from tests.flows.conftest import take_all
from tests.flows.live import at_work, only_trial, quick, request_in, rig_yaml, stage_of
from tests.rigs.waiting import own_address

pytestmark = [pytest.mark.realtime, pytest.mark.xdist_group("scene")]

LONGEST_US = 400_000
"""What a busy machine may add to the 20 ms by which the scene follows the clock."""
AGREE_N = 0.3


def force_yaml(folder: Path, sensor: str = "ati_net_ft", **mock: Any) -> Path:
    """The shipped loopback rig with a fake of an ATI Net F/T, or the wrench of its UR."""
    kinds: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
        "ati_net_ft": ({"host": own_address()}, {"delay": {"shortest_us": 0}}),
        "ur_wrench": ({}, {"grade": "arm clock", "delay": {"shortest_us": 20_000}}),
    }
    settings, timing = kinds[sensor]
    timing["delay"]["longest_us"] = LONGEST_US
    return rig_yaml(
        folder,
        devices={"force_sensor": {"driver": sensor, **settings}},
        timing={"force": timing},
        mock={"force": {}, **mock},
    )


def wide() -> dict[str, Any]:
    """A slide whose gate of host times allows for a busy machine."""
    data = quick()
    data["collection"].setdefault("gates", {})["sync_uncertainty"] = {"host_time": "0.5 s"}
    return data


@pytest.fixture(scope="module")
def run_request(tmp_path_factory: pytest.TempPathFactory) -> RunRequest:
    folder = tmp_path_factory.mktemp("loopback-force")
    return request_in(folder / "live", wide(), force_yaml(folder))


@pytest.mark.long
def test_forces_come_through_the_wire_as_the_mock_has_them(
    run_request: RunRequest, tmp_path: Path
) -> None:
    with stage_of(run_request.rig) as stage, at_work(run_request, stage) as (work, campaign):
        take_all(work)
        assert [failed["cause"] for failed in campaign.quarantined()] == []
        (live,) = campaign.recordings()
    assert verify(TrialStore.open(run_request.store)) == []
    counts = (live.record.devices or {})["force_sensor"]["counts"]
    assert (counts["lost"], counts["late"], counts["malformed"]) == (0, 0, 0)
    agree(live, run_request, tmp_path)


def agree(live: Recording, run_request: RunRequest, tmp_path: Path) -> None:
    """Hold a trial's forces against those that the mock rig records in the same trial."""
    mock = request_in(tmp_path / "mock", wide(), run_request.store.parent.parent / "rig.yaml")
    force = ForceTiming(delay=Delay(shortest_us=0, longest_us=4000))
    timing = run_request.rig.timing.model_copy(update={"force": force})
    file = run_request.rig.model_copy(update={"driver": "mock", "devices": None, "timing": timing})
    found = []
    for recording in (live, only_trial(mock, file)):
        forces = plate_forces(recording)
        held = forces.between(*recording.step("hold"))
        slid = forces.between(*recording.step("slide"))
        found.append([held.normal_n.mean(), slid.tangential_n.max(), slid.normal_n.mean()])
        assert np.all(np.diff(forces.t_ns) > 0)
    print(f"simulated forces, N: drivers {found[0]}, mock {found[1]}")
    assert found[0] == pytest.approx(found[1], abs=AGREE_N)


@pytest.mark.quick(1)
@pytest.mark.parametrize(
    ("kind", "said"),
    [("device_silent", "nothing came for"), ("force_overload", "force or torque out of range")],
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


@pytest.fixture(scope="module")
def by_the_arm(tmp_path_factory: pytest.TempPathFactory) -> RunRequest:
    folder = tmp_path_factory.mktemp("loopback-wrench")
    return request_in(folder / "live", wide(), force_yaml(folder, "ur_wrench"))


@pytest.mark.long
def test_a_trial_has_the_arms_own_wrench_by_its_clock(
    by_the_arm: RunRequest, tmp_path: Path
) -> None:
    with stage_of(by_the_arm.rig) as stage, at_work(by_the_arm, stage) as (work, campaign):
        take_all(work)
        assert [failed["cause"] for failed in campaign.quarantined()] == []
        (live,) = campaign.recordings()
    assert verify(TrialStore.open(by_the_arm.store)) == []
    clock = live.record.clocks.streams["force"]
    assert (clock.grade, clock.uncertainty_ns) == (
        "arm clock",
        live.record.clocks.arm.uncertainty_ns,
    )
    assert (live.record.devices or {})["force_sensor"] == {"dropped": 0}
    agree(live, by_the_arm, tmp_path)
    # stamped by the controller: what came 20 ms late is not dated late
    forces = plate_forces(live)
    start, _ = live.step("slide")
    held = forces.between(*live.step("hold")).tangential_n
    slid = forces.between(start - 100_000_000, start + 200_000_000)
    rises = slid.t_ns[slid.tangential_n > held.max() + 0.02][0]
    print(f"simulated: friction rises {(rises - start) / 1e6:.1f} ms after the slide begins")
    assert -5e6 < rises - start < 18e6


def test_a_load_beyond_the_range_is_a_protective_stop(tmp_path: Path) -> None:
    rig = force_yaml(tmp_path, "ur_wrench", force={"range_n": 1.5})
    request = request_in(tmp_path / "live", wide(), rig)
    with stage_of(request.rig) as stage, at_work(request, stage) as (work, campaign):
        with pytest.raises(RigError, match=r"arm: .*protective stop"):
            take_all(work)
        assert stage.at_rest()
        assert campaign.committed() == set()


@pytest.mark.long
@pytest.mark.parametrize(
    "sensor", ["run_request", pytest.param("by_the_arm", marks=pytest.mark.long)]
)
def test_the_arm_presses_to_a_force_through_the_wire(
    sensor: str, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    run_request: RunRequest = request.getfixturevalue(sensor)
    data = wide()
    data["collection"]["motion"][1] = {
        "phase": "press",
        "force": "1 N",
        "depth": "3 mm",
        "speed": "1 mm/s",
    }
    data["collection"]["factors"].pop("depth")
    live = request_in(tmp_path / "live", data, run_request.store.parent.parent / "rig.yaml")
    with stage_of(live.rig) as stage, at_work(live, stage) as (work, campaign):
        take_all(work)
        assert [failed["cause"] for failed in campaign.quarantined()] == []
        (recording,) = campaign.recordings()
    figures = recording.record.streams["force"].figures
    # a busy machine reads late, so that it presses a little further; the skin relaxes in the hold
    assert 0.7 < figures["normal_hold_n"] < 1.5
    assert 0.8 < figures["pressed_mm"] < 2.6
