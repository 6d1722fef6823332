"""Something that may fail at any call: a device on its cable, a file on its disk."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from typing import Any, TypeVar, cast

from sliplab.rigs.core.capabilities import ArmFault, RigError
from sliplab.rigs.mock.fault_settings import Device, DeviceGone, DiskFull
from sliplab.rigs.mock.world import World
from sliplab.storage.streams import Sink

T = TypeVar("T")


class Guarded:
    """Hands every call on to another object, unless a check made before it raises."""

    def __init__(self, target: Any, check: Callable[[], None]) -> None:
        self._target, self._check = target, check

    def __getattr__(self, name: str) -> Any:
        found = getattr(self._target, name)
        if not callable(found):
            return found

        def call(*arguments: Any, **named: Any) -> Any:
            self._check()
            return found(*arguments, **named)

        return call


def on_cable(device: T, name: Device, world: World) -> T:
    """`device`, whose calls fail while a fault keeps it away; itself when no fault ever does."""
    if not any(isinstance(f, DeviceGone) and f.device == name for f in world.settings.faults):
        return device

    def check() -> None:
        if world.faults.gone(name, world.now_ns):
            words = name.replace("_", " ")
            text = (
                "does not answer (simulated fault); check its power and its cable, "
                "then run the same command to go on"
            )
            raise ArmFault(words, text) if name == "arm" else RigError(words, text)

    return cast(T, Guarded(device, check))


def on_disk(sink: Sink, world: World) -> Sink:
    """`sink`, which cannot be written once a fault has filled the disk; itself without one."""
    full = world.faults.of(DiskFull)
    if not full:
        return sink

    def check() -> None:
        if any(begin <= world.now_ns for _, begin, _ in world.faults.spans(DiskFull)):
            raise OSError(errno.ENOSPC, f"{os.strerror(errno.ENOSPC)} (simulated fault)")

    return cast(Sink, Guarded(sink, check))
