"""Detectors that ship with the bench."""
