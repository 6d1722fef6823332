"""Teaching and calibrating a rig: measurements, their checks, and the entries in the rig file."""
