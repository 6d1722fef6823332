"""Settings of an ABB arm, as rig files give them, and the numbers of its driver.

Cheap to import.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from sliplab.rigs.core.address import BindAddress, Host
from sliplab.rigs.core.arm_settings import BaseArmSettings, Port

MONITOR_S = 0.2
"""Period at which the state is polled, in four requests, s."""
FAILURES = 2
"""Consecutive polls without an answer after which the connection is lost."""
FIRST_POSE_S = 3.0
"""Timeout from the start of a motion program to its first EGM pose, s."""
SILENCE_S = 0.5
"""Age at which the last pose is stale, s."""
STOPPED_S = 2.0
"""Timeout from an accepted stop to the arm at rest, s."""
STILL_S = 0.2
"""Time of unchanged poses after which the arm is at rest; longer than between segments, s."""
UNSEEN_STILL_S = 0.5
"""The same when only poses are available, because the web services do not answer, s."""
OVERTIME_S = 5.0
"""Time beyond 1.5 times its duration after which a path is stopped, s."""
AGREE_MM = 0.5
"""Largest difference between the positions of EGM and the web services, mm."""


class AbbSettings(BaseArmSettings):
    """An ABB arm on an IRC5 controller, driven by motion programs."""

    driver: Literal["abb"] = "abb"
    rws_port: Port = 80
    egm_port: Port = 6510
    """UDP port on this host to which the controller sends poses."""
    egm_bind: BindAddress = "0.0.0.0"
    egm_host: Host | None = None
    """Address that sends the poses, if it is not `host`; other packets are dropped."""
    username: str = "Default User"
    password: str = Field(default="robotics", repr=False)
    egm_point: Literal["tool", "flange"] = "tool"
    """Point whose pose the EGM stream reports; compared with the web services on connecting."""
    task: Annotated[str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_]*$")] = "T_ROB1"
    watchdog_s: Annotated[float, Field(ge=0.3, le=5)] | None = 1.0
    """Silence of this host after which the controller stops the arm, by the module
    `sliplab_watchdog.mod` (`docs/arms.md`), which is then required. null: no such module is loaded,
    and a path runs to its end when this host or the network fails."""
