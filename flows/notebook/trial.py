"""A trial as arrays on one time line: int64 nanoseconds of its sync box."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from sliplab.flows.notebook.arguments import checked_methods
from sliplab.flows.notebook.html import pairs_html
from sliplab.protocols.errors import InputError
from sliplab.protocols.shown import one_of
from sliplab.storage.errors import StoreError
from sliplab.storage.streams import Json
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import TrialStore

if TYPE_CHECKING:
    import xarray

    from sliplab.analysis.force import PlateForces
    from sliplab.analysis.report.page import Figure

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


@checked_methods
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
            InputError: the motion has no such phase.
        """
        phases = dict.fromkeys(each.phase for each in self.recording.record.steps)
        if phase not in phases:
            raise InputError("phase", "", phase, one_of(phase, phases))
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
        if not self._labelled:
            raise self._unlabelled()
        found = self._displacements()
        if found is None:
            raise StoreError(
                f"{self.campaign}/{self.id}: its label came with the recording, so no marker was "
                "tracked"
            )
        return found

    def to_dict(self) -> Json:
        """The trial as ``xarray.Dataset.from_dict`` takes it: every stream but the video's frames.

        Each stream has a dimension of its name, with its times in ``NAME_t_ns``; units are in the
        names. Rows of a column have the dimensions ``NAME_COLUMN_axis``, ``NAME_COLUMN_axis2``, and
        so on. Streams without a clock are left out. Attributes are the trial's condition and
        context, its onsets where it is labelled, and whether it is simulated.

        Raises:
            StoreError: the trial is damaged.
        """
        counts = self.recording.record.counts
        data: Json = {}

        def add(stream: str, time_ns: I64, attrs: Any = None, /, **columns: Any) -> None:
            coords[f"{stream}_t_ns"] = {"dims": (stream,), "data": time_ns, "attrs": {}}
            for name, values in columns.items():
                axes = (f"{stream}_{name}_axis{n or ''}" for n in (0, *range(2, values.ndim)))
                dims = (stream, *axes)[: values.ndim]
                data[f"{stream}_{name}"] = {"dims": dims, "data": values, "attrs": attrs or {}}

        coords: Json = {}
        known = self.recording.clocks.devices()
        for name, kind in self.streams().items():
            if name not in known:
                continue
            if kind == "events":
                events = self.events(stream=name)
                add(name, events.t_ns, x=events.x, y=events.y, p=events.p)
            elif kind == "frames":
                add(name, self.frame_times(name))
            elif kind == "wrench":
                forces = self.forces(name)
                add(name, forces.t_ns, force_n=forces.force_n)
            else:
                columns = self.recording.samples(name)
                unit = self.recording.record.streams[name].unit
                add(name, columns.pop("t"), unit and {"unit": unit}, **columns)
        if counts.poses:
            poses = self.poses()
            add("poses", poses.t_ns, xyz_mm=poses.xyz_mm, rotvec_deg=poses.rotvec_deg)
        if counts.pulses:
            add("pulses", self.pulses())
        attrs: Json = {"campaign": self.campaign, "trial": self.id, "simulated": self.simulated}
        attrs |= self.recording.described
        if self._labelled:
            times, displacement_px = self._displacements() or (None, None)
            if times is not None:
                add("markers", times, displacement_px=displacement_px)
            attrs |= {key: ns for key, ns in vars(self.onsets()).items() if ns is not None}
        return {"coords": coords, "data_vars": data, "attrs": attrs}

    def to_xarray(self) -> xarray.Dataset:
        """The trial as an xarray data set; see `to_dict`.

        Raises:
            ModuleNotFoundError: the extra ``xarray`` is not installed.
            StoreError: the trial is damaged.
        """
        import xarray

        return xarray.Dataset.from_dict(self.to_dict())

    def plot(self) -> Figure:
        """Markers, event rate and events over time, with both onsets, as the report draws them.

        Raises:
            StoreError: the trial has no label yet, or no events.
            ModuleNotFoundError: the extra ``report`` is not installed.
        """
        from sliplab.analysis.campaigns import Collected
        from sliplab.analysis.report.trial import Example, trial_section
        from sliplab.storage.schema.evaluation import TrialScore

        if "events" not in self.recording.streams("events"):
            raise StoreError(f"{self.id}: was recorded without events, which the plot shows")
        item, onsets = Collected(self._store.campaign(self.campaign)), self.onsets()
        row = TrialScore(
            campaign=self.campaign,
            experiment=item.experiment,
            trial=self.id,
            condition=self.recording.record.condition,
            incipient_ns=onsets.incipient_ns,
            gross_ns=onsets.gross_ns,
            end_ns=None,
            detected_incipient_ns=None,
            detected_gross_ns=None,
            latency=None,
        )
        example = Example(item, self.recording, row)
        return trial_section(self._store, example, simulated=self.simulated).figure

    def _repr_html_(self) -> str:
        record = self.recording.record
        labelled = vars(self.onsets()) if self._labelled else {"label": "none yet"}
        counts = {name: count for name, count in vars(record.counts).items() if count}
        return pairs_html(repr(self), {**self.recording.described, **counts, **labelled})

    @property
    def _labelled(self) -> bool:
        return Derived.of(self._store, "labels", self.campaign).key(self.id) is not None

    def _displacements(self) -> tuple[I64, F64] | None:
        """Return what `displacements` does; None where no marker was tracked."""
        found = Derived.of(self._store, "labels", self.campaign).arrays(self.id)
        if "displacement_px" not in found:
            return None
        return found["frame_ns"], found["displacement_px"].astype(np.float64)

    def _unlabelled(self) -> StoreError:
        return StoreError(
            f"{self.campaign}/{self.id}: has no label yet; run `sliplab label` or `Store.label()`"
        )
