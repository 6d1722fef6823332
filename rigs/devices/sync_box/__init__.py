"""The sync box at its serial port; its firmware stands in `rigs/firmware`."""
