"""Figures as SVG text, one module per subject."""
