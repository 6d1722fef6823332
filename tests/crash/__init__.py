"""Crashes on purpose: `python -m tests.crash` kills a campaign again and again."""
