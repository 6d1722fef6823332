"""The operator of a real rig: prompts on a terminal, and the plate that is moved by hand."""

from __future__ import annotations

import re
import select
import sys
import threading

from sliplab.protocols.program import PlateAction
from sliplab.protocols.shown import printable
from sliplab.rigs.core.capabilities import Operator, RigError

_LOOK_S = 0.1
"""Time between two looks for an answer, s."""


class ConsoleOperator:
    """Prompts on the terminal; only the expected word confirms a task.

    A question ends when another is asked: the rig asks in a thread while it watches the arm, and
    after a fault it no longer wants the answer.
    """

    def __init__(self) -> None:
        self._questions, self._reading = 0, threading.Lock()

    def ask(self, task: str, prompt: str, expected: str) -> bool:
        """Ask the operator to do `prompt`; the answer must be `expected`, or ``stop``.

        Raises:
            RigError: there is no terminal to answer on.
        """
        if not sys.stdin.isatty():
            raise RigError(
                "operator", f"'{prompt}' needs an operator, but there is no terminal to ask on"
            )
        self._questions += 1
        number = self._questions
        while True:
            print(
                printable(f"\n{task}: {prompt}\nType '{expected}' when it is done, or 'stop': "),
                end="",
                file=sys.stderr,
                flush=True,
            )
            answer = self._answer(number)
            if not answer or answer.strip() == "stop":
                return False
            if answer.split() == expected.split():
                return True
            print(printable(f"That was '{answer.strip()}'."), file=sys.stderr)

    def _answer(self, number: int) -> str:
        """Return the next line; empty once another question was asked, or the input has ended."""
        while True:
            with self._reading:
                if number != self._questions:
                    return ""
                if _has_line():
                    return sys.stdin.readline()


def _has_line() -> bool:
    """Return whether the terminal has a line, after a short wait."""
    try:
        return bool(select.select([sys.stdin], [], [], _LOOK_S)[0])
    except (OSError, ValueError, TypeError):  # no terminal that can be asked: reading waits
        return True


_MASS = re.compile(r"\s*(\d+(?:\.\d+)?)\s*(kg|g)\s*")
_TASKS: dict[PlateAction, tuple[str, str]] = {
    "raise": ("raise the plate and hold it against its upper stop", "raised"),
    "release": ("let go of the plate slowly, over {seconds:g} s", "released"),
    "catch": ("catch the plate and bring it to rest", "caught"),
}


def mass_of(expected: str) -> float:
    """Parse the mass that a changeover names, such as ``0.205 kg``, in kg.

    Raises:
        RigError: it cannot be read.
    """
    match = _MASS.fullmatch(expected)
    if match is None or float(match[1]) <= 0.0:
        raise RigError("operator", f"cannot mount {expected!r}; expected a mass such as 0.205 kg")
    return float(match[1]) * (0.001 if match[2] == "g" else 1.0)


class PersonAtPlate:
    """A `Plate` moved by the operator, and an `Operator` that keeps its mass up to date.

    Args:
        operator: the operator to prompt.
        mass_kg: mass mounted at first, kg.
    """

    def __init__(self, operator: Operator, mass_kg: float) -> None:
        self._operator, self._mass_kg = operator, mass_kg

    def act(self, action: PlateAction, seconds: float) -> None:
        """Ask the operator to do it; returns once it is confirmed.

        Raises:
            RigError: it was not confirmed.
        """
        prompt, word = _TASKS[action]
        if not self._operator.ask("plate", prompt.format(seconds=seconds), word):
            raise RigError("plate", f"'{prompt.format(seconds=seconds)}' was not confirmed")

    def mass_kg(self) -> float:
        """Mass mounted now, as confirmed by the operator."""
        return self._mass_kg

    def ask(self, task: str, prompt: str, expected: str) -> bool:
        """Ask for a task; a confirmed changeover sets the mounted mass."""
        mass = mass_of(expected) if task == "changeover" else None
        done = self._operator.ask(task, prompt, expected)
        if done and mass is not None:
            self._mass_kg = mass
        return done
