"""Pages of a store and a rig's service: live view, controls, trials, label review, schedules."""

from __future__ import annotations

from sliplab.protocols.plugin import Plugin

_WEB = "sliplab.plugins.web"
PLUGIN = Plugin(
    commands={
        "page": f"{_WEB}.page_command:app",
        "review": f"{_WEB}.review_command:app",
        "serve": f"{_WEB}.serve_command:app",
    },
)
