"""Formats of recordings by other programs, cameras and robots, and of the lab's old scripts."""

from __future__ import annotations

from sliplab.protocols.plugin import Plugin

_HERE = "sliplab.plugins.formats"
PLUGIN = Plugin(
    formats={
        "raw": f"{_HERE}.prophesee:RAW",
        "es": f"{_HERE}.event_stream:ES",
        "mcap": f"{_HERE}.ros.mcap:MCAP",
        "rosbag": f"{_HERE}.ros.bags:ROSBAG",
        "lab-pickles": f"{_HERE}.lab.layout:PICKLES",
        "lerobot": f"{_HERE}.lerobot:LEROBOT",
    },
    hooks={"layout": f"{_HERE}.lab.layout:LAYOUT"},
)
