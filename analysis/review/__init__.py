"""Reviews of labels by people: the doubt of each label, and what a review would change."""
