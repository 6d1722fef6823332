"""Simulated devices on one virtual clock: a complete rig without hardware, by physics."""

from __future__ import annotations

from sliplab.protocols.plugin import Plugin

PLUGIN = Plugin(drivers={"mock": "sliplab.plugins.simulation.device:DRIVER"})
