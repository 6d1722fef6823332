"""Example drivers, one folder a kind of device: what `sliplab new driver` starts from."""
