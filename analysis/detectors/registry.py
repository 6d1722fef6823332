"""Detectors by name: those of plug-ins and other packages, and those of files and commands.

A detector is named by

- a name of `CORE`, that a plug-in declares, or of the entry point group `sliplab.detectors`;
- ``module:attribute``, a class or function that takes no argument and returns a `Detector`;
- the path of a JSON file that `sliplab calibrate detector` wrote;
- the path of an ONNX file, or ``run:COMMAND``, a program that reads standard input and answers on
  output; the plug-in `bench` runs both.
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

from sliplab.analysis.detectors.detector import Detector
from sliplab.analysis.detectors.skin import SUFFIX, calibrated, load_calibration
from sliplab.protocols.errors import InputError
from sliplab.protocols.plugin import plugins
from sliplab.protocols.plugins import PluginError, foreign_code
from sliplab.protocols.shown import did_you_mean

GROUP = "sliplab.detectors"
PROGRAM, ONNX = "run:", ".onnx"
CORE = {"papillae": "sliplab.analysis.detectors.papillae:Papillae"}
_KEY = "DETECTOR"


def known() -> dict[str, str]:
    """Return ``module:attribute`` by name; another package cannot replace a shipped detector."""
    pointed = {point.name: point.value for point in entry_points(group=GROUP)}
    return pointed | plugins().declared("detectors") | CORE


def is_known(name: str) -> bool:
    """Return whether a name has the form of a detector's, or is one."""
    return ":" in name or name.endswith((ONNX, SUFFIX)) or name in known()


def is_shipped(name: str) -> bool:
    """Return whether a name is that of a detector of this package, not of another one's code."""
    return known().get(name, "").startswith("sliplab.")


def contents(name: str) -> list[str]:
    """Return hashes of the files that a detector's name names: its module, model or program."""
    if name.startswith(PROGRAM):
        files = [Path(word) for word in shlex.split(name.removeprefix(PROGRAM))]
    elif name.endswith((ONNX, SUFFIX)):
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
    if name.startswith(PROGRAM) or name.endswith(ONNX):
        made: Detector = plugins().hook("foreign_detector")(name)
        return made
    if name.endswith(SUFFIX):
        return calibrated(load_calibration(Path(name)))
    names = known()
    if name not in names and ":" not in name:
        hint = did_you_mean(name, names)
        raise InputError(
            _KEY,
            "",
            name,
            f"must be one of {', '.join(names)}, MODULE:ATTRIBUTE, a file that ends in {ONNX} or "
            f"{SUFFIX}, or "
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
        if place.startswith("sliplab.") or error.name != module:
            raise  # the extra that is missing is named where the command ends
        raise InputError(_KEY, "", name, f"no module {module} to import") from None
    except PluginError as error:
        raise InputError(_KEY, "", name, f"cannot be made: {error}") from None
    if not isinstance(made, Detector):
        text = f"{place}() is a {type(made).__name__}, not a sliplab.analysis.detectors Detector"
        raise InputError(_KEY, "", name, text)
    return made
