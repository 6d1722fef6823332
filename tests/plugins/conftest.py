"""Plug-ins' flows run as those of the core do: with Prefect at home in a folder of the tests."""

import tests.flows.conftest  # noqa: F401
