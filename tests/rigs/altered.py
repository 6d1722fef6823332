"""Methods of devices that a test changes or listens to."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any


def alter(device: Any, name: str, change: Callable[[Any], Any]) -> None:
    """Hand what a method returns through `change`."""
    method = getattr(device, name)
    setattr(device, name, lambda *args: change(method(*args)))


def before(device: Any, name: str, act: Callable[..., Any]) -> None:
    """Let `act` see each call's arguments before the method has its turn."""
    method = getattr(device, name)
    setattr(device, name, lambda *args: (act(*args), method(*args))[1])


def depths(rig: Any) -> list[float]:
    """Keep every depth that the rig reads."""
    found = [-99.0]

    def noted(here: Any) -> Any:
        found.append(rig.plate_frame.position(here.xyz_mm).depth_mm)
        return here

    alter(rig.arm, "pose", noted)
    return found
