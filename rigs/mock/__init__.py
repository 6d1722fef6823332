"""Simulated devices on one virtual clock: a complete rig without hardware."""
