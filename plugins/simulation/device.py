"""Declaration of the driver `mock`; cheap to import."""

from __future__ import annotations

from sliplab.plugins.simulation.further_settings import (
    FurtherEventCamera,
    FurtherFrameCamera,
    Thermometer,
)
from sliplab.plugins.simulation.settings import MockForceSensorSettings, MockSettings
from sliplab.rigs.core.driver import RigDriver, lazy

DRIVER = RigDriver(
    name="mock",
    title="simulated devices",
    sections=("mock",),
    settings=MockSettings,
    build=lazy("sliplab.plugins.simulation.rig:build_rig"),
    levels=lazy("sliplab.plugins.simulation.levels:physics_levels"),
    streams={
        "events": FurtherEventCamera,
        "frames": FurtherFrameCamera,
        "wrench": MockForceSensorSettings,
        "scalar": Thermometer,
    },
)
