"""Fitting a simulated rig to a pilot: what its trials say of the scene's parameters."""
