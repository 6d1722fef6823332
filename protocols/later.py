"""Modules of optional packages, loaded when one of their names is used.

    if TYPE_CHECKING:
        import av
    else:
        av = Later("av")

What needs such a module says so when it runs: `flows.running.extras` names the extra that is
missing. What does not need it works without it, and begins sooner.
"""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from typing import Any


class Later:
    """Stands for a module until it is used.

    Raises:
        ModuleNotFoundError: at the first use, if its package is not installed.
    """

    def __init__(self, module: str) -> None:
        self._module = module

    def __getattr__(self, name: str) -> Any:
        found = getattr(import_module(self._module), name)
        setattr(self, name, found)
        return found


def installed(module: str) -> bool:
    """Check that a top-level module is installed; it is not imported."""
    try:
        return find_spec(module) is not None
    except (ModuleNotFoundError, ValueError):
        return False


def need(module: str) -> None:
    """Check that a top-level module is installed, before it is used.

    Raises:
        ModuleNotFoundError: it is not.
    """
    if not installed(module):
        raise ModuleNotFoundError(f"No module named '{module}'", name=module)
