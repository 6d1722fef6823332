"""USB cameras of the video class (UVC), through OpenCV: what most optical tactile sensors have."""

from __future__ import annotations

from sliplab.protocols.plugin import Plugin

PLUGIN = Plugin(drivers={"uvc": "sliplab.plugins.uvc.device:DRIVER"})
