"""Prefect at home in a folder of the tests, before anything imports it."""

from tests.flows.conftest import rig_path

__all__ = ["rig_path"]
