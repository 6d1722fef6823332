"""SlipLab: run tactile slip experiments, from a protocol file to a report."""
