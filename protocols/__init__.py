"""What is to be done: protocol files, read, checked and expanded into plans."""

from protocols.errors import InputError
from protocols.model import Protocol
from protocols.plan import Plan, Task, Trial, load_plan, make_plan
from protocols.program import Dwell, Move, PlateStep, Position, Program, Step

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
    "load_plan",
    "make_plan",
]
