"""Fixtures for tests of live detection: a model file, a short trial, scripted networks."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from sliplab.analysis.detectors.detector import StreamDetector
from sliplab.analysis.detectors.network_detector import Counting
from sliplab.analysis.networks import model_file
from sliplab.analysis.networks.network import SPIKING, build, weights
from sliplab.analysis.networks.training import EpochRecord, Fitted
from sliplab.flows.detect import BuildRig
from sliplab.flows.detecting.request import DetectRequest, make_detect_request
from sliplab.flows.detecting.sources import NetworkSource
from sliplab.protocols.network_settings import NetworkSettings
from sliplab.protocols.training import Training
from sliplab.protocols.windows import Windows
from sliplab.rigs.build import ShouldStop, build_rig
from sliplab.rigs.core.rig import Rig
from sliplab.rigs.rig_file import RigFile
from tests.conftest import ROOT
from tests.flows.live import quick

RIG = ROOT / "rigs" / "rehearsal.yaml"
MANY = 300
"""Events of a 30 ms window that only a moving sensor gives."""


def untrained(seed: int = 0, outputs: int = 4) -> Fitted:
    """A network as it is before training; it spikes, and knows nothing."""
    network = NetworkSettings(outputs_per_class=outputs)
    windows, training = Windows(), Training(epochs=1)
    record = EpochRecord(1, 1.0, 0.3, 1.0, 0.3, 0.3, 0.3, dict.fromkeys(SPIKING, 0.1))
    state = weights(build(network, windows, seed))
    return Fitted(state, network, windows, training, seed, (record,), 1, ())


def model_in(folder: Path, outputs: int = 4) -> Path:
    """A model file."""
    path = folder / "model.pt"
    model_file.save(path, untrained(outputs=outputs))
    return path


def scripted(order: DetectRequest, counting: Counting) -> StreamDetector:
    """The network detector of a request, with another network."""
    assert isinstance(order.source, NetworkSource)
    return order.source.detector(counting)


def slip_when_busy(most: int = MANY) -> Counting:
    """Says incipient slip in a window with more than so many counts, no slip otherwise."""

    def count(x: npt.NDArray[np.uint8]) -> npt.NDArray[np.int64]:
        busy = int(x.sum()) > most
        return np.array([[0, 9, 0] if busy else [9, 0, 0]], np.int64)

    return count


def short_slide() -> dict[str, Any]:
    """A slide of 7 mm at 6 mm/s after half a second of hold."""
    return quick()


def ordered(model: Path, protocol: Path, **options: Any) -> DetectRequest:
    """The first trial of a protocol on the simulated rig."""
    return make_detect_request(RIG, model, protocol=protocol, trial="", **options)


def keeping(rigs: list[Rig]) -> BuildRig:
    """Builds rigs and keeps them to be looked at."""

    def build(file: RigFile, should_stop: ShouldStop) -> Rig:
        rigs.append(build_rig(file, should_stop))
        return rigs[-1]

    return build


def stands_clear(rig: Rig) -> bool:
    """Return whether the arm is at rest clear of the plate."""
    return rig.arm.progress().done and rig.position().depth_mm < 0
