"""Checks before anything moves: requests, plans, estimates, devices, file schemas."""
