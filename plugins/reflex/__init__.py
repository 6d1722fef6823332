"""Reflexes of a gripper: drops that they prevent, and the Robotiq 2F that closes."""

from __future__ import annotations

from sliplab.protocols.plugin import Plugin

_REFLEX = "sliplab.plugins.reflex"
PLUGIN = Plugin(
    commands={"reflex": f"{_REFLEX}.command:app"},
    documents={
        "reflex": (f"{_REFLEX}.document:ReflexStudy", "Drops that reflexes prevent, by SlipLab")
    },
    drivers={"robotiq_2f": f"{_REFLEX}.robotiq_2f:DRIVER"},
)
