"""Registry of drivers: those that ship with SlipLab, and those that other packages bring.

A package brings drivers by entry points of the group `sliplab.drivers`:

    [project.entry-points."sliplab.drivers"]
    my_arm = "my_package.my_arm:DRIVER"

Until a rig file names a driver only the metadata of installed packages is read. A package that
cannot be imported spoils no other one: it is named, with the reason, where its driver is asked for.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from sliplab.rigs.core.driver import Driver

GROUP = "sliplab.drivers"
BUILT_IN = {
    "ur": "sliplab.rigs.devices.ur:DRIVER",
    "abb": "sliplab.rigs.devices.abb:DRIVER",
    "abb_socket": "sliplab.rigs.devices.abb:SOCKET_DRIVER",
    "dvxplorer": "sliplab.rigs.devices.dvxplorer:DRIVER",
    "basler": "sliplab.rigs.devices.basler:DRIVER",
    "sync_box": "sliplab.rigs.devices.sync_box:DRIVER",
    "ati_net_ft": "sliplab.rigs.devices.ati_net_ft:DRIVER",
    "ur_wrench": "sliplab.rigs.devices.ur:WRENCH_DRIVER",
}


class DriverError(Exception):
    """A driver that is not installed, or a package whose driver cannot be used."""


@dataclass(frozen=True)
class Listed:
    """A driver by its metadata; nothing of it is imported."""

    name: str
    place: str
    """Module and attribute, such as ``my_package.my_arm:DRIVER``."""
    package: str
    """Distribution that brings it, and its version."""


@cache
def listed() -> dict[str, Listed]:
    """Return every installed driver by name, those that ship first."""
    found = {name: Listed(name, place, "sliplab") for name, place in BUILT_IN.items()}
    for point in sorted(entry_points(group=GROUP), key=lambda point: (point.name, _package(point))):
        if point.name not in found:  # the name of a driver that ships is not for others to take
            found[point.name] = Listed(point.name, point.value, _package(point))
    return found


def _package(point: EntryPoint) -> str:
    return "" if point.dist is None else f"{point.dist.name} {point.dist.version}"


def taken() -> list[str]:
    """Return a line for every entry point whose name another driver has already."""
    known = listed()
    return [
        f"{point.name} of {_package(point)} is not used: {known[point.name].package} has a driver "
        "of that name"
        for point in entry_points(group=GROUP)
        if known[point.name].place != point.value
    ]


def find_driver(name: str, kind: str) -> Driver[Any]:
    """Return a driver by name, importing the package that brings it.

    Raises:
        DriverError: no package brings it, it cannot be imported, or it is of another kind.
    """
    known = listed()
    if name not in known:
        raise DriverError(_unknown(name, kind))
    driver = load_driver(known[name])
    if driver.kind != kind:
        raise DriverError(f"is the driver of a kind of {driver.kind}, not of {kind}")
    return driver


def _unknown(name: str, kind: str) -> str:
    names, broken = [], []
    for item in listed().values():
        try:
            if load_driver(item).kind == kind:
                names.append(item.name)
        except DriverError as error:
            broken.append(str(error))
    close = difflib.get_close_matches(name, names, n=1)
    hint = f"; did you mean '{close[0]}'?" if close else ""
    return "; ".join([f"must be one of {', '.join(names)}{hint}", *broken])


@cache
def load_driver(item: Listed) -> Driver[Any]:
    """Import the driver that an entry point names.

    Raises:
        DriverError: its module raises an error, or holds no driver of that name there.
    """
    module, _, attribute = item.place.partition(":")
    try:
        driver = getattr(import_module(module), attribute)
    except Exception as error:  # a package of somebody else's may raise anything
        reason = f"{type(error).__name__}: {error}".splitlines()[0]
        raise DriverError(f"{item.name} of {item.package} cannot be imported: {reason}") from None
    if not isinstance(driver, Driver):
        text = f"{item.place} is a {type(driver).__name__}, not a Driver"
        raise DriverError(f"{item.name} of {item.package} cannot be used: {text}")
    if driver.name != item.name:
        text = f"it calls itself '{driver.name}'"
        raise DriverError(f"{item.name} of {item.package} cannot be used: {text}")
    return driver


def drivers(kind: str) -> Iterator[Driver[Any]]:
    """Every driver of a kind that can be imported, those that ship first."""
    for item in listed().values():
        try:
            driver = load_driver(item)
        except DriverError:
            continue
        if driver.kind == kind:
            yield driver
