"""Kit for authors of drivers: the rules that every driver must meet, and a package template."""

from __future__ import annotations

from sliplab.protocols.plugin import Plugin

PLUGIN = Plugin(commands={"new": "sliplab.plugins.driver_kit.command:app"})
