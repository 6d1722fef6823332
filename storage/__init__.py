"""What is kept: recordings, the crash-safe trial store, derived results."""
