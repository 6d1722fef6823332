"""Evaluation: networks, detectors and other methods on trials that none of them has seen."""
