"""The detector through the real drivers, in real time: what it sees, and a reflex."""

from __future__ import annotations

from pathlib import Path

import pytest

from sliplab.flows.detect import detect
from sliplab.flows.detecting.request import make_detect_request
from sliplab.plugins.loopback.rig import loopback_rig
from sliplab.rigs.build import ShouldStop
from sliplab.rigs.core.capabilities import RigError
from sliplab.rigs.core.rig import Rig
from sliplab.rigs.rig_file import RigFile
from tests.flows.conftest import write
from tests.flows.detect.detecting import model_in, scripted, short_slide, slip_when_busy
from tests.flows.live import rig_yaml, stage_of

pytestmark = [pytest.mark.realtime, pytest.mark.xdist_group("scene")]

BEHIND_MS = 500.0
"""Largest acceptable latency of a decision on a busy machine."""


def test_slip_through_real_drivers_stops_the_arm(tmp_path: Path) -> None:
    order = make_detect_request(
        rig_yaml(tmp_path),
        model_in(tmp_path),
        protocol=write(tmp_path / "p.yaml", short_slide()),
        trial="",
        reflex="press:0.3",
        hold_s=0.3,
    )
    with stage_of(order.rig) as stage:

        def build(file: RigFile, should_stop: ShouldStop) -> Rig:
            return loopback_rig(file, stage, should_stop)

        result = detect(order, detector=scripted(order, slip_when_busy()), build=build)
        assert stage.arm_place()[2] < 0
    assert result["simulated"] is True
    assert result["virtual_time"] is False
    assert result["losses"]["late"] == result["losses"]["gaps"] == 0
    assert result["windows"] > 15
    reflex = result["reflex"]
    assert reflex
    assert reflex["done"]
    x, _, depth = reflex["stopped_mm"]
    assert -3.5 < x < 3.0
    assert depth == pytest.approx(2.4, abs=0.05)
    assert reflex["depth_mm"] == pytest.approx(2.7, abs=0.05)
    assert 0 < result["latency_ms"]["median"] < BEHIND_MS
    print(f"simulated: latency {result['latency_ms']}, compute {result['compute_ms']}, {reflex}")


@pytest.mark.long
def test_a_grip_through_real_drivers_tightens_the_fingers_of_the_scene(tmp_path: Path) -> None:
    file = write(
        tmp_path / "gripper.yaml",
        {
            "extends": str(rig_yaml(tmp_path)),
            "name": "loopback",
            "devices": {"gripper": {"driver": "robotiq_2f", "host": "127.0.0.1", "opening_mm": 40}},
            "mock": {"gripper": {"opening_mm": 40}},
        },
    )
    order = make_detect_request(
        file,
        model_in(tmp_path),
        protocol=write(tmp_path / "p.yaml", short_slide()),
        trial="",
        reflex="grip:1",
        hold_s=0.3,
    )
    with stage_of(order.rig) as stage:

        def build(file: RigFile, should_stop: ShouldStop) -> Rig:
            return loopback_rig(file, stage, should_stop)

        reflex = detect(order, detector=scripted(order, slip_when_busy()), build=build)["reflex"]
        assert stage.arm_place()[2] < 0
        assert reflex
        # three steps of 1/3 mm are 1 mm, and the driver rounds to the wider opening
        assert reflex["closed_mm"] == pytest.approx(1.0, abs=0.34)
        assert reflex["depth_mm"] == pytest.approx(2.4 + reflex["closed_mm"], abs=0.05)
        assert not reflex["stalled"]
        stage.inject("gripper", "device_silent")
        with pytest.raises(RigError, match="gripper: no answer"):
            detect(order, detector=scripted(order, slip_when_busy()), build=build)
        assert stage.at_rest()
    print(f"simulated: {reflex}")
