"""Power analysis: the trials that a protocol's claims need, by campaigns drawn from a pilot."""
