"""Stand-ins that speak the wire of the real controllers, so that real drivers can be tried.

They are for tests and for rehearsals without an arm. None of them copies what a controller costs
in time; what they copy is what it says, and how it fails.
"""
