"""The crash-safe store of trials: writing, reading, checking, and what people decided of them."""
