"""Rig files, device capabilities, drivers, and the simulated rig."""
