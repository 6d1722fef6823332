"""Drivers of real devices, a folder each: settings, driver, and the fake that speaks its wire."""
