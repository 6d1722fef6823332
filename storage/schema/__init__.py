"""The documents that a store holds, as models: one file each."""
