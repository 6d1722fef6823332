"""Live detection: what is requested, and the sink that feeds the detector."""
