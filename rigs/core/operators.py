"""The person at the rig, asked through a terminal."""

from __future__ import annotations

import sys

from sliplab.protocols.shown import printable
from sliplab.rigs.core.capabilities import RigError


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
