"""A claim's state in words, for the terminal and for reports."""

from __future__ import annotations

from sliplab.plugins.claims.document import ClaimState
from sliplab.protocols.shown import plural


def verdict_text(state: ClaimState) -> str:
    """Return the verdict, and the shortfall of an open claim."""
    if state.holds or state.refuted:
        return "holds" if state.holds else "refuted"
    if state.blocks < state.least_blocks:
        return f"open: needs at least {state.least_blocks} blocks, and has {state.blocks}"
    if state.trend is not None:
        return f"open: {state.trend} only if the trend so far does not continue to the end"
    if state.alike is not None:
        missing = plural(state.missing, "missing trial")
        were = "was" if state.missing == 1 else "were"
        return f"open: {state.alike} if the {missing} {were} like the others"
    if _is_beyond(state):
        return "open: the interval is beyond the bound, but a call this early takes more blocks"
    return "open"


def _is_beyond(state: ClaimState) -> bool:
    """Return whether the whole interval is on one side of a bound."""
    if state.kind not in ("at_least", "at_most"):
        return False
    above = state.low is not None and state.low >= state.value
    return above or (state.high is not None and state.high <= state.value)


def count_text(state: ClaimState) -> str:
    """Return how many trials and blocks there are, of each kind."""
    taken = state.trials + state.undetected + state.missing
    parts = [f"{plural(taken, 'trial')} in {plural(state.blocks, 'block')}"]
    if state.undetected:
        parts.append(f"{state.undetected} undetected")
    if state.missing:
        parts.append(f"{state.missing} without a figure")
    if state.block_share:
        parts.append(f"{100.0 * state.block_share:.0f} % of the variance between blocks")
    return ", ".join(parts)
