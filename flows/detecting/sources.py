"""What detects on a rig: a network with its rule, or a detector by its name.

Where a safe state depends on it, what may hang or crash runs in a separate process, so that the arm
stops all the same.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import TypeAlias

from sliplab.analysis.detectors.alarms import Level
from sliplab.analysis.detectors.at_level import AtLevel
from sliplab.analysis.detectors.detector import StreamDetector
from sliplab.analysis.detectors.detectors import Tuned
from sliplab.analysis.detectors.named import named_detector, needs_training
from sliplab.analysis.detectors.network_detector import Counting, NetworkDetector, counting_of
from sliplab.analysis.detectors.registry import make_detector
from sliplab.analysis.detectors.skin import SUFFIX, load_calibration
from sliplab.analysis.networks.training import Fitted
from sliplab.flows.detecting.detector_process import DetectorProcess, NetworkProcess, OwnProcess
from sliplab.protocols.detection import Detection
from sliplab.protocols.errors import InputError
from sliplab.rigs.rig_file import RigFile
from sliplab.storage.schema.detector import DetectorCalibration
from sliplab.storage.schema.evaluation import AlarmRate

FRESH_DAYS = 30
"""Age from which `detect` says how old a calibration is; hot cells come and skins wear."""


@dataclass(frozen=True)
class NetworkSource:
    """A trained network, with what reads its spikes.

    Attributes:
        detection: the paper's rule by its settings, or another rule with its levels.
        stride_ms: from one window's start to the next one's; None for the window's length.
    """

    model: Path
    sha256: str
    fitted: Fitted
    detection: Detection | Tuned
    stride_ms: float | None = None

    @property
    def title(self) -> str:
        """What is shown of it."""
        return f"model {self.model.name}"

    @property
    def most(self) -> int:
        """Spikes that a class can give in a window."""
        return self.fitted.windows.steps * self.fitted.network.outputs_per_class

    def detector(
        self, counting: Counting | None = None, centre_px: tuple[float, float] | None = None
    ) -> NetworkDetector:
        """Return the detector in this process.

        Args:
            counting: the network; by default the event-driven kernels in one thread.
        """
        stride_us = None if self.stride_ms is None else round(self.stride_ms * 1000)
        return NetworkDetector(
            counting or counting_of(self.fitted),
            self.fitted.windows,
            self.detection,
            centre_px=centre_px,
            stride_us=stride_us,
        )

    @contextmanager
    def running(
        self, run: OwnProcess | None, centre_px: tuple[float, float] | None
    ) -> Iterator[StreamDetector]:
        """Yield the detector.

        Args:
            run: the network in a process of its own; None: in this one.

        Raises:
            NetworkLost: the process does not start.
        """
        if run is None:
            yield self.detector(None, centre_px)
            return
        with closing(NetworkProcess(self.model, run)) as network:
            yield self.detector(network, centre_px)


@dataclass(frozen=True)
class NamedSource:
    """A detector by its name (`analysis.detectors.registry`).

    Attributes:
        level: that its evidence must exceed; None: validation trials of `store` set it.
        store: whose trials train it; None where it needs no training.
        promise: false alarms an hour, at most, at which validation trials set the level; None: at
            a share of them that is false early.
        skin: its calibration, where it is the file of one.
    """

    name: str
    level: float | None
    store: Path | None
    promise: float | None = None
    skin: DetectorCalibration | None = None

    @property
    def title(self) -> str:
        """What is shown of it."""
        return f"detector {self.name}"

    def check_rig(self, file: RigFile, camera: str | None = None) -> None:
        """Refuse a calibration whose figures cannot hold on a rig.

        Args:
            camera: serial number of its event camera, where it is known.

        Raises:
            InputError: it is of another skin or camera, or of a simulated one.
        """
        if (skin := self.skin) is None:
            return
        again = f"run `sliplab calibrate detector --rig {file.name}`"
        if skin.skin != file.skin.serial:
            right = f"must be the skin of the rig {file.name}, '{file.skin.serial}': {again}"
            raise InputError(self.name, "skin", skin.skin, right)
        if skin.simulated and not file.simulated:
            right = f"must be false: the rig {file.name} is real; {again}"
            raise InputError(self.name, "simulated", "true", right)
        if None not in (camera, skin.camera) and camera != skin.camera:
            right = f"must be the event camera of the rig {file.name}, '{camera}', whose hot cells "
            raise InputError(self.name, "camera", skin.camera, f"{right}it leaves out: {again}")

    def doubts(self, file: RigFile) -> list[str]:
        """Return why the figures of its calibration may not hold on a rig."""
        if (skin := self.skin) is None:
            return []
        found = []
        if skin.rig != file.name:
            found.append(f"on the rig {skin.rig}, not {file.name}")
        if (days := (date.today() - date.fromisoformat(skin.measured)).days) > FRESH_DAYS:
            found.append(f"{days} days ago")
        return [
            f"{self.name} was measured {each}: hot cells, level and promise may not hold; run "
            f"`sliplab calibrate detector --rig {file.name}`"
            for each in found
        ]

    def promised_on(self, file: RigFile, asked: float | None) -> Level | None:
        """Return what the false alarms of its calibration promise for its level on a rig.

        A lower level and another rig have no hour that was measured.

        Args:
            asked: false alarms an hour, at most; None: what the calibration promises.

        Returns:
            None where trials set the level, and where nothing is asked and nothing measured.
        """
        skin, level = self.skin, self.level
        if level is None:
            return None
        found = AlarmRate(alarms=0, hours=0.0, value=0.0, low=None, high=None)
        if skin is not None and level >= skin.level and skin.rig == file.name:
            found = skin.hold
        most = found.high if asked is None else asked
        held = found.high is not None and most is not None and found.high <= most
        return None if most is None else Level(most, level, found, held)

    @property
    def most(self) -> None:
        """No spikes are shown."""
        return

    def detector(self) -> AtLevel:
        """Return the detector in this process; see `named_detector`."""
        return named_detector(self.name, self.level, self.store, self.promise)

    @contextmanager
    def running(
        self, run: OwnProcess | None, centre_px: tuple[float, float] | None
    ) -> Iterator[StreamDetector]:
        """Yield the detector; see `NetworkSource.running`. It takes no centre of a crop.

        Raises:
            DetectorError: it cannot be trained, or its process does not start.
        """
        if run is None:
            with closing(self.detector()) as made:
                yield made
            return
        given = self.name, self.level, self.store, self.promise
        with closing(DetectorProcess(*given, run)) as process:
            yield AtLevel(process, process.level, process.set_by)


Source: TypeAlias = NetworkSource | NamedSource


def named_source(
    name: str, level: float | None, store: Path | None, promise: float | None = None
) -> NamedSource:
    """Check that a detector can be had.

    Raises:
        InputError: there is none of the name, or it needs a store.
    """
    if name.endswith(SUFFIX):
        skin = load_calibration(Path(name))
        return NamedSource(name, skin.level if level is None else level, None, promise, skin)
    made = make_detector(name)
    trained = needs_training(made)
    made.close()
    if store is None and trained:
        right = f"is needed: '{name}' is trained on the trials of a store"
        raise InputError("--model", "", None, right)
    if store is None and level is None:
        right = f"is needed, or a store as --model, whose validation trials set it for '{name}'"
        raise InputError("--level", "", None, right)
    return NamedSource(name, level, store, promise)
