"""Stores on shared and object storage: push, pull, and mirrors opened by their URL."""
