"""Prefect flows over the other packages, and the command line."""
