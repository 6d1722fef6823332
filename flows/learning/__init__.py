"""Samples, training and evaluation: networks made from labelled trials, and what they are worth."""
