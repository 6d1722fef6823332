"""Settings of a Universal Robots arm, as rig files give them, and the numbers of its driver.

Cheap to import.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from sliplab.rigs.core.arm_settings import BaseArmSettings, Positive
from sliplab.rigs.core.device_settings import DriverSettings

RTDE_PORT, DASHBOARD_PORT, SCRIPT_PORT = 30004, 29999, 30003
ANSWER_S = 3.0
"""Timeout to connect the pose stream, including its set-up, s."""
SILENCE_S = 1.0
"""Silence after which the pose stream counts as lost, s."""
COMMAND_S = 2.0
"""Timeout of one call of the control client; the controller needs a few cycles, s."""
PORT_S = 1.0
"""Timeout of one request on a text port, s."""
BEGIN_S = 1.0
"""Timeout from an accepted move to the report that it is running, s."""
OVERTIME_S = 3.0
"""Time beyond 1.5 times its duration after which a move is stopped, s."""
STILL_S = 1.0
"""Timeout from a stop command to the arm at rest, for each channel, s."""
STOP_DECELERATION_MM_S2 = 1000.0
"""Deceleration of a stop."""
REACTION_S = 0.002
"""Time from a stop to the start of braking: one cycle of the controller, s."""
ARRIVED_MM = 0.1
"""A move that ends farther than this from its target was stopped from outside."""
STILL_MM_S = 0.01
"""Commanded speed below which the arm is at rest."""
JUMP_S = 1.0
"""Step of the controller's clock between two packets above which it has jumped, s."""
NEWS_S = 0.1
"""Timeout for a packet with the new state to arrive, s."""
TURN_DEG_S2 = 50.0
"""Acceleration of a turn on the spot."""
TURN_SHARE, TURN_LATE_S = 0.1, 0.1
"""Deviation of the time that a turn takes: share of it, and s."""
FULL_SPEED = 0.999
"""Position from which the speed slider counts as fully up."""
WATCHDOG_HZ = 1.0
"""Rate of writes below which the controller's watchdog ends the program, and with it any move.

A host that records cameras may delay a process by half a second. A move that continues for another
second goes no farther than its target, which was checked against all limits.
"""


class UrSettings(BaseArmSettings):
    """A Universal Robots e-Series arm, PolyScope 5.6 to 5.x, in remote control.

    Its ports are fixed: 30004 RTDE, 29999 dashboard, 30003 scripts. Segments are not blended: the
    arm comes to rest between two of them, so each has constant speed between its ramps.
    """

    driver: Literal["ur"] = "ur"
    acceleration_mm_s2: Positive = 100.0
    """Acceleration at the start and the end of each segment."""
    frequency_hz: Annotated[int, Field(ge=10, le=500)] = 500
    """Rate of the pose stream; 500 is the controller's native rate."""
    sync_input: Annotated[int, Field(ge=0, le=17)] = 0
    """Bit of `actual_digital_input_bits` with the sync line (0 to 7: standard inputs)."""


class UrWrenchSettings(DriverSettings):
    """The wrench at the tool that a Universal Robots e-Series controller measures."""

    driver: Literal["ur_wrench"] = "ur_wrench"
    bias: Literal["trial", "session", "never"] = "trial"
    """When the present load becomes zero: before every trial while the sensor is clear of the
    plate, once when it is connected, or never."""
