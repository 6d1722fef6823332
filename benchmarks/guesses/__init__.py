"""Figures of a study with each assumed parameter of the scene lowered and raised."""
