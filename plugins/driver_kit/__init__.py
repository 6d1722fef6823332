"""What a driver's author needs: the rules that every driver keeps, and a package to start from."""

from __future__ import annotations

from sliplab.protocols.plugin import Plugin

PLUGIN = Plugin(commands={"new": "sliplab.plugins.driver_kit.command:app"})
