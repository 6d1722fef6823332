"""Displays for people: the review page, a trial in Rerun, live detection."""
