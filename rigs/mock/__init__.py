"""Simulated devices on one virtual clock: a complete rig without hardware."""

from __future__ import annotations

from sliplab.rigs.core.driver import RigDriver, lazy
from sliplab.rigs.mock.further_settings import (
    FurtherEventCamera,
    FurtherFrameCamera,
    Thermometer,
)
from sliplab.rigs.mock.settings import MockForceSensorSettings, MockSettings

DRIVER = RigDriver(
    name="mock",
    title="simulated devices",
    sections=("mock",),
    settings=MockSettings,
    build=lazy("sliplab.rigs.mock.rig:build_rig"),
    streams={
        "events": FurtherEventCamera,
        "frames": FurtherFrameCamera,
        "wrench": MockForceSensorSettings,
        "scalar": Thermometer,
    },
)
