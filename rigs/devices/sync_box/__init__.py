"""The sync box on a serial port; its firmware is in `rigs/firmware`."""

from __future__ import annotations

import os

from sliplab.rigs.core.driver import SyncBoxDriver, lazy
from sliplab.rigs.devices.sync_box.settings import SyncBoxSettings


def _ping(settings: SyncBoxSettings) -> str | None:
    if not os.path.exists(settings.port):
        return f"there is no {settings.port}; check its cable and /dev/serial/by-id"
    if not os.access(settings.port, os.R_OK | os.W_OK):
        return f"{settings.port} may not be opened; add yourself to its group (dialout)"
    return None


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
    ping=_ping,
    address=lambda settings: settings.port,
    locks=_locks,
    build=lazy("sliplab.rigs.devices.sync_box.driver:SerialSyncBox"),
    fake=lazy("sliplab.rigs.devices.sync_box.fake:FakeSyncBox"),
    reach=_reach,
)
