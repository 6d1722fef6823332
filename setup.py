"""Mapping of folders to packages; everything else is in pyproject.toml.

The five packages stand at the root of the repository and are installed below ``sliplab``, so that
no other name can be taken from, or by, anybody else's code.
"""

from setuptools import find_packages, setup

BELOW = ("protocols", "rigs", "storage", "analysis", "flows")

setup(
    packages=[
        "sliplab",
        *(
            f"sliplab.{name}"
            for name in find_packages(include=[*BELOW, *(f"{n}.*" for n in BELOW)])
        ),
    ],
    package_dir={"sliplab": "sliplab", **{f"sliplab.{name}": name for name in BELOW}},
)
