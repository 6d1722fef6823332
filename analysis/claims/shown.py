"""A claim's state in words, for the terminal and for reports."""

from __future__ import annotations

from sliplab.storage.schema.claims import ClaimState


def verdict_text(state: ClaimState) -> str:
    """Return the verdict, and what an open claim lacks."""
    if state.holds or state.refuted:
        return "holds" if state.holds else "refuted"
    if state.blocks < state.least_blocks:
        return f"open: needs at least {state.least_blocks} blocks, and has {state.blocks}"
    if state.alike is not None:
        missing = f"the {state.missing} missing trials"
        return f"open: {state.alike} if {missing} were like the others"
    return "open"


def count_text(state: ClaimState) -> str:
    """Return how many trials and blocks there are, of each kind."""
    taken = state.trials + state.undetected + state.missing
    parts = [f"{taken} trials in {state.blocks} blocks"]
    if state.undetected:
        parts.append(f"{state.undetected} undetected")
    if state.missing:
        parts.append(f"{state.missing} without a figure")
    if state.block_share:
        parts.append(f"{100.0 * state.block_share:.0f} % of the variance between blocks")
    return ", ".join(parts)
