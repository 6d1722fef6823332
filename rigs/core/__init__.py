"""Device-independent parts of a rig: capabilities, the rig itself, its safety and calibration."""
