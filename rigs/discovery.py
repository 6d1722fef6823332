"""Discovery: can a rig's devices be reached? None of them is taken control of."""

from __future__ import annotations

from importlib.util import find_spec

from sliplab.rigs.core.capabilities import RigError
from sliplab.rigs.devices.settings import DeviceSettings


def need_libraries(devices: DeviceSettings) -> None:
    """Look for the makers' libraries that the drivers of these devices use; none is loaded.

    Raises:
        ModuleNotFoundError: one is not installed.
    """
    for driver, _ in devices.drivers():
        for name in driver.libraries:
            if find_spec(name) is None:
                raise ModuleNotFoundError(f"No module named '{name}'", name=name)


def ping_devices(devices: DeviceSettings) -> dict[str, str | None]:
    """By device: None if it can be reached, else why not, and what to look at.

    Nothing is opened for longer than it takes to see that somebody answers; takes some seconds.

    Raises:
        ModuleNotFoundError: a maker's library is not installed.
    """
    need_libraries(devices)
    found: dict[str, str | None] = {}
    for driver, settings in devices.drivers():
        try:
            found[driver.kind] = driver.ping(settings)
        except RigError as error:
            found[driver.kind] = str(error).removeprefix(f"{error.device}: ")
        except Exception as error:  # a maker's library may raise anything
            found[driver.kind] = str(error) or type(error).__name__
    if devices.sync_box is None:
        found["sync box"] = "no port is named"
    return found
