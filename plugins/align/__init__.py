"""Two clocks aligned by events that both saw: no rig, no store."""

from __future__ import annotations

from sliplab.protocols.plugin import Plugin

PLUGIN = Plugin(
    commands={"align": "sliplab.plugins.align.command:app"},
    hooks={"align": "sliplab.plugins.align.align:align"},
)
