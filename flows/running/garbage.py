"""How often a program looks for garbage: seldom, because nearly all that it holds are its modules.

With Python's own thresholds it looks through everything that was imported again and again while
more is imported, which is a fifth of a start (of `sliplab collect` and of Prefect's server).
"""

from __future__ import annotations

import gc

THRESHOLDS = (50_000, 20, 100)
"""New objects before the youngest are looked through, and how often the older ones then are."""


def seldom() -> None:
    """Have this process look for garbage seldom from here on."""
    gc.set_threshold(*THRESHOLDS)
