"""Networks of other programs: a Python function from windows to output spikes.

It is named ``FILE.py:FUNCTION``. The function gets event counts uint8 (n, steps, channels, cells,
cells), and returns the spikes of each class (n, 3), every window from rest, in the order of
`metrics.classification.CLASSES`. Two attributes of it are looked at: ``windows``, keys of
`analysis.windows` that differ from the defaults, and ``outputs_per_class``, by default 1.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from contextlib import redirect_stdout
from dataclasses import dataclass, replace
from functools import lru_cache
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from sliplab.analysis.metrics.classification import CLASSES
from sliplab.protocols.errors import InputError
from sliplab.protocols.hashing import hash_data
from sliplab.protocols.windows import Windows
from sliplab.protocols.yaml_file import validate
from sliplab.storage.files import read_plain

I64 = npt.NDArray[np.int64]
BATCH = 64
"""Windows that the function gets at a time."""
MOST = 1_000_000
"""Spikes of a class in a window."""
TRIED, SHARE = 16, 0.05
"""Windows by which a changed network is noticed, and their events of a cell and step."""


def names_function(path: Path) -> bool:
    """Return whether this is ``FILE.py:FUNCTION``, or a Python file without a function."""
    return path.suffix == ".py" or ".py:" in path.name


@dataclass(frozen=True)
class ExternalModel:
    """A network of another program.

    Attributes:
        file: of the function. function: its name.
        source: the file's content.
        fingerprint: hash of the spikes in some windows, since weights are in other files.
    """

    file: Path
    function: str
    source: bytes
    windows: Windows
    outputs_per_class: float
    fingerprint: str = ""

    @property
    def place(self) -> str:
        """``FILE.py:FUNCTION``."""
        return f"{self.file}:{self.function}"

    def counts(self, x: npt.NDArray[np.uint8]) -> I64:
        """Output spikes int64 (n, 3) of windows.

        Args:
            x: (n, steps, channels, cells, cells).

        Raises:
            InputError: the function fails, or returns something else.
        """
        parts = [self._batch(x[first : first + BATCH]) for first in range(0, len(x), BATCH)]
        return np.concatenate([np.empty((0, len(CLASSES)), np.int64), *parts])

    def _batch(self, x: npt.NDArray[np.uint8]) -> I64:
        called = _function(self.file, self.function, self.source)
        try:
            with redirect_stdout(sys.stderr):  # what is printed there may be read by a program
                found = np.asarray(called(x.copy()), np.float64)
        except (Exception, SystemExit) as error:
            message = f"failed on windows {x.shape}: {type(error).__name__}: {error}"
            raise InputError(self.place, "", None, message) from error
        expected = (len(x), len(CLASSES))
        if found.shape != expected:
            message = f"returned the shape {found.shape}; must be {expected}, spikes of each class"
            raise InputError(self.place, "", None, message)
        if not ((found >= 0) & (found <= MOST) & (found % 1 == 0)).all():  # NaN is none of these
            message = f"returned numbers that are no counts of spikes; must be whole, 0 to {MOST}"
            raise InputError(self.place, "", None, message)
        return found.astype(np.int64)


def load_external(place: Path) -> ExternalModel:
    """Load ``FILE.py:FUNCTION``, and run it once.

    Raises:
        InputError: there is no such file or function, it cannot be loaded, or it returns no counts.
    """
    name, colon, function = str(place).rpartition(":")
    if not (colon and name.endswith(".py") and function.isidentifier()):
        raise InputError(place, "", None, "must be FILE.py:FUNCTION (docs/models.md)")
    file = Path(name)
    try:
        source = read_plain(file)
    except OSError as error:
        raise InputError(file, "", None, f"cannot be read: {error.strerror}") from None
    _function.cache_clear()  # it may have read other weights
    called = _function(file, function, source)
    stated = getattr(called, "windows", {})
    if not isinstance(stated, dict):
        raise InputError(place, "windows", stated, "must be a mapping of keys to values")
    windows = validate(Windows, dict(stated), f"{place}.windows")
    outputs = getattr(called, "outputs_per_class", 1)
    if isinstance(outputs, bool) or not isinstance(outputs, (int, float)) or not 0 < outputs < 1e6:
        raise InputError(place, "outputs_per_class", outputs, "must be a number above 0")
    model = ExternalModel(file, function, source, windows, float(outputs))
    shape = (TRIED, windows.steps, windows.channels, windows.cells, windows.cells)
    tried = np.random.default_rng(0).poisson(SHARE, shape).astype(np.uint8)
    mark = hash_data([source.hex(), model.counts(tried).tolist()])
    return replace(model, fingerprint=mark)


@lru_cache(maxsize=4)
def _function(file: Path, name: str, source: bytes) -> Callable[[Any], Any]:
    """Execute the file and return its function; once for a content."""
    spec = spec_from_file_location(f"sliplab_external_{file.stem}", file)
    assert spec is not None
    module = module_from_spec(spec)
    folder = str(file.resolve().parent)
    if folder not in sys.path:
        sys.path.append(folder)  # it may import its neighbours, also when it is called
    try:
        with redirect_stdout(sys.stderr):
            exec(compile(source, str(file), "exec"), module.__dict__)
    except (Exception, SystemExit) as error:
        message = f"cannot be loaded: {type(error).__name__}: {error}"
        raise InputError(file, "", None, message) from error
    found = getattr(module, name, None)
    if not callable(found):
        raise InputError(file, "", name, "must be a function in this file")
    return found
