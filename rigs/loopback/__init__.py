"""The loopback rig: real drivers on fakes that speak the devices' protocols and share one scene.

It is for tests and rehearsals. The fakes reproduce the devices' replies and failures, not their
timing.
"""
