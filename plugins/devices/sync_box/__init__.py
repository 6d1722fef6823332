"""The sync box on a serial port; its firmware is in `rigs/firmware`."""

from __future__ import annotations

import os

from sliplab.plugins.devices.sync_box.settings import SyncBoxSettings
from sliplab.rigs.core.driver import SyncBoxDriver, lazy
from sliplab.rigs.core.network import serial_port


def _locks(settings: SyncBoxSettings) -> dict[str, str]:
    port = os.path.realpath(settings.port)  # by-id links and plain names are one
    return {f"sync-{port}": f"the sync box at {port}"}


def _reach(settings: SyncBoxSettings | None, port: str) -> SyncBoxSettings:
    known = settings or SyncBoxSettings(port=port)
    return known.model_copy(update={"port": port})


DRIVER = SyncBoxDriver(
    name="sync_box",
    title="SlipLab sync box",
    settings=SyncBoxSettings,
    libraries=("serial",),
    ping=lambda settings: serial_port(settings.port),
    address=lambda settings: settings.port,
    locks=_locks,
    build=lazy("sliplab.plugins.devices.sync_box.driver:SerialSyncBox"),
    fake=lazy("sliplab.plugins.devices.sync_box.fake:FakeSyncBox"),
    reach=_reach,
)
