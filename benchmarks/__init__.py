"""What the parts of this project cost, measured beside the ways they replace.

`python -m benchmarks NAME` runs one, `python -m benchmarks` runs all and writes RESULTS.md.
"""
