"""Publications: data sets that others cite and load, with a data card and checksums."""

from __future__ import annotations

from sliplab.protocols.plugin import Plugin

_HERE = "sliplab.plugins.publish"
PLUGIN = Plugin(
    commands={"publish": f"{_HERE}.command:app"},
    exports=dict.fromkeys(("croissant", "archive", "mcap", "lerobot"), f"{_HERE}.command:EXPORT"),
    formats={"croissant": f"{_HERE}.imported:CROISSANT"},
    hooks={"layout": f"{_HERE}.imported:LAYOUT"},
)
