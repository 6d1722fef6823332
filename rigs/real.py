"""The driver `devices` of a rig file: real devices, in real time."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

from sliplab.protocols.key_errors import KeyedError
from sliplab.rigs.core.driver import RigDriver, lazy
from sliplab.rigs.device_section import DeviceSettings
from sliplab.rigs.stream_settings import keyed_drivers

if TYPE_CHECKING:
    from sliplab.rigs.rig_file import RigFile

_PLACES = frozenset({"serial", "host", "port", "events_port", "triggers_port", "index", "path"})
"""Keys by which drivers distinguish their devices."""


def _faults(rig: RigFile) -> Iterator[KeyedError]:
    """Check that the sync box is named, and that no two devices of one driver are the same one.

    Two are if they have the same serial number, address or port, or both leave it out.
    """
    if rig.devices is not None and rig.devices.sync_box is None:
        yield KeyedError("devices.sync_box.port", None, "is needed: name its serial port")
    known: dict[tuple[str, str], str] = {}
    for key, driver, settings in keyed_drivers(rig.devices, rig.streams):
        place = _place(settings.model_dump(mode="json"))
        if not place:
            continue
        found = driver.name, json.dumps(place, sort_keys=True)
        if found in known and key.startswith("streams."):
            text = f"is the same device as {known[found]}: say which by {', '.join(place)}"
            raise KeyedError(key, driver.name, text)
        known[found] = key


def _place(settings: Mapping[str, Any], before: str = "") -> dict[str, Any]:
    """Return the settings that distinguish devices of one driver, by key."""
    found: dict[str, Any] = {}
    for key, value in settings.items():
        if isinstance(value, dict):
            found |= _place(value, f"{before}{key}.")
        elif key in _PLACES:
            found[f"{before}{key}"] = value
    return found


DRIVER = RigDriver(
    name="devices",
    title="real devices",
    sections=("devices",),
    settings=DeviceSettings,
    build=lazy("sliplab.rigs.build:build_real"),
    faults=_faults,
)
