"""Protocol files: reading, validation and expansion into plans."""

from sliplab.protocols.errors import InputError
from sliplab.protocols.model import Protocol
from sliplab.protocols.plan import Plan, PlannedTrial, Task, load_plan, make_plan
from sliplab.protocols.program import Dwell, Move, PlateStep, Position, Program, Step, Twist

__all__ = [
    "Dwell",
    "InputError",
    "Move",
    "Plan",
    "PlannedTrial",
    "PlateStep",
    "Position",
    "Program",
    "Protocol",
    "Step",
    "Task",
    "Twist",
    "load_plan",
    "make_plan",
]
