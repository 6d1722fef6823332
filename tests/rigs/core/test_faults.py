"""The table of faults, against the devices and the fakes that have them."""

from __future__ import annotations

from typing import get_args

import pytest

from sliplab.plugins.ati_net_ft.fake import FakeNetFt, SensorFaultKind
from sliplab.rigs.core import driver, faults
from sliplab.rigs.core.fakes import FakeController, Kind

FAKES = {
    "arm": FakeController,
    "event_camera": driver.FakeEventCamera,
    "sync_box": driver.FakeBox,
    "force_sensor": driver.FakeForceSensor,
    "gripper": driver.FakeGripper,
    "ati_net_ft": FakeNetFt,
}


@pytest.mark.parametrize("device", FAKES)
def test_a_fake_has_the_methods_of_its_faults(device: str) -> None:
    found = faults.wired(device)
    assert found
    for method in found.values():
        assert callable(getattr(FAKES[device], method))


def test_a_fake_that_is_told_the_kind_knows_those_of_the_table() -> None:
    for device, kinds in (("arm", Kind), ("ati_net_ft", SensorFaultKind)):
        assert {kind.value for kind in kinds} == set(faults.wired(device))


def test_every_kind_has_one_name_and_a_meaning() -> None:
    models = get_args(faults.AnyFault)
    assert len(set(faults.KINDS)) == len(models)
    assert not {*faults.KINDS} & {*faults._IN_FAKES}
    assert all(it.__doc__ for it in models)
    wired = [*(it.wired for it in models), *faults._IN_FAKES.values()]
    assert {device for methods in wired for device in methods} == set(FAKES)
