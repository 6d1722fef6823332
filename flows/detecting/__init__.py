"""Live detection: what is asked for, and the sink that feeds the detector."""
