"""ATI Net F/T force/torque sensors: Raw Data Transfer (RDT) over UDP, and their web page."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from sliplab.rigs.core.driver import FakeForceSensor, ForceSensorDriver
from sliplab.rigs.core.network import answers
from sliplab.rigs.devices.ati_net_ft.settings import AtiNetFtSettings

if TYPE_CHECKING:
    from sliplab.rigs.core.capabilities import Arm, ForceSensor


def _build(settings: AtiNetFtSettings, arm: Arm) -> ForceSensor:
    from sliplab.rigs.devices.ati_net_ft.driver import AtiNetFt

    return AtiNetFt(settings)


def _ping(settings: AtiNetFtSettings) -> str | None:
    if not settings.reads_page:
        return None  # UDP alone: whether it answers shows when it is connected
    return answers(settings.host, settings.web_port)


def _locks(settings: AtiNetFtSettings) -> dict[str, str]:
    host = settings.host.lower()
    return {f"force-{host}": f"the force sensor at {host}"}


def _fake(settings: AtiNetFtSettings) -> FakeForceSensor:
    from sliplab.rigs.devices.ati_net_ft.fake import FakeNetFt

    return FakeNetFt(settings.host, tick_hz=settings.tick_hz, fed=True)


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
    build=_build,
    fake=_fake,
    reach=_reach,
)
