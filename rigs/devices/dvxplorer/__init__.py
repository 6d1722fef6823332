"""The DVXplorer event camera through dv-processing."""
