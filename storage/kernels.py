"""`njit` that keeps the code of kernels on disk, and sees when anything that they call changes.

numba keeps a kernel's machine code for as long as the file that defines it stays the same. Kernels
and constants of other files are part of that code, and numba does not see when those change: after
an upgrade, or a change to a callee alone, old code would run. So the kernels of a file are cached
in a folder that is named by a hash of every source that they can depend on. It is the user's: what
one checkout or environment has compiled, the next one need not.
"""

from __future__ import annotations

import os
import re
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from hashlib import sha256
from multiprocessing import parent_process
from pathlib import Path
from shutil import rmtree
from typing import Any

import numba
from numba.core import caching, event

_IMPORT = re.compile(r"^from (sliplab[\w.]*) import (?:\(([^)]*)\)|(.*))", re.MULTILINE)
_KEPT_S = 30 * 86_400.0
"""Time for which kernels that nobody uses are kept."""
COMPILING = "compiling once for this version; this takes up to some minutes"


class _FirstCompilation(event.Listener):  # type: ignore[misc]  # numba has no types
    """Says on standard error when this process compiles its first kernel; workers say nothing."""

    announced = False

    def on_start(self, event: Any) -> None:
        if not self.announced and parent_process() is None:
            with suppress(OSError, ValueError):  # closed, or its reader is gone
                print(COMPILING, file=sys.stderr, flush=True)
        self.announced = True

    def on_end(self, event: Any) -> None:
        pass


event.register("numba:compile", _FirstCompilation())


def njit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Compile a kernel as `numba.njit` does; with ``cache=True`` see the module.

    Args:
        options: of `numba.njit`.
    """

    def compiled(function: Callable[..., Any]) -> Any:
        config = numba.config
        before = config.CACHE_DIR, config.CACHE_LOCATOR_CLASSES
        config.CACHE_DIR = str(_folder(function.__module__))
        config.CACHE_LOCATOR_CLASSES = f"{__name__}._Folder,UserWideCacheLocator"
        try:
            return numba.njit(**options)(function)
        finally:
            config.CACHE_DIR, config.CACHE_LOCATOR_CLASSES = before

    return compiled


class _Folder(caching.UserProvidedCacheLocator):  # type: ignore[misc]  # numba has no types
    """Keeps kernels in the folder itself, wherever their source is."""

    @classmethod
    def get_suitable_cache_subpath(cls, py_file: str) -> str:
        return ""


@cache
def _folder(module: str) -> Path:
    """Return the folder of a module's kernels; those that nobody uses any more are deleted."""
    base = _base(Path(str(sys.modules[module].__file__)))
    folder = base / f"{module}-{_stamp(module)}"
    with suppress(OSError):  # not there yet, or another user's
        os.utime(folder)
    for old in base.glob(f"{module}-*"):
        with suppress(OSError):  # deleted by another process
            if old.stat().st_mtime < time.time() - _KEPT_S:
                rmtree(old, ignore_errors=True)
    return folder


def _base(file: Path) -> Path:
    """Return where kernels are kept: as stated, the user's, or beside their source."""
    if stated := os.environ.get("NUMBA_CACHE_DIR"):
        return Path(stated)
    with suppress(OSError, RuntimeError):  # a user without a home, or with one that is not writable
        base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        base = base / "sliplab" / "kernels"
        base.mkdir(parents=True, exist_ok=True)
        if os.access(base, os.W_OK):
            return base
    return file.parent / "__pycache__"


def _stamp(module: str) -> str:
    """Return a hash of a module's source, and of those that its kernels can depend on.

    These are the modules that it imports names from, and in turn those that such a module imports
    names from if it has kernels.
    """
    sources: dict[str, str] = {}
    todo = [module]
    while todo:
        name = todo.pop()
        file = getattr(sys.modules.get(name), "__file__", None)
        if name in sources or file is None:  # of a name that is no module
            continue
        sources[name] = text = Path(file).read_text(encoding="utf-8")
        if name == module or "njit" in text:
            for source, several, single in _IMPORT.findall(text):
                todo.append(source)
                todo += [f"{source}.{each}" for each in re.findall(r"\w+", several or single)]
    made_of = numba.__version__, sorted(sources.items())
    return sha256(repr(made_of).encode()).hexdigest()[:16]
