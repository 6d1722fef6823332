"""Intervals over trials, paired differences, Pareto fronts, accuracy of groups of windows."""
