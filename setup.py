"""Packages of the project; everything else is in pyproject.toml.

The five packages are at the root of the repository and are installed below ``sliplab``, so that no
other name can be taken from, or by, other code. ``.links/sliplab`` shows them as installed. An
editable install adds ``.links`` to Python's path, where a clone named ``sliplab`` in the working
folder cannot hide it: a package with ``__init__.py`` goes before a folder without one.
"""

from setuptools import find_packages, setup

setup(
    packages=find_packages(".links", include=["sliplab", "sliplab.*"]), package_dir={"": ".links"}
)
