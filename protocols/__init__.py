"""Protocol files: reading, validation and expansion into plans."""

from sliplab.protocols.errors import InputError
from sliplab.protocols.model import Protocol
from sliplab.protocols.plan import Plan, Task, Trial, load_plan, make_plan
from sliplab.protocols.program import Dwell, Move, PlateStep, Position, Program, Step, Twist

__all__ = [
    "Dwell",
    "InputError",
    "Move",
    "Plan",
    "PlateStep",
    "Position",
    "Program",
    "Protocol",
    "Step",
    "Task",
    "Trial",
    "Twist",
    "load_plan",
    "make_plan",
]
