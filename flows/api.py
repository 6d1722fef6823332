"""The public interface of `import sliplab`: stores, trials as arrays, and the analysis steps.

A trial's arrays share one time line: int64 nanoseconds of the trial's sync box. Raw device times
stay in the store (`storage.trials.recording.Recording`), for those who need them.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from sliplab.protocols import InputError, Plan, load_plan
from sliplab.storage.errors import StoreError
from sliplab.storage.files import read_json
from sliplab.storage.streams import EventChunk
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import Store as TrialStore

if TYPE_CHECKING:
    import pandas as pd

    from sliplab.analysis.force import PlateForces
    from sliplab.analysis.networks.training import Fitted
    from sliplab.flows.steps import StepResult

I64 = npt.NDArray[np.int64]
F64 = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Events:
    """Events in time order, n of them."""

    t_ns: I64
    """Time line, nanoseconds, shape (n,), never decreasing."""
    x: npt.NDArray[np.uint16]
    """Column, pixels from the left, shape (n,)."""
    y: npt.NDArray[np.uint16]
    """Row, pixels from the top, shape (n,)."""
    p: npt.NDArray[np.uint8]
    """Polarity, shape (n,): 1 brighter, 0 darker."""

    def __len__(self) -> int:
        return len(self.t_ns)


@dataclass(frozen=True)
class Poses:
    """Poses of the tool centre point in the arm's base frame, n of them."""

    t_ns: I64
    """Time line, nanoseconds, shape (n,)."""
    xyz_mm: F64
    """Position, mm, shape (n, 3)."""
    rotvec_deg: F64
    """Rotation vector, degrees, shape (n, 3)."""

    def __len__(self) -> int:
        return len(self.t_ns)


@dataclass(frozen=True)
class Scalars:
    """Readings of one quantity, n of them."""

    t_ns: I64
    """Time line, nanoseconds, shape (n,)."""
    value: F64
    """Readings in `unit`, shape (n,)."""
    unit: str

    def __len__(self) -> int:
        return len(self.t_ns)


@dataclass(frozen=True)
class Onsets:
    """Onsets of incipient and gross slip in a trial, on its time line."""

    incipient_ns: int | None
    """First slip of any marker, nanoseconds; None when none slipped, or when it is in doubt."""
    gross_ns: int | None
    """Slip of the centre marker, nanoseconds; None when there was none, or when it is in doubt."""


@dataclass(frozen=True)
class WindowCounts:
    """Output spikes of a network in consecutive windows of one trial, n of them."""

    counts: I64
    """Spikes of each class, shape (n, classes), in the order of `Model.classes`."""
    end_ns: I64
    """End of each window on the time line, nanoseconds, shape (n,)."""


class Trial:
    """One committed trial as arrays on one time line.

    Attributes:
        campaign: the campaign's name.
        id: the trial's id; with the campaign it names the trial in its store.
        recording: the trial as it is stored.
    """

    def __init__(self, store: TrialStore, campaign: str, recording: Recording) -> None:
        self._store, self.campaign, self.recording = store, campaign, recording
        self.id = recording.folder.name

    def __repr__(self) -> str:
        simulated = ", simulated" if self.simulated else ""
        return f"<Trial {self.campaign}/{self.id}{simulated}>"

    @property
    def simulated(self) -> bool:
        """True if a simulated rig made this trial."""
        return self.recording.simulated

    def streams(self) -> dict[str, str]:
        """Kinds of the trial's streams by name: ``events``, ``frames``, ``scalar``, ``wrench``, ...

        Those of the first cameras are named ``events`` and ``frames``, further ones as in the rig
        file.
        """
        about = self.recording.record.streams
        return {
            name: about[name].kind if name in about else name for name in self.recording.streams()
        }

    def events(
        self, start_ns: int | None = None, end_ns: int | None = None, stream: str = "events"
    ) -> Events:
        """Events from `start_ns` to before `end_ns` of the time line; all of them by default.

        Args:
            stream: name of a further event camera's stream; the first camera's by default.

        Raises:
            StoreError: the trial is damaged, or has no such events.
        """
        found = self.recording.events(start_ns, end_ns, stream)
        times = self.recording.clock(stream).to_reference(found.t_us * 1000)
        return Events(np.asarray(times), found.x, found.y, found.p)

    def poses(self) -> Poses:
        """Poses of the arm, as its controller reported them.

        Raises:
            StoreError: the trial is damaged, or has no poses.
        """
        with self.recording.open() as reader:
            found = reader.poses()
        times = self.recording.clock("arm").to_reference(found.t_ns)
        return Poses(np.asarray(times), found.xyz_mm, found.rotvec_deg)

    def forces(self, stream: str = "force") -> PlateForces:
        """Forces on the plate in its axes, and on the time line (see docs/force.md).

        Args:
            stream: name of a further force sensor's stream; the first sensor's by default.

        Raises:
            StoreError: the trial is damaged, or has no forces.
        """
        from sliplab.analysis.force import plate_forces

        return plate_forces(self.recording, stream)

    def scalars(self, stream: str) -> Scalars:
        """Readings of a sensor of one quantity, such as a thermometer.

        Raises:
            StoreError: the trial is damaged, or has no such stream.
        """
        found = self.recording.scalars(stream)
        times = self.recording.clock(stream).to_reference(found.t_ns)
        return Scalars(np.asarray(times), found.value, found.unit)

    def pulses(self) -> I64:
        """Rising edges that the sync box made: nanoseconds on the time line, shape (n,)."""
        with self.recording.open() as reader:
            return reader.pulses("sync_pulses")

    def frame_times(self, stream: str = "frames") -> I64:
        """Middle of exposure of each frame: nanoseconds on the time line, shape (n,).

        Args:
            stream: name of a further frame camera's stream; the first camera's by default.
        """
        return self.recording.frame_times(stream)

    def frames(self, stream: str = "frames") -> Iterator[npt.NDArray[np.uint8]]:
        """The video's frames in order, each uint8 of shape (height, width).

        Args:
            stream: as in `frame_times`.

        Raises:
            StoreError: the trial is damaged, or holds no such video.
        """
        self._check_video(stream)
        return self.recording.frames(stream=stream)

    def frame(self, index: int, stream: str = "frames") -> npt.NDArray[np.uint8]:
        """One frame of the video, uint8 of shape (height, width).

        Args:
            stream: as in `frame_times`.

        Raises:
            StoreError: the trial is damaged, or holds no such video.
            IndexError: the video is not that long.
        """
        self._check_video(stream)
        return self.recording.frame(index, stream)

    def _check_video(self, stream: str) -> None:
        if stream != "frames":
            if self.recording.video(stream) is None:
                raise StoreError(f"{self.recording.folder}: stream '{stream}' has no video")
        elif not self.recording.has_video:
            raise StoreError(
                f"{self.recording.folder}: has no video; its camera provided "
                f"{self.recording.frame_source}"
            )

    def step(self, phase: str) -> tuple[int, int]:
        """Start and end of a phase of the motion on the time line, nanoseconds.

        Raises:
            KeyError: the motion has no such phase.
        """
        return self.recording.step(phase)

    @cached_property
    def label(self) -> dict[str, Any]:
        """The trial's label as it is stored (`sliplab schema label` prints its keys).

        Raises:
            StoreError: the trial has no label yet.
        """
        try:
            return Derived.of(self._store, "labels", self.campaign).read(self.id)
        except FileNotFoundError:
            raise self._unlabelled() from None

    def onsets(self) -> Onsets:
        """The onsets of the label, by the rule that the protocol names.

        Raises:
            StoreError: the trial has no label yet.
        """
        return Onsets(self.label["incipient_ns"], self.label["gross_ns"])

    def displacements(self) -> tuple[I64, F64]:
        """Displacement of each of m markers, from which slip is detected.

        Returns:
            times of n frames on the time line, int64 nanoseconds, shape (n,); displacements in
            pixels, shape (n, m), NaN where a marker was not seen.

        Raises:
            StoreError: the trial has no label yet, or one that came with its recording.
        """
        try:
            found = Derived.of(self._store, "labels", self.campaign).arrays(self.id)
        except FileNotFoundError:
            raise self._unlabelled() from None
        if "displacement_px" not in found:
            raise StoreError(
                f"{self.campaign}/{self.id}: its label came with the recording, so no marker was "
                "tracked"
            )
        return found["frame_ns"], found["displacement_px"].astype(np.float64)

    def _unlabelled(self) -> StoreError:
        return StoreError(
            f"{self.campaign}/{self.id}: has no label yet; run `sliplab label` or `Store.label()`"
        )


class Store:
    """A store of trials: its catalogue, its trials, and the analysis steps.

    Each step runs only what is missing or stale, and returns what it did: ``done`` and ``fresh``.
    `campaigns` names those that a step works on; all of them by default.
    """

    def __init__(self, store: TrialStore) -> None:
        self._store = store

    def __repr__(self) -> str:
        return f"<Store {self.folder}: {', '.join(self.campaigns) or 'no campaign'}>"

    @property
    def folder(self) -> Path:
        """The store's folder; of a URL, the folder that mirrors it."""
        return self._store.folder

    @property
    def campaigns(self) -> list[str]:
        """Names of the campaigns."""
        return [campaign.name for campaign in self._store.campaigns()]

    def trials(self, where: str | None = None) -> pd.DataFrame:
        """The committed trials as a table: conditions, counts and quality, units in the headers.

        Args:
            where: only rows for which this holds, such as ``depth_mm > 2.5``.

        Raises:
            ValueError: `where` cannot be answered.
            StoreError: a trial is damaged.
        """
        from sliplab.storage.trials.catalogue import catalogue, query

        table = catalogue(self._store)
        return table if where is None else query(table, where)

    def trial(self, trial_id: str, campaign: str | None = None) -> Trial:
        """One trial.

        Args:
            campaign: needed where several campaigns have a trial of this id.

        Raises:
            StoreError: it does not exist, or more than one.
        """
        found = [
            item
            for item in self._store.campaigns()
            if campaign in (None, item.name) and trial_id in item.committed()
        ]
        if len(found) != 1:
            where = ", ".join(item.name for item in found)
            raise StoreError(
                f"{self.folder}: trial {trial_id}: is in several campaigns ({where}): name one"
                if found
                else f"{self.folder}: trial {trial_id}: no such trial"
                + ("" if campaign is None else f" in campaign {campaign}")
            )
        return Trial(self._store, found[0].name, found[0].recording(trial_id))

    def __iter__(self) -> Iterator[Trial]:
        """All committed trials, by campaign and id."""
        for item in self._store.campaigns():
            for recording in item.recordings():
                yield Trial(self._store, item.name, recording)

    def sync(self, campaigns: Sequence[str] | None = None) -> StepResult:
        """Fit every trial's clocks again."""
        return self._run("sync", campaigns)

    def label(self, campaigns: Sequence[str] | None = None) -> StepResult:
        """Find the onsets of every trial."""
        return self._run("label", campaigns)

    def train(self, campaigns: Sequence[str] | None = None) -> StepResult:
        """Train the network on the labelled kinematic trials."""
        return self._run("train", campaigns)

    def evaluate(self, campaigns: Sequence[str] | None = None) -> StepResult:
        """Judge the network on test trials."""
        return self._run("evaluate", campaigns)

    def report(self, campaigns: Sequence[str] | None = None) -> Path:
        """Write the report; returns its page."""
        self._run("report", campaigns)
        return self.folder / "report" / "index.html"

    def summary(self) -> dict[str, Any]:
        """The figures of the last report (docs/summary.md lists them).

        Raises:
            StoreError: there is no report yet.
        """
        path = self.folder / "report" / "summary.json"
        if not path.exists():
            raise StoreError(f"{path}: does not exist; run `Store.report` first")
        return read_json(path)

    def models(self) -> list[Path]:
        """Files of the networks that were trained here."""
        return sorted((self.folder / "models").glob("*.pt"))

    def _run(self, step: str, campaigns: Sequence[str] | None) -> StepResult:
        from sliplab.flows.running import extras, stopping
        from sliplab.flows.steps import run_step

        with stopping.signals(), extras.named(f"Store.{step}"):
            return run_step(self.folder, None if campaigns is None else list(campaigns), step)


class Model:
    """A trained network, run on events by the event-driven kernels."""

    def __init__(self, fitted: Fitted) -> None:
        self.fitted = fitted

    @property
    def classes(self) -> tuple[str, ...]:
        """Names of the classes, in the order of the counts."""
        from sliplab.analysis.metrics.classification import CLASSES

        if self.fitted.classes == CLASSES:
            return ("no slip", "incipient slip", "gross slip")
        return self.fitted.classes

    def counts(self, trial: Trial) -> WindowCounts:
        """Output spikes in consecutive windows of a trial, as the evaluation counts them.

        Raises:
            StoreError: the trial is damaged, or has no events.
        """
        from sliplab.analysis.networks import training
        from sliplab.analysis.windows import dataset

        windows, end_ns = dataset.trial_windows(trial.recording, self.fitted.windows)
        return WindowCounts(training.predict_counts(self.fitted, windows), end_ns)

    def counts_of(
        self, events: Events, start_ns: I64, size_px: tuple[int, int] = (640, 480)
    ) -> I64:
        """Output spikes in windows of any events.

        Args:
            events: of any event camera, in time order.
            start_ns: start of each window, int64 nanoseconds, shape (n,).
            size_px: columns and rows of the camera.

        Returns:
            spikes of each class, int64, shape (n, classes).

        Raises:
            ValueError: events are not in time order or lie outside of the camera, or the network's
                crop is larger than it.
        """
        from sliplab.analysis.networks import training
        from sliplab.analysis.windows.windows import list_events

        windows = list_events(
            EventChunk(events.x, events.y, events.p, events.t_ns // 1000),
            np.asarray(start_ns) // 1000,
            self.fitted.windows,
            *size_px,
        )
        return training.predict_counts(self.fitted, windows)


def open_store(place: str | Path) -> Store:
    """Open a store.

    Args:
        place: its folder, or the URL of a pushed one (``s3://lab/one``).

    Raises:
        StoreError: it does not exist, it is damaged, or a newer version wrote it.
    """
    from sliplab.storage.remote import mirror
    from sliplab.storage.remote.objects import is_url

    if is_url(str(place)):
        return Store(mirror.open_mirror(str(place))[0])
    return Store(mirror.open_store(Path(place)))


def load_model(path: str | Path) -> Model:
    """Load a network that `Store.train` or ``sliplab train`` made.

    Raises:
        OSError: the file cannot be read.
        ValueError: it is not a model, or is damaged.
        ModuleNotFoundError: the extra ``learn`` is not installed.
    """
    from sliplab.flows.running import extras

    with extras.named("load_model"):
        from sliplab.analysis.networks import model_file

    return Model(model_file.load(Path(path)))


def plan(protocol: str | Path, enable: Iterable[str] = ()) -> Plan:
    """Expand a protocol to its trials, in the order in which they are taken.

    Args:
        protocol: a file, or the name of a protocol that ships with SlipLab (``pilot``).
        enable: optional levels to switch on, as ``factor=level``.

    Raises:
        InputError: the protocol is wrong; the message names file, key, value and what is right.
    """
    return load_plan(Path(protocol), tuple(enable))


def collect(
    protocol: str | Path,
    rig: str | Path,
    store: str | Path,
    *,
    trials: int | None = None,
    campaign: str | None = None,
    enable: Iterable[str] = (),
    no_stopping: bool = False,
) -> Store:
    """Take the trials of a protocol that a store lacks, on a rig.

    Args:
        protocol: a file, or the name of a protocol that ships with SlipLab.
        rig: a rig file, or the name of a rig that ships with SlipLab (``rehearsal``).
        store: the store's folder; made if missing.
        trials: take this many at most.
        campaign: name of the campaign; the protocol's by default.
        enable: optional levels to switch on, as ``factor=level``.
        no_stopping: the protocol's claims do not end the campaign.

    Raises:
        InputError: protocol or rig is wrong, or the rig cannot take the protocol.
        StoreError: the store cannot be used.
        sliplab.CampaignStopped: collection cannot continue; the message says why.
        ModuleNotFoundError: an extra is not installed; the message says which.
    """
    from sliplab.flows.planning.run_request import make_request
    from sliplab.flows.running import extras, stopping
    from sliplab.flows.steps import prepare_store

    if trials is not None and trials < 1:
        raise InputError("trials", "", trials, "must be 1 or more")
    run_request = make_request(
        Path(protocol),
        Path(rig),
        Path(store),
        enable=tuple(enable),
        campaign=campaign,
        most=trials,
        claims="overrule" if no_stopping else "use",
    )
    with stopping.signals(), extras.named("collect"):
        prepare_store(run_request.store)
        from sliplab.flows.collect import collect as take

        take(run_request)
    return open_store(run_request.store)
