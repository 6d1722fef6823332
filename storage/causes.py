"""Causes of an error. Loads only Python's own modules, since `flows.running.process` reads it."""

from __future__ import annotations

from collections.abc import Iterator


def causes(error: BaseException | None, *, hidden: bool = False) -> Iterator[BaseException]:
    """Yield an error and those before it, each once: an error may be its own cause.

    Args:
        hidden: also those that ``raise ... from None`` hides.
    """
    seen: list[BaseException] = []
    while error is not None and not any(error is each for each in seen):
        seen.append(error)
        yield error
        shown = hidden or not error.__suppress_context__
        error = error.__cause__ or (error.__context__ if shown else None)
