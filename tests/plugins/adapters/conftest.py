"""The camera of the tests of file formats."""

from tests.storage.formats.conftest import small

__all__ = ["small"]
