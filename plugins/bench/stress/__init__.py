"""Detectors under nuisances: trials, figures and page."""
