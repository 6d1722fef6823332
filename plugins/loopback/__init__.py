"""The loopback rig: real drivers on fakes that speak the devices' protocols and share one scene.

It is for tests and rehearsals. The fakes reproduce the devices' replies and failures, not their
timing.
"""

from __future__ import annotations

from sliplab.protocols.plugin import Plugin

PLUGIN = Plugin(drivers={"loopback": "sliplab.plugins.loopback.device:DRIVER"})
