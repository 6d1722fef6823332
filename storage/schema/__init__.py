"""Models of the documents in a store, one module per document."""
