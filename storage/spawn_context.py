"""Worker processes, which never run the user's script a second time.

A process that `multiprocessing` spawns begins with its parent's main module. A script without
``if __name__ == "__main__":`` would collect again in each of them, and move an arm. So all pools
and processes here are of the context `WORKERS`, whose processes leave that module out.
"""

from __future__ import annotations

import pickle
import sys
import threading
from importlib.machinery import ModuleSpec
from io import BytesIO
from multiprocessing.context import SpawnContext, SpawnProcess
from typing import Any

_PASSED_OVER = ModuleSpec("sliplab.__main__", None)
"""`multiprocessing` never imports a package's `__main__`."""
_starting = threading.Lock()


class MainModuleError(TypeError):
    """Work for another process needs the script that runs; the message says what to do."""


class _Worker(SpawnProcess):
    """A spawned process without its parent's main module."""

    def start(self) -> None:
        """Start the process."""
        main = sys.modules["__main__"]
        with _starting:
            spec = main.__spec__
            main.__spec__ = _PASSED_OVER
            try:
                super().start()
            finally:
                main.__spec__ = spec


class _Workers(SpawnContext):
    """The context of `multiprocessing` whose processes are workers."""

    Process = _Worker


WORKERS = _Workers()
"""Takes the place of ``multiprocessing.get_context("spawn")``."""


def check_work(*work: Any) -> None:
    """Check that a worker can do some work: functions with their arguments, which are pickled.

    Raises:
        MainModuleError: it needs a function or class of the script that runs.
    """
    _Check(BytesIO()).dump(work)


def refuse_main(module: str, name: str) -> None:
    """Check that a function or class of a module can be found by a worker.

    Raises:
        MainModuleError: it is of the script that runs.
    """
    if module == "__main__":
        raise MainModuleError(
            f"{name}: is defined in the script that runs, which other processes do not import; "
            "define it in a module and import it from there"
        )


class _Check(pickle.Pickler):
    """Pickles nothing that the main module defines."""

    def reducer_override(self, obj: Any) -> Any:
        named = obj if hasattr(obj, "__qualname__") else type(obj)
        refuse_main(getattr(named, "__module__", "") or "", named.__qualname__)
        return NotImplemented
