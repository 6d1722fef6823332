"""Fakes that speak the devices' own protocols, so that real drivers can be tried without them.

They are for tests and rehearsals. None of them copies what a device costs in time; what they copy
is what it says, and how it fails.
"""
