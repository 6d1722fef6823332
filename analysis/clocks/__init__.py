"""Clocks: counters and coded pulses become one time line a trial, with bounds on its error."""
