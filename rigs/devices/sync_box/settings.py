"""Settings that reach a sync box, as a rig file gives them; cheap to import."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from sliplab.rigs.core.device_settings import DriverSettings
from sliplab.rigs.devices.sync_box.line import BAUD


class SyncBoxSettings(DriverSettings):
    """Settings that reach a sync box; the defaults fit the firmware that ships."""

    driver: Literal["sync_box"] = "sync_box"
    port: str = Field(min_length=1)
    """The serial port's name, best one that stays: /dev/serial/by-id/..."""
    baud: int = Field(default=BAUD, ge=9600, le=2_000_000)
    answer_s: float = Field(default=0.25, gt=0, le=10)
    """For each answer and for each write; a question is asked `TRIES` times."""
    boot_s: float = Field(default=4.0, gt=0, le=60)
    """From opening the port, which resets most boards, to the first answer."""
    silence_s: float = Field(default=1.0, gt=0, le=60)
    """A train of which nothing is heard for this much longer than its longest gap has failed."""
