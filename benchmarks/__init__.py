"""Benchmarks of this project's parts, measured beside the alternatives they replace.

`python -m benchmarks NAME` runs one, `python -m benchmarks` runs all and writes RESULTS.md.
"""
