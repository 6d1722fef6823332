"""An ABB arm behind a small RAPID socket server, which older laboratories run."""

from __future__ import annotations

from sliplab.protocols.plugin import Plugin

PLUGIN = Plugin(drivers={"abb_socket": "sliplab.plugins.abb_socket.device:DRIVER"})
