"""Networks on windows of events, from samples to a trained model and its files for others.

The spiking network and its kernels, and simpler methods to compare it with.
"""
