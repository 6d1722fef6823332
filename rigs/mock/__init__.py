"""Simulated devices on one virtual clock: a whole rig without hardware, as fast as it computes."""
