"""Drift along a campaign: its reference trials, each fitted by the scene."""
