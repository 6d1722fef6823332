"""Twins: a simulated rig's scene fitted to the slides of a pilot."""
