"""Foreign file formats: untrusted import, and export for other programs."""
