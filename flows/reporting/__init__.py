"""The report: its sections, its numbers, and two reports compared."""
