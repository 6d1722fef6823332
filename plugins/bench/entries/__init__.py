"""Detectors that ship."""

from __future__ import annotations

from sliplab.analysis.detectors.detector import Detector
from sliplab.analysis.detectors.registry import PROGRAM


def foreign_detector(name: str) -> Detector:
    """Return the detector of an ONNX file, or of a program after ``run:``.

    Raises:
        InputError: see both.
    """
    if name.startswith(PROGRAM):
        from sliplab.plugins.bench.entries.program import ExternalProcess

        return ExternalProcess(name.removeprefix(PROGRAM))
    from sliplab.plugins.bench.entries.onnx_model import OnnxModel

    return OnnxModel(name)
