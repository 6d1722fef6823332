"""Detectors by name: those that ship, those of other packages, and those of files and commands.

A detector is named by

- a name of `SHIPPED`, of a plug-in, or of the entry point group `sliplab.detectors`;
- ``module:attribute``, a class or function that takes no argument and returns a `Detector`;
- the path of an ONNX file (`entries.onnx_model`);
- ``run:COMMAND``, a program that reads standard input and answers on output (`entries.program`).
"""

from __future__ import annotations

import os
import shlex
import sys
from hashlib import sha256
from importlib import import_module
from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path

from sliplab.plugins.bench.interface import Detector
from sliplab.protocols.errors import InputError
from sliplab.protocols.plugin import plugins
from sliplab.protocols.plugins import PluginError, foreign_code
from sliplab.protocols.shown import did_you_mean

GROUP = "sliplab.detectors"
_ENTRIES = "sliplab.plugins.bench.entries"
SHIPPED = {
    "paper": f"{_ENTRIES}.network:PaperEntry",
    "ours": f"{_ENTRIES}.network:Ours",
    "paper_physical": f"{_ENTRIES}.network:PaperByPhysicalOnset",
    "ours_2px": f"{_ENTRIES}.network:OursByPaperOnset",
    "cnn": f"{_ENTRIES}.nets:Cnn",
    "cnn_2px": f"{_ENTRIES}.nets:CnnByPaperOnset",
    "gru": f"{_ENTRIES}.nets:Gru",
    "boosting": f"{_ENTRIES}.boosting:Boosting",
    "hyperdimensional": f"{_ENTRIES}.hyperdimensional:Hyperdimensional",
    "rate": f"{_ENTRIES}.thresholds:EventRate",
    "flow": f"{_ENTRIES}.thresholds:Flow",
    "always": f"{_ENTRIES}.trivial:Always",
    "never": f"{_ENTRIES}.trivial:Never",
    "random": f"{_ENTRIES}.trivial:Random",
    "clock": f"{_ENTRIES}.trivial:ByTheClock",
}
PROGRAM, ONNX = "run:", ".onnx"
_KEY = "DETECTOR"


def known() -> dict[str, str]:
    """Return ``module:attribute`` by name; another package cannot replace a shipped detector."""
    pointed = {point.name: point.value for point in entry_points(group=GROUP)}
    return pointed | plugins().declared("detectors") | SHIPPED


def contents(name: str) -> list[str]:
    """Return hashes of the files that a detector's name names: its module, model or program."""
    if name.startswith(PROGRAM):
        files = [Path(word) for word in shlex.split(name.removeprefix(PROGRAM))]
    elif name.endswith(ONNX):
        files = [Path(name)]
    else:
        module = known().get(name, name).partition(":")[0]
        spec = find_spec(module)
        files = [] if spec is None or spec.origin is None else [Path(spec.origin)]
    return [sha256(file.read_bytes()).hexdigest() for file in files if file.is_file()]


def make_detector(name: str) -> Detector:
    """Return the detector of a name; see the module.

    Raises:
        InputError: it does not exist, or cannot be created.
    """
    if name.startswith(PROGRAM):
        from sliplab.plugins.bench.entries.program import ExternalProcess

        return ExternalProcess(name.removeprefix(PROGRAM))
    if name.endswith(ONNX):
        from sliplab.plugins.bench.entries.onnx_model import OnnxModel

        return OnnxModel(name)
    names = known()
    if name not in names and ":" not in name:
        hint = did_you_mean(name, names)
        raise InputError(
            _KEY,
            "",
            name,
            f"must be one of {', '.join(names)}, MODULE:ATTRIBUTE, a file that ends in {ONNX}, or "
            f"{PROGRAM}COMMAND{hint}",
        )
    return _imported(name, names.get(name, name))


def _imported(name: str, place: str) -> Detector:
    """Import a detector; a module may lie in the current folder."""
    module, _, attribute = place.partition(":")
    here = os.getcwd()
    if here not in sys.path:
        sys.path.append(here)
    try:
        with foreign_code():
            made = getattr(import_module(module), attribute)()
    except ModuleNotFoundError as error:
        if place == SHIPPED.get(name) or error.name != module:
            raise  # the extra that is missing is named where the command ends
        raise InputError(_KEY, "", name, f"no module {module} to import") from None
    except PluginError as error:
        raise InputError(_KEY, "", name, f"cannot be made: {error}") from None
    if not isinstance(made, Detector):
        text = f"{place}() is a {type(made).__name__}, not a sliplab.plugins.bench Detector"
        raise InputError(_KEY, "", name, text)
    return made
