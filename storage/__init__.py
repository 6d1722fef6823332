"""Stored data: typed documents, recordings, the crash-safe trial store, formats, remote storage."""
