"""The DVXplorer event camera, driven through dv-processing."""

from __future__ import annotations

from sliplab.plugins.devices.dvxplorer.settings import DvxplorerSettings, NetworkStream
from sliplab.rigs.core.driver import EventCameraDriver, lazy


def _ping(settings: DvxplorerSettings) -> str | None:
    from sliplab.plugins.devices.dvxplorer.source import check_header, find_camera

    source = settings.source
    if isinstance(source, NetworkStream):
        check_header(source.host, source.events_port)
        check_header(source.host, source.triggers_port)
    else:
        find_camera(source.serial)
    return None


def _reach(settings: DvxplorerSettings, address: tuple[int, int]) -> DvxplorerSettings:
    source = NetworkStream(events_port=address[0], triggers_port=address[1])
    return settings.model_copy(update={"source": source})


DRIVER = EventCameraDriver(
    name="dvxplorer",
    title="DVXplorer",
    settings=DvxplorerSettings,
    libraries=("dv_processing",),
    ping=_ping,
    build=lazy("sliplab.plugins.devices.dvxplorer.driver:DvxplorerCamera"),
    fake=lazy("sliplab.plugins.devices.dvxplorer.fake_stream:LiveDvxplorer"),
    reach=_reach,
)
