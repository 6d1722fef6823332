"""An ONNX file as an entry: windows of events in, votes or evidence out.

Its one input is uint8 (n, steps, channels, cells, cells), n free: event counts of a window as
`analysis.windows` bins them, of positive events with one channel, of negative and positive ones
with two. Its first output is (n, 3), log odds of no slip, incipient and gross slip up to a constant
a window, or (n, 1), evidence for slip. Metadata of the file may say `step_ms` (1), `crop_px`
(400), `stride_ms` (10), from one window to the next, and `gain` (1), a factor on votes.

`onnx` reads the size of the weights and `onnxruntime` runs the file, in one thread; both are the
optional extra ``onnx``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from sliplab.analysis.detectors.detector import Cost
from sliplab.analysis.metrics.classification import CLASSES
from sliplab.analysis.windows.sparse import SparseWindows
from sliplab.plugins.bench.windowed import MeanOdds, WindowDetector
from sliplab.protocols.errors import InputError
from sliplab.protocols.windows import Windows

DEFAULTS = {"step_ms": 1, "crop_px": 400, "stride_ms": 10, "gain": 1.0}
BATCH = 64
_RANK = 5


class OnnxModel(WindowDetector):
    """A network in an ONNX file, see the module.

    Raises:
        InputError: the file cannot be read, or its input, output or metadata are others.
        ModuleNotFoundError: the extra ``onnx`` is not installed.
    """

    def __init__(self, file: str) -> None:
        import onnxruntime

        self._file = Path(file)
        if not self._file.is_file():
            raise InputError(file, "", None, "no such file")
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        try:
            self._session = onnxruntime.InferenceSession(
                file, options, providers=["CPUExecutionProvider"]
            )
        except Exception as error:  # onnxruntime has a class for each of its states
            reason = str(error).splitlines()[0]
            raise InputError(file, "", None, f"cannot be run: {reason}") from None
        inputs, outputs = self._session.get_inputs(), self._session.get_outputs()
        self._input, self._output = inputs[0].name, outputs[0].name
        self._columns = self._columns_of(outputs[0])
        found = self._metadata()
        windows = self._windows_of(inputs[0], found)
        super().__init__(windows, int(found["stride_ms"]))
        self._gain = found["gain"]

    def _metadata(self) -> dict[str, float]:
        stated = self._session.get_modelmeta().custom_metadata_map
        found = {}
        for key, usual in DEFAULTS.items():
            try:
                found[key] = type(usual)(stated.get(key, usual))
            except ValueError:
                text = f"must be a number, such as {usual}"
                raise InputError(str(self._file), key, stated[key], text) from None
            if found[key] <= 0:
                raise InputError(str(self._file), key, stated[key], "must be positive")
        return found

    def _windows_of(self, given: Any, found: dict[str, float]) -> Windows:
        shape = given.shape
        fixed = all(isinstance(size, int) for size in shape[1:])
        if given.type != "tensor(uint8)" or len(shape) != _RANK or not fixed:
            text = "must be uint8 (n, steps, channels, cells, cells), n free"
            raise InputError(str(self._file), given.name, f"{given.type} {shape}", text)
        steps, channels, rows, columns = shape[1:]
        crop_px = int(found["crop_px"])
        if channels not in {1, 2} or rows != columns or crop_px % rows:
            text = f"must have 1 or 2 channels and as many rows as columns, which divide {crop_px}"
            raise InputError(str(self._file), given.name, shape, text)
        return Windows(
            length_ms=steps * int(found["step_ms"]),
            step_ms=int(found["step_ms"]),
            crop_px=crop_px,
            pool_px=crop_px // rows,
            polarity="both" if channels == 2 else "positive",
        )

    def _columns_of(self, given: Any) -> int:
        columns = given.shape[-1]
        if len(given.shape) != 2 or columns not in {1, len(CLASSES)}:
            text = "must be (n, 3) votes for no slip, incipient and gross slip, or (n, 1) evidence"
            raise InputError(str(self._file), given.name, given.shape, text)
        return int(columns)

    def restart(self) -> None:
        """See `WindowDetector`."""
        self._odds = MeanOdds()

    def decide(self, x: SparseWindows) -> tuple[npt.ArrayLike, npt.ArrayLike | None]:
        """See `WindowDetector`."""
        dense = x.dense()
        found = np.concatenate(
            [
                self._session.run([self._output], {self._input: dense[start : start + BATCH]})[0]
                for start in range(0, len(dense), BATCH)
            ]
        )
        if self._columns == 1:
            return found[:, 0], None
        return self._odds.step(self._gain * found)

    def cost(self) -> Cost:
        """Return the size of the weights."""
        import onnx
        from onnx import numpy_helper

        weights = onnx.load(str(self._file)).graph.initializer
        return Cost(None, sum(numpy_helper.to_array(weight).nbytes for weight in weights))
