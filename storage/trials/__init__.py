"""The crash-safe store of trials: writing, reading, verification, requests and reviews."""
