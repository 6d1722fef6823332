"""Intervals over trials, paired differences, Pareto fronts, how far two scenes are apart."""
