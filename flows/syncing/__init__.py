"""Clocks of stored trials fitted again, and the page that shows what they are worth."""
