"""Slip detection: onsets from a trial's windows, comparison of detectors, and live detection."""
