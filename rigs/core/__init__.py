"""The parts of a rig that know no device: capabilities, the rig, its safety and calibration."""
