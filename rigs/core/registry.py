"""Registry of drivers: those shipped with SlipLab, those of plug-ins and of other packages.

A package with drivers only provides drivers by entry points of the group `sliplab.drivers`:

    [project.entry-points."sliplab.drivers"]
    my_arm = "my_package.my_arm:DRIVER"

Until a rig file names a driver, only the metadata of installed packages is read. A package that
cannot be imported does not affect others; the error is reported when its driver is requested.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from importlib.metadata import entry_points
from typing import TypeVar

from sliplab.protocols.plugin import Plugins, package_of, plugins, shipped
from sliplab.protocols.plugins import PluginError, import_foreign
from sliplab.protocols.shown import did_you_mean
from sliplab.rigs.core.driver import Declaration

DriverT = TypeVar("DriverT", bound=Declaration)
GROUP = "sliplab.drivers"
AT_HAND = {
    "devices": "sliplab.rigs.real:DRIVER",
    "mock": "sliplab.plugins.simulation.device:DRIVER",
}
"""Drivers of rigs that are found without reading the declarations of all plug-ins."""


class DriverError(Exception):
    """A driver that is not installed, or cannot be used."""


@dataclass(frozen=True)
class Listed:
    """A driver's metadata, without importing it."""

    name: str
    place: str
    """Module and attribute, such as ``my_package.my_arm:DRIVER``."""
    package: str
    """Distribution that provides it, and its version."""


@cache
def listed() -> dict[str, Listed]:
    """Return every installed driver by name, those that ship first."""
    found = {**_of(plugins()), **_shipped()}
    for point in sorted(
        entry_points(group=GROUP), key=lambda point: (point.name, package_of(point))
    ):
        if point.name not in found:  # another package cannot replace a shipped driver
            found[point.name] = Listed(point.name, point.value, package_of(point))
    return found


@cache
def _at_hand() -> dict[str, Listed]:
    return {name: Listed(name, place, "sliplab") for name, place in AT_HAND.items()}


@cache
def _shipped() -> dict[str, Listed]:
    return {**_at_hand(), **_of(shipped())}


def _of(known: Plugins) -> dict[str, Listed]:
    found: dict[str, Listed] = {}
    for subject, plugin in known.found.items():
        for name, place in plugin.drivers.items():
            found.setdefault(name, Listed(name, place, known.packages[subject]))
    return found


def taken() -> list[str]:
    """Return a message for every entry point whose name is already taken."""
    known = listed()
    return [
        f"{point.name} of {package_of(point)} is not used: {known[point.name].package} has a "
        "driver of that name"
        for point in entry_points(group=GROUP)
        if known[point.name].place != point.value
    ]


def find_driver(name: str, kind: type[DriverT]) -> DriverT:
    """Return a driver by name, importing the package that provides it.

    Raises:
        DriverError: no package provides it, it cannot be imported, or it is of another kind.
    """
    known = _at_hand().get(name) or _shipped().get(name) or listed().get(name)
    if known is None:
        raise DriverError(_unknown(name, kind))
    driver = load_driver(known)
    if not isinstance(driver, kind):
        raise DriverError(f"is the driver of a kind of {driver.kind}, not of {kind.kind}")
    return driver


def _unknown(name: str, kind: type[Declaration]) -> str:
    """Return the message about a driver of no installed package."""
    names, broken = [], []
    for item in listed().values():
        try:
            if isinstance(load_driver(item), kind):
                names.append(item.name)
        except DriverError as error:
            broken.append(str(error))
    text = (
        "is a driver of no installed package: install the package that has it (`sliplab rigs "
        f"--drivers` lists the installed ones), or choose one of {', '.join(sorted(names))}"
    )
    return "; ".join([text + did_you_mean(name, names), *broken])


@cache
def load_driver(item: Listed) -> Declaration:
    """Import the driver that an entry point names.

    Raises:
        DriverError: its module raises an error, or has no driver of that name.
    """
    try:
        driver = import_foreign(item.place)
    except PluginError as error:
        raise DriverError(f"{item.name} of {item.package} cannot be imported: {error}") from None
    if not isinstance(driver, Declaration):
        text = f"{item.place} is a {type(driver).__name__}, not a Driver"
        raise DriverError(f"{item.name} of {item.package} cannot be used: {text}")
    if driver.name != item.name:
        text = f"it calls itself '{driver.name}'"
        raise DriverError(f"{item.name} of {item.package} cannot be used: {text}")
    return driver


def drivers(kind: type[DriverT]) -> Iterator[DriverT]:
    """Iterate over the importable drivers of a kind, shipped ones first."""
    for item in listed().values():
        try:
            driver = load_driver(item)
        except DriverError:
            continue
        if isinstance(driver, kind):
            yield driver
