"""The open bench: its frozen scenes, drawn worlds, and the run over detectors."""
