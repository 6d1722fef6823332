"""Fixtures for the tests of formats."""

from tests.storage.formats.conftest import small as small
