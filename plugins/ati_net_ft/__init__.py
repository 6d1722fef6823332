"""ATI Net F/T force/torque sensors: Raw Data Transfer (RDT) over UDP, and their web page."""

from __future__ import annotations

from sliplab.protocols.plugin import Plugin

PLUGIN = Plugin(drivers={"ati_net_ft": "sliplab.plugins.ati_net_ft.device:DRIVER"})
