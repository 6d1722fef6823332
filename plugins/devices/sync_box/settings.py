"""Settings of a sync box, as rig files give them; cheap to import."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from sliplab.plugins.devices.sync_box.line import BAUD
from sliplab.rigs.core.device_settings import DriverSettings


class SyncBoxSettings(DriverSettings):
    """Settings of a sync box; the defaults match the shipped firmware."""

    driver: Literal["sync_box"] = "sync_box"
    port: str = Field(min_length=1)
    """Name of the serial port, preferably a persistent one: /dev/serial/by-id/..."""
    baud: int = Field(default=BAUD, ge=9600, le=2_000_000)
    answer_s: float = Field(default=0.25, gt=0, le=10)
    """Timeout of each answer and each write; a request is sent up to `TRIES` times."""
    boot_s: float = Field(default=4.0, gt=0, le=60)
    """Timeout from opening the port, which resets most boards, to the first answer."""
    silence_s: float = Field(default=1.0, gt=0, le=60)
    """Silence beyond a train's longest gap after which the train has failed."""
