"""Drivers of real devices, one folder each: settings, driver, and a fake with its protocol."""
