"""`njit` that keeps the code of kernels on disk, and sees when anything that they call changes.

numba keeps a kernel's machine code for as long as the file that defines it stays the same. Kernels
and constants of other files are part of that code, and numba does not see when those change: after
an upgrade, or a change to a callee alone, old code would run. So the kernels of a file are cached
in a folder that is named by a hash of every source that they can depend on.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from hashlib import sha256
from multiprocessing import parent_process
from pathlib import Path
from shutil import rmtree
from typing import Any

import numba
from numba.core import event

_IMPORT = re.compile(r"^from (sliplab[\w.]*) import (?:\(([^)]*)\)|(.*))", re.MULTILINE)
_USER = "~/.cache/sliplab"
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
        before = numba.config.CACHE_DIR
        numba.config.CACHE_DIR = str(_folder(function.__module__))
        try:
            return numba.njit(**options)(function)
        finally:
            numba.config.CACHE_DIR = before

    return compiled


@cache
def _folder(module: str) -> Path:
    """Return the folder of a module's kernels; those of its earlier versions are deleted."""
    file = Path(str(sys.modules[module].__file__))
    beside, stated = file.parent / "__pycache__", os.environ.get("NUMBA_CACHE_DIR")
    if not stated and not os.access(beside if beside.exists() else file.parent, os.W_OK):
        stated = os.path.expanduser(_USER)
    base = Path(stated) if stated else beside
    name = f"{module}-" if stated else f"{file.stem}-"
    folder = base / f"kernels-{name}{_stamp(module)}"
    if not folder.exists():
        for old in base.glob(f"kernels-{name}*"):
            rmtree(old, ignore_errors=True)
    return folder


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
    return sha256(repr(sorted(sources.items())).encode()).hexdigest()[:16]
