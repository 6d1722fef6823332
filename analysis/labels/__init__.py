"""Ground truth: from a trial's video to tracks, slips and onsets, with the doubts about them."""
