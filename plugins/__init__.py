"""Optional features, one self-contained folder each."""
