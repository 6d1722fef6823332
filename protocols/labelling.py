"""Settings of labels: the ground truth from the outside video."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from sliplab.protocols.yaml_file import StrictModel


class Labelling(StrictModel):
    """Ground truth from the outside video."""

    rule: Literal["paper", "change_point", "force", "given"] = "paper"
    """Onset rule that later steps use; all are kept (docs/labels.md). `force` needs a rig with a
    force sensor (docs/force.md); `given` takes the labels that came with an imported recording
    (docs/adapters.md)."""
    threshold_px: float = Field(default=2.0, gt=0, le=100)
    """A marker slips when its displacement exceeds this, pixels."""
    reference: Literal["hold_start", "hold_end"] = "hold_start"
    """From where the paper's rule counts displacements: from the start of the recorded hold, as in
    the paper, so that a slip in the hold counts; or from its end, just before the motion."""
    reference_ms: float = Field(default=200.0, gt=0, le=1e6)
    """The markers' reference positions are their means over this part of the hold; a frame's length
    takes the first frame (or the last)."""
    hold_slip_px: float | None = Field(default=1.0, gt=0, le=100)
    """A marker that moved further than this in the recorded hold leaves the trial's onsets in
    doubt, pixels; null: none does."""
