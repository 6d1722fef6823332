"""Drivers of the real cameras: Basler through pylon, DVXplorer through dv-processing.

Neither library is loaded before a camera is opened, so that a simulated rig needs none of them.
"""
