"""Studies of a network: levels left out, other skins, speed against error."""

from __future__ import annotations

from sliplab.protocols.plugin import Plugin

_STUDIES = "sliplab.plugins.studies"
PLUGIN = Plugin(
    commands={"guesses": f"{_STUDIES}.command:app"},
    studies={
        "generalise": f"{_STUDIES}.generalise.study:STUDY",
        "tradeoff": f"{_STUDIES}.detector.study:STUDY",
    },
    sections={
        "skins": f"{_STUDIES}.generalise.section:SECTION",
        "tradeoff": f"{_STUDIES}.section:SECTION",
    },
    searches={name: f"{_STUDIES}.searches:{name}" for name in ("generalisation", "detector")},
)
