"""Alerts: messages about a campaign to people who are not there, by mail, chat or telephone."""

from __future__ import annotations

from sliplab.protocols.plugin import Plugin

_ALERTS = "sliplab.plugins.alerts"
PLUGIN = Plugin(
    commands={"alerts": f"{_ALERTS}.command:app"},
    hooks={"check_alerts": f"{_ALERTS}.settings:load_alerts"},
)
