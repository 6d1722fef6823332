"""Figures and pages: arrays and tables in, SVG and HTML text out."""
