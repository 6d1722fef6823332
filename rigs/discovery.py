"""Discovery: can a rig's devices be reached? None of them is taken control of."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable
from importlib.util import find_spec

from sliplab.rigs.core.capabilities import RigError
from sliplab.rigs.devices.abb.settings import AbbSettings
from sliplab.rigs.devices.basler.settings import BaslerSettings
from sliplab.rigs.devices.dvxplorer.settings import DvxplorerSettings, NetworkStream
from sliplab.rigs.devices.settings import ArmSettings, DeviceSettings
from sliplab.rigs.devices.sync_box.settings import SyncBoxSettings
from sliplab.rigs.devices.ur.settings import UrSettings

ANSWER_S = 1.0
"""For each connection, s."""
_UR_PORT = 30004
_ARM_LIBRARIES: dict[str, tuple[str, ...]] = {
    "ur": ("rtde_control",),
    "abb": ("abb_motion_program_exec", "abb_robot_client"),
}


def need_libraries(devices: DeviceSettings) -> None:
    """Look for the makers' libraries that the drivers of these devices use; none is loaded.

    Raises:
        ModuleNotFoundError: one is not installed.
    """
    for name in (*_ARM_LIBRARIES.get(devices.arm.driver, ()), "dv_processing", "pypylon", "serial"):
        if find_spec(name) is None:
            raise ModuleNotFoundError(f"No module named '{name}'", name=name)


def ping_devices(devices: DeviceSettings) -> dict[str, str | None]:
    """By device: None if it can be reached, else why not, and what to look at.

    Nothing is opened for longer than it takes to see that somebody answers; takes some seconds.

    Raises:
        ModuleNotFoundError: a maker's library is not installed.
    """
    need_libraries(devices)
    box = devices.sync_box
    looks: dict[str, Callable[[], str | None]] = {
        "arm": lambda: _arm(devices.arm),
        "event camera": lambda: _event_camera(devices.event_camera),
        "frame camera": lambda: _frame_camera(devices.frame_camera),
        "sync box": lambda: _sync_box(box) if box is not None else "no port is named",
    }
    found = {}
    for name, look in looks.items():
        try:
            found[name] = look()
        except RigError as error:
            found[name] = str(error).removeprefix(f"{error.device}: ")
        except Exception as error:  # a maker's library may raise anything
            found[name] = str(error) or type(error).__name__
    return found


def _arm(settings: ArmSettings) -> str | None:
    if isinstance(settings, UrSettings):
        port = _UR_PORT
    else:
        port = settings.rws_port if isinstance(settings, AbbSettings) else settings.port
    return _listens(settings.host, port)


def _listens(host: str, port: int) -> str | None:
    try:
        with socket.create_connection((host, port), ANSWER_S):
            return None
    except OSError as error:
        return f"{host}:{port}: {error}; look at its power, its cable and the address"


def _event_camera(settings: DvxplorerSettings) -> str | None:
    from sliplab.rigs.devices.dvxplorer.source import find_camera, greet

    source = settings.source
    if isinstance(source, NetworkStream):
        greet(source.host, source.events_port)
        greet(source.host, source.triggers_port)
    else:
        find_camera(source.serial)
    return None


def _frame_camera(settings: BaslerSettings) -> str | None:
    from sliplab.rigs.devices.basler.driver import look_for_camera

    look_for_camera(settings.serial)
    return None


def _sync_box(settings: SyncBoxSettings) -> str | None:
    if not os.path.exists(settings.port):
        return f"there is no {settings.port}; look at its cable, and at /dev/serial/by-id"
    if not os.access(settings.port, os.R_OK | os.W_OK):
        return f"{settings.port} may not be opened; add yourself to its group (dialout)"
    return None
