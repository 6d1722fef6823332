"""Reviews of labels by people: the uncertainty of each label, and the effect of a review."""
