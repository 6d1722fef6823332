"""Settings of the two ways to drive an ABB arm as a rig file gives them; cheap to import."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from sliplab.rigs.core.address import BindAddress, Host
from sliplab.rigs.core.arm_settings import BaseArmSettings, Port


class AbbSettings(BaseArmSettings):
    """An ABB arm on an IRC5 controller, by motion programs (option a, the default)."""

    driver: Literal["abb"] = "abb"
    rws_port: Port = 80
    egm_port: Port = 6510
    """UDP port on this host to which the controller sends its poses."""
    egm_bind: BindAddress = "0.0.0.0"
    egm_host: Host | None = None
    """Address that the poses come from, if it is not `host`; packets of any other are dropped."""
    username: str = "Default User"
    password: str = Field(default="robotics", repr=False)
    egm_point: Literal["tool", "flange"] = "tool"
    """Whose pose the controller's EGM stream tells; held against the web services on connecting."""
    task: Annotated[str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_]*$")] = "T_ROB1"
    watchdog_s: Annotated[float, Field(ge=0.3, le=5)] | None = 1.0
    """The controller stops the arm when this host has been silent for so long, by the module
    `sliplab_watchdog.mod` (`docs/arms.md`), without which it does not connect. null: it has no
    such module, and a path runs to its end when this host or the network is gone."""


class AbbSocketSettings(BaseArmSettings):
    """An ABB arm behind the small RAPID socket server that some labs run (option b)."""

    host_clock: ClassVar[bool] = True
    driver: Literal["abb_socket"] = "abb_socket"
    port: Port = 5000
    segment_s: Annotated[float, Field(gt=0, le=2)] = 0.25
    """Longest time one request may move for: a stop waits for it to end."""
