"""What can go wrong with a stand-in's controller, asked for before or while it runs."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

CLOCK_BACK_S = 5.0
PACKETS_LOST = 25


class Kind(Enum):
    """What happens."""

    PROTECTIVE_STOP = "protective stop"
    EMERGENCY_STOP = "emergency stop"
    LINK_CUT = "link cut"
    """Every connection is closed and no new one is taken."""
    SILENCE = "silence"
    """Connections stay open and are taken, and nothing is ever answered or sent again."""
    REMOTE_OFF = "remote control off"
    PROGRAM_END = "program end"
    """Somebody presses stop at the pendant."""
    PROGRAM_PAUSED = "program paused"
    """Somebody presses pause at the pendant."""
    SAFEGUARD_STOP = "safeguard stop"
    """A light curtain or a door stops the arm; a program that runs is paused."""
    POWER_OFF = "power off"
    """Somebody switches the arm off, not its controller."""
    CLOCK_BACK = "clock back"
    """The controller's clock falls back by `CLOCK_BACK_S`."""
    PACKETS_LOST = "packets lost"
    """The next `PACKETS_LOST` packets of poses are not sent."""


class Stage(Enum):
    """When it happens."""

    CONNECTING = "connecting"
    """With the first request of any client."""
    CONTROL = "control"
    """When a client asks to write registers, which is how one takes control."""
    UPLOADING = "uploading"
    """With the first byte of a control script or motion program."""
    MOVING = "moving"
    """Once the tool centre point has travelled `after_mm` in one move."""
    IDLE = "idle"
    """At once, if ready and not moving."""


@dataclass(frozen=True)
class Fault:
    """One thing that goes wrong, once."""

    kind: Kind
    stage: Stage
    after_mm: float = 0.0
