"""One path that an arm was asked to follow, shared by who follows it and who asks how far it is."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass, field

from sliplab.rigs.core.capabilities import ArmFault, ArmState, Progress, Segment


@dataclass
class Run:
    """A path that was started; before the first one there is an empty one that is done."""

    path: Sequence[Segment]
    finished: list[tuple[int, int]] = field(default_factory=list)
    """Start and end of finished segments, controller clock in ns."""
    done: bool = False
    cancelled: bool = False
    """Somebody asked for a stop."""
    error: ArmFault | None = None
    """Why the path was given up, where the arm's state does not tell."""
    thread: threading.Thread | None = None

    def progress(self, state: ArmState) -> Progress:
        """How far it has come.

        Raises:
            ArmFault: it was given up for a reason that `state` does not say: the arm is healthy, or
                its program was ended because of that reason.
        """
        if self.error is not None and (state.healthy or state is ArmState.NOT_RUNNING):
            raise self.error
        return Progress(state, tuple(self.finished), self.done)
