"""Conformance of drivers: rules for every kind of device, tried on a driver with its fake."""
