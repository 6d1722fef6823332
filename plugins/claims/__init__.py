"""Claims about a campaign: their evidence so far, and the most informative next trial."""

from __future__ import annotations

from sliplab.protocols.plugin import Plugin

_CLAIMS = "sliplab.plugins.claims"
PLUGIN = Plugin(
    studies={"power": f"{_CLAIMS}.power.study:STUDY"},
    sections={"claims": f"{_CLAIMS}.section:SECTION"},
    hooks={
        "more_trials": f"{_CLAIMS}.rounds:ClaimWatch",
        "begun_trials": f"{_CLAIMS}.document:begun_trials",
        "forecast": f"{_CLAIMS}.power.study:forecast",
    },
)
