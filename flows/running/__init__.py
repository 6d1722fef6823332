"""Basis of every flow: the terminal, stop requests, Prefect, and processes.

Work is distributed over cores or a cluster here, too.
"""
