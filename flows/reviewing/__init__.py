"""Trials as a person looks at them: the review page in a browser, and one trial in Rerun."""
