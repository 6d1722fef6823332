"""Settings of the driver, as rig files give them; cheap to import."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from sliplab.rigs.core.arm_settings import BaseArmSettings, Port


class AbbSocketSettings(BaseArmSettings):
    """An ABB arm behind the small RAPID socket server that some labs run (option b)."""

    host_clock: ClassVar[bool] = True
    driver: Literal["abb_socket"] = "abb_socket"
    port: Port = 5000
    segment_s: Annotated[float, Field(gt=0, le=2)] = 0.25
    """Longest duration of one move request; a stop waits for it to end."""
