"""One trial in the viewer Rerun."""

from __future__ import annotations

from sliplab.protocols.plugin import Plugin

PLUGIN = Plugin(commands={"view": "sliplab.plugins.view.command:app"})
