"""Networks on windows of events, from samples to a trained model and its files for others.

The spiking network and its kernels, simpler methods beside it, and what each is worth.
"""
