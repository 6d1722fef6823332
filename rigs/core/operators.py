"""The person at a real rig: asked through a terminal, and who moves the plate on its slider."""

from __future__ import annotations

import re
import sys

from sliplab.protocols.program import PlateAction
from sliplab.protocols.shown import printable
from sliplab.rigs.core.capabilities import Operator, RigError


class ConsoleOperator:
    """Asks on the terminal and takes only the expected word for done."""

    def ask(self, task: str, prompt: str, expected: str) -> bool:
        """Ask for `prompt` to be done; the answer must be `expected`, or ``stop``.

        Raises:
            RigError: nobody can answer, because there is no terminal.
        """
        if not sys.stdin.isatty():
            raise RigError(
                "operator", f"'{prompt}' needs a person, and there is no terminal to ask on"
            )
        while True:
            print(
                printable(f"\n{task}: {prompt}\nType '{expected}' when it is done, or 'stop': "),
                end="",
                file=sys.stderr,
                flush=True,
            )
            answer = sys.stdin.readline()
            if not answer or answer.strip() == "stop":
                return False
            if answer.split() == expected.split():
                return True
            print(printable(f"That was '{answer.strip()}'."), file=sys.stderr)


_MASS = re.compile(r"\s*(\d+(?:\.\d+)?)\s*(kg|g)\s*")
_TASKS: dict[PlateAction, tuple[str, str]] = {
    "raise": ("raise the plate and hold it against its upper stop", "raised"),
    "release": ("let go of the plate, slowly, over {seconds:g} s", "released"),
    "catch": ("catch the plate and bring it to rest", "caught"),
}


def mass_of(expected: str) -> float:
    """The mass that a changeover names, such as ``0.205 kg``, in kg.

    Raises:
        RigError: it cannot be read.
    """
    match = _MASS.fullmatch(expected)
    if match is None or float(match[1]) <= 0.0:
        raise RigError("operator", f"cannot mount {expected!r}; expected such as 0.205 kg")
    return float(match[1]) * (0.001 if match[2] == "g" else 1.0)


class PersonAtPlate:
    """A `Plate` and an `Operator` in one: what a person confirms of the plate is what it is.

    Args:
        operator: who is asked.
        mass_kg: mounted at first, kg.
    """

    def __init__(self, operator: Operator, mass_kg: float) -> None:
        self._operator, self._mass_kg = operator, mass_kg

    def act(self, action: PlateAction, seconds: float) -> None:
        """Ask for it; returns when it is confirmed.

        Raises:
            RigError: it was not done.
        """
        prompt, word = _TASKS[action]
        if not self._operator.ask("plate", prompt.format(seconds=seconds), word):
            raise RigError("plate", f"'{prompt.format(seconds=seconds)}' was not confirmed")

    def mass_kg(self) -> float:
        """Mass mounted now, by a person's word."""
        return self._mass_kg

    def ask(self, task: str, prompt: str, expected: str) -> bool:
        """Ask for anything; a confirmed changeover mounts the mass that it names."""
        mass = mass_of(expected) if task == "changeover" else None
        done = self._operator.ask(task, prompt, expected)
        if done and mass is not None:
            self._mass_kg = mass
        return done
