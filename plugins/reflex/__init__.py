"""Reflexes of a gripper: drops that they prevent, and the Robotiq 2F that closes."""

from __future__ import annotations

from sliplab.protocols.plugin import Plugin

_REFLEX = "sliplab.plugins.reflex"
PLUGIN = Plugin(
    studies={"reflex": f"{_REFLEX}.study:STUDY"},
    drivers={"robotiq_2f": f"{_REFLEX}.robotiq_2f:DRIVER"},
)
