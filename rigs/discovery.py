"""Discovery: check that a rig's devices can be reached, without taking control of any."""

from __future__ import annotations

from importlib.util import find_spec

from sliplab.rigs.core.capabilities import RigError
from sliplab.rigs.devices.settings import DeviceSettings


def need_libraries(devices: DeviceSettings) -> None:
    """Check that the vendor libraries of these devices' drivers are installed; none is imported.

    Raises:
        ModuleNotFoundError: one of them is not installed.
    """
    for driver, _ in devices.drivers():
        for name in driver.libraries:
            if find_spec(name) is None:
                raise ModuleNotFoundError(f"No module named '{name}'", name=name)


def ping_devices(devices: DeviceSettings) -> dict[str, str | None]:
    """Return for each device None if it can be reached, else the reason and what to check.

    Each connection is closed as soon as the device has answered; takes some seconds.

    Raises:
        ModuleNotFoundError: a vendor library is not installed.
    """
    need_libraries(devices)
    found: dict[str, str | None] = {}
    for driver, settings in devices.drivers():
        try:
            found[driver.kind] = driver.ping(settings)
        except RigError as error:
            found[driver.kind] = str(error).removeprefix(f"{error.device}: ")
        except Exception as error:  # a vendor library may raise anything
            found[driver.kind] = str(error) or type(error).__name__
    if devices.sync_box is None:
        found["sync box"] = "the rig file names no port"
    return found
