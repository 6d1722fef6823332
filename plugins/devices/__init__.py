"""Drivers of real devices, one folder each: settings, driver, and a fake with its protocol."""

from __future__ import annotations

from sliplab.protocols.plugin import Plugin

PLUGIN = Plugin(
    drivers={
        "ur": "sliplab.plugins.devices.ur:DRIVER",
        "ur_wrench": "sliplab.plugins.devices.ur:WRENCH_DRIVER",
        "abb": "sliplab.plugins.devices.abb:DRIVER",
        "dvxplorer": "sliplab.plugins.devices.dvxplorer:DRIVER",
        "basler": "sliplab.plugins.devices.basler:DRIVER",
        "sync_box": "sliplab.plugins.devices.sync_box:DRIVER",
    }
)
