"""Declaration of the driver; cheap to import."""

from __future__ import annotations

from typing import Any

from sliplab.plugins.ati_net_ft.settings import AtiNetFtSettings
from sliplab.rigs.core.driver import ForceSensorDriver, lazy
from sliplab.rigs.core.network import answers

_sensor = lazy("sliplab.plugins.ati_net_ft.driver:AtiNetFt")
_fake = lazy("sliplab.plugins.ati_net_ft.fake:FakeNetFt")


def _ping(settings: AtiNetFtSettings) -> str | None:
    if not settings.reads_page:
        return None  # UDP alone: whether it answers shows when it is connected
    return answers(settings.host, settings.web_port)


def _locks(settings: AtiNetFtSettings) -> dict[str, str]:
    host = settings.host.lower()
    return {f"force-{host}": f"the force sensor at {host}"}


def _reach(settings: AtiNetFtSettings, address: Any) -> AtiNetFtSettings:
    port, web_port = address
    return settings.model_copy(update={"port": port, "web_port": web_port})


DRIVER = ForceSensorDriver(
    name="ati_net_ft",
    title="ATI Net F/T",
    settings=AtiNetFtSettings,
    ping=_ping,
    address=lambda settings: settings.host,
    locks=_locks,
    build=lambda settings, arm: _sensor(settings),
    fake=lambda settings: _fake(settings.host, tick_hz=settings.tick_hz, fed=True),
    reach=_reach,
)
