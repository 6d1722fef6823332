"""Windows of events: binning, storage and selection."""
