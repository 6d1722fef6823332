"""Recording without a protocol and without an arm: named streams, trials, marks."""

from __future__ import annotations

from sliplab.protocols.plugin import Plugin

_HERE = "sliplab.plugins.record"
PLUGIN = Plugin(
    commands={"record": f"{_HERE}.command:app"},
    drivers={"columns": f"{_HERE}.columns:DRIVER", "lsl": f"{_HERE}.lsl:DRIVER"},
    hooks={"salvage": f"{_HERE}.salvage:salvage"},
)
