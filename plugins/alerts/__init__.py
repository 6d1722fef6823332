"""Alerts: messages about a campaign to people who are not beside it, by mail, chat or telephone."""

from __future__ import annotations

from sliplab.protocols.plugin import Plugin

PLUGIN = Plugin(commands={"alerts": "sliplab.plugins.alerts.command:app"})
