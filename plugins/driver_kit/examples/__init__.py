"""Example drivers, one folder a kind of device: the templates of `sliplab new driver`."""
