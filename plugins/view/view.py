"""One trial in Rerun: everything that was recorded and derived, on one time line.

Rerun's viewer and its own readers can read the file. Times are the trial's own (the sync box's
clock), int64 nanoseconds, none of them rounded. Sizes are bounded: a trial of any length becomes a
file that a laptop opens. Entities, sent as whole columns:

events/on, events/off      points, a row a bin of 5 ms; events/counts in their place where there
                           are too many: pictures of how many events fell on 2 x 2 pixels
events/rate                events a second
camera, camera/markers     frames (JPEG), the markers in them; camera/plate the plate's marker
arm                        tool centre point as a transform; arm/path; arm/x, y, z in mm
pulses/sync_box, events, arm
force/normal, tangential   N on the plate, where the rig measures it; force/x, y along it
streams/NAME               a further camera, as events and camera above, or a curve of readings
displacement/marker_N      px
onsets/NAME                0 before, 1 after the incipient, 2 after the gross onset, of the label,
                           the review and (simulated) the truth; onset_log as text
network/no_slip ...        spike counts of the evaluated network
"""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from sliplab.analysis.campaigns import Collected, has_plan
from sliplab.analysis.event_rate import RATE_NS, event_rate
from sliplab.analysis.force import has_forces, plate_forces
from sliplab.analysis.labels.reviewed import label_key, state_of
from sliplab.analysis.metrics.classification import CLASSES
from sliplab.analysis.windows.dataset import recorded_span
from sliplab.flows.running import stopping
from sliplab.storage.errors import StoreError
from sliplab.storage.files import make_folder, replacing, scratch_folder
from sliplab.storage.process import Child, start_tethered
from sliplab.storage.schema.label import LABELS, TrialLabel
from sliplab.storage.streams import (
    CLOCK,
    EVENTS_KIND,
    FRAMES_KIND,
    I64,
    SCALAR,
    WRENCH,
    EventChunk,
)
from sliplab.storage.trials import review
from sliplab.storage.trials.derived import Arrays, Derived
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import TrialStore

APPLICATION = "sliplab"


def find(store: TrialStore, trial: str, campaign: str | None = None) -> Subject:
    """Find the committed trial of this id.

    Raises:
        NoTrial: it does not exist, or several campaigns have it.
    """
    item = store.holder(trial, campaign)
    return Subject(store, Collected(item), item.recording(trial))


def rerun() -> ModuleType:
    """Import the Rerun library.

    Raises:
        ModuleNotFoundError: it is not installed.
    """
    import rerun as found

    return found


def save(subject: Subject, path: Path) -> dict[str, int]:
    """Write a trial as an .rrd file, atomically.

    Returns:
        numbers of events, frames and so on, and the file's bytes.

    Raises:
        StoreError: the trial is damaged.
        ModuleNotFoundError: Rerun is not installed.
    """
    library = rerun()
    library.set_strict_mode(True)  # what cannot be written is an error, not a warning

    make_folder(path.parent)
    with replacing(path) as unfinished:
        stream = library.RecordingStream(
            APPLICATION, recording_id=f"{subject.item.name}/{subject.trial}"
        )
        try:
            forces = has_forces(subject.recording)
            record = subject.recording.record
            further = {
                name: about.kind
                for name, about in record.streams.items()
                if (about.timing is not None or record.imported is not None)
                and about.kind != CLOCK.name
            }
            shown = blueprint(library, forces=forces, further=further)
            stream.save(unfinished, default_blueprint=shown)
            counts = send(library, stream, subject)
            stream.flush()
        finally:
            stream.disconnect()
    return {**counts, "bytes": path.stat().st_size}


def show(subject: Subject) -> None:
    """Open a trial in Rerun's viewer, and wait until the user closes it.

    Raises:
        StoreError: there is no display.
        ModuleNotFoundError: Rerun is not installed.
    """
    rerun()
    if not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise StoreError("no display available; --save FILE.rrd writes a file to open elsewhere")
    with scratch_folder() as folder:
        path = folder / f"{subject.item.name}.rrd"
        save(subject, path)
        with silent() as environment, viewer(str(path), environment=environment) as window:
            while window.poll() is None:
                stopping.wait(0.2)
        if window.returncode:
            raise StoreError(f"Rerun's viewer ended with {window.returncode}")


ALONE = ("--bind", "127.0.0.1", "--port", "auto")
"""Options of Rerun's viewer. By default its server listens on every network of the computer and
passes the file to any program that listens on its usual port, maybe another user's."""


@contextmanager
def viewer(*arguments: str, environment: dict[str, str]) -> Iterator[Child]:
    """Run Rerun's program while the block runs; nothing of it is left afterwards.

    It has its own session, because it starts another program, which outlives it otherwise.
    """
    # what it prints is for people: standard output has nothing but the command's result
    process = start_tethered([program(), *ALONE, *arguments], env=environment, stdout=2)
    try:
        yield process
    finally:
        process.stop(10, group=True)


def program() -> str:
    """Find Rerun's own program.

    Raises:
        StoreError: it cannot be found.
    """
    import sys

    sibling = Path(sys.executable).with_name("rerun")
    found = str(sibling) if sibling.exists() else shutil.which("rerun")
    if found is None:
        raise StoreError("Rerun's program `rerun` cannot be found next to its library")
    return found


@contextmanager
def silent() -> Iterator[dict[str, str]]:
    """Yield an environment in which Rerun's viewer sends no usage data.

    Its only switch is a file among the user's settings. It is set in a folder of our own, so that
    the user's choice stays unchanged.

    Raises:
        StoreError: the switch could not be set.
    """
    with scratch_folder() as folder:
        environment = {**os.environ, "XDG_CONFIG_HOME": str(folder)}
        done = subprocess.run(
            [program(), "analytics", "disable"],
            env=environment,
            capture_output=True,
            timeout=60,
            check=False,
        )
        if done.returncode:
            raise StoreError(f"Rerun's analytics cannot be switched off: {done.stderr.decode()}")
        yield environment


TIMELINE = "trial_time"
BIN_NS = 5_000_000
MOST_POINTS = 5_000_000
"""More events than this become pictures; as points they would take 40 MB and more."""
MOST_IMAGES = 1000
MOST_RATES = 1_000_000
"""Points of the curve of the event rate; a longer recording has none."""
POOL = 2
MOST_FRAMES = 2000
"""Of more frames, every second, third, ... is taken."""
_QUALITY = 90
COUNTS = "counts"


@dataclass(frozen=True)
class Subject:
    """The trial to view."""

    store: TrialStore
    item: Collected
    recording: Recording

    @property
    def trial(self) -> str:
        """Its id."""
        return self.recording.folder.name


class _Columns:
    """Sends columns over the trial's time line."""

    def __init__(self, library: ModuleType, stream: Any) -> None:
        self.rr, self._stream = library, stream
        self.sent: dict[str, int] = {}

    def send(self, path: str, time_ns: I64, columns: Any, count: str = "") -> None:
        """Send rows at times; `count` is the name under which they are counted."""
        if len(time_ns):
            index = self.rr.TimeColumn(TIMELINE, duration=time_ns.astype("timedelta64[ns]"))
            self._stream.send_columns(path, indexes=[index], columns=columns)
        if count:
            self.sent[count] = self.sent.get(count, 0) + len(time_ns)

    def scalars(self, path: str, time_ns: I64, values: Any, count: str = "") -> None:
        """Send a curve."""
        self.send(path, time_ns, self.rr.Scalars.columns(scalars=np.asarray(values, float)), count)

    def once(self, path: str, *what: Any) -> None:
        """Send something that does not change."""
        self._stream.log(path, *what, static=True)


def send(library: ModuleType, stream: Any, subject: Subject) -> dict[str, int]:
    """Send all of a trial to a recording stream; return numbers by kind."""
    recording = subject.recording
    to = _Columns(library, stream)
    derived = Derived.of(subject.store, LABELS, subject.item.name)
    key = ""
    if has_plan(subject.item.info):
        key = label_key(recording, subject.item.settings.labelling)
    fresh = bool(key) and derived.fresh(subject.trial, key)
    label = derived.load(subject.trial, TrialLabel) if fresh else None
    arrays = derived.arrays(subject.trial) if fresh else {}
    condition = ", ".join(f"{name} {text}" for name, text in recording.record.condition.items())
    kind = "**simulated**" if recording.simulated else "recorded"
    text = f"# {condition}\n\n{kind}\n\n{subject.item.name} / {subject.trial}"
    document = library.TextDocument(text, media_type=library.MediaType.MARKDOWN)
    to.once("trial", document)
    _events(to, subject)
    _frames(to, subject, arrays)
    _arm(to, subject)
    _pulses(to, subject)
    _forces(to, subject)
    _further(to, recording)
    if "displacement_px" in arrays:
        for marker, values in enumerate(arrays["displacement_px"].T):
            there = np.isfinite(values)
            to.scalars(f"displacement/marker_{marker}", arrays["frame_ns"][there], values[there])
    _onsets(to, subject, label, key)
    _network(to, subject)
    return to.sent


def _events(to: _Columns, subject: Subject) -> None:
    recording = subject.recording
    if not recording.record.counts.events:
        return
    to.sent["events"] = _event_camera(to, recording, "events", "events")
    start, end = recorded_span(recording)
    if (end - start) // RATE_NS > MOST_RATES:
        return
    rate_s, rate = event_rate(recording, start, end)
    to.scalars("events/rate", np.round(rate_s * 1e9).astype(np.int64), rate)


def _event_camera(to: _Columns, recording: Recording, stream: str, path: str) -> int:
    """Send the events of one camera; return their number."""
    events = recording.events(stream=stream)
    time_ns = np.asarray(recording.clock(stream).to_reference(events.t_us * 1000))
    if len(events) <= MOST_POINTS:
        for name, polarity in (("on", 1), ("off", 0)):
            _points(to, f"{path}/{name}", events, time_ns, events.p == polarity)
    else:
        about = recording.record.streams.get(stream)
        size = recording.record.geometry.event_px if about is None else about.size_px
        seen = int(events.x.max()) + 1, int(events.y.max()) + 1
        _count_images(to, path, size or seen, events, time_ns)
    return len(events)


def _further(to: _Columns, recording: Recording) -> None:
    """Send the streams of further devices, each below its name."""
    for name, about in sorted(recording.record.streams.items()):
        if about.kind == CLOCK.name or not about.rows:  # readings of a clock have no clock
            continue
        path, count = f"streams/{name}", f"{name}_{about.kind}"
        if about.kind == EVENTS_KIND:
            to.sent[count] = _event_camera(to, recording, name, path)
        elif about.kind == FRAMES_KIND:
            _pictures(to, recording, name, path)
            to.sent[count] = about.rows
        elif about.kind == WRENCH.name and recording.record.imported is not None:
            wrench = recording.wrenches(name)
            time_ns = np.asarray(recording.clock(name).to_reference(wrench.t_ns))
            for axis, values in zip("xyz", wrench.force_n.T, strict=True):
                to.scalars(f"{path}/f{axis}", time_ns, values, count if axis == "x" else "")
        elif about.kind == WRENCH.name and about.timing is not None:
            forces = plate_forces(recording, name)
            to.scalars(f"{path}/normal", forces.t_ns, forces.normal_n, count)
            to.scalars(f"{path}/tangential", forces.t_ns, forces.tangential_n)
        elif about.kind == SCALAR.name:
            found = recording.scalars(name)
            time_ns = np.asarray(recording.clock(name).to_reference(found.t_ns))
            to.once(path, to.rr.SeriesLines(names=f"{name} ({found.unit})"))
            to.scalars(path, time_ns, found.value, count)
        elif about.kind != WRENCH.name:
            samples = recording.samples(name)
            time_ns = samples.pop("t")
            to.sent[count] = len(time_ns)
            for part, values in samples.items():
                for index, component in enumerate(values.reshape(len(time_ns), -1).T):
                    to.scalars(f"{path}/{part}/{index}", time_ns, component)


def _pictures(to: _Columns, recording: Recording, stream: str, path: str, count: str = "") -> None:
    """Send the video of one frame camera, if it has one: every n-th frame of a long one."""
    if recording.video(stream) is None:
        return
    import cv2

    time_ns = recording.frame_times(stream)
    every = -(-len(time_ns) // MOST_FRAMES) or 1
    for index, image in enumerate(recording.frames(threads=2, stream=stream)):
        if index % every or index >= len(time_ns):
            continue
        done, packed = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
        if not done:
            raise RuntimeError(f"frame {index} cannot be packed")
        columns = to.rr.EncodedImage.columns(blob=[packed.tobytes()], media_type=["image/jpeg"])
        to.send(path, time_ns[index : index + 1], columns, count)


def _points(to: _Columns, path: str, events: EventChunk, time_ns: I64, which: Any) -> None:
    """Send events of one polarity, a row a bin, at the time of the bin's first event."""
    times, x, y = time_ns[which], events.x[which], events.y[which]
    if not len(times):
        return
    bins = times // BIN_NS
    first = np.flatnonzero(np.diff(bins, prepend=bins[0] - 1))
    lengths = np.diff(first, append=len(times))
    places = np.stack([x, y], axis=1).astype(np.float32)
    columns = to.rr.Points2D.columns(positions=places).partition(lengths)
    to.send(path, times[first], columns)


def _count_images(
    to: _Columns, path: str, size: tuple[int, int], events: EventChunk, time_ns: I64
) -> None:
    """Send counts of events on pooled pixels, uint16, in bins of equal length."""
    shape = (-(-size[1] // POOL), -(-size[0] // POOL))
    length = max(BIN_NS, -(-int(time_ns[-1] - time_ns[0] + 1) // MOST_IMAGES))
    cell = (events.y // POOL).astype(np.int64) * shape[1] + events.x // POOL
    edges = np.arange(int(time_ns[0]), int(time_ns[-1]) + 1, length)
    cuts = [*np.searchsorted(time_ns, edges), len(time_ns)]
    for low, high, edge in zip(cuts[:-1], cuts[1:], edges, strict=True):
        counted = np.bincount(cell[low:high], minlength=shape[0] * shape[1]).reshape(shape)
        picture = np.minimum(counted, 65_535).astype(np.uint16)
        form = to.rr.components.ImageFormat(
            width=shape[1], height=shape[0], color_model="L", channel_datatype="U16"
        )
        columns = to.rr.Image.columns(buffer=[picture.tobytes()], format=[form])
        to.send(f"{path}/counts", np.array([edge], np.int64), columns, "event_pictures")


def _frames(to: _Columns, subject: Subject, arrays: Arrays) -> None:
    recording = subject.recording
    if recording.frame_source == "none":
        return
    time_ns = recording.frame_times()
    _pictures(to, recording, FRAMES_KIND, "camera", "frames")
    places, plate = arrays.get("xy_px"), arrays.get("plate_px")
    if places is None and recording.has_tracks:
        tracks = recording.tracks()
        places, plate = tracks.markers_px, tracks.plate_px
    if places is not None:
        _markers(to, "camera/markers", time_ns, places)
        to.sent["tracked_frames"] = len(places)
    if plate is not None:
        _markers(to, "camera/plate", time_ns, plate[:, None])


def _markers(to: _Columns, path: str, time_ns: I64, places: Any) -> None:
    """Send positions of markers that were seen, a row a frame; the class is the marker's number."""
    seen = np.isfinite(places).all(axis=2)
    numbers = np.broadcast_to(np.arange(places.shape[1], dtype=np.uint16), seen.shape)[seen]
    columns = [
        *to.rr.Points2D.columns(
            positions=places[seen].astype(np.float32), class_ids=numbers
        ).partition(seen.sum(axis=1))
    ]
    to.send(path, time_ns, columns)


def _arm(to: _Columns, subject: Subject) -> None:
    recording = subject.recording
    with recording.open() as reader:
        poses = reader.poses()
    if not len(poses):
        return
    time_ns = np.asarray(recording.clock("arm").to_reference(poses.t_ns))
    turned = np.deg2rad(poses.rotvec_deg)
    angle = np.linalg.norm(turned, axis=1)
    axis = np.divide(turned, angle[:, None], out=np.zeros_like(turned), where=angle[:, None] > 0)
    half = np.concatenate([axis * np.sin(angle / 2)[:, None], np.cos(angle / 2)[:, None]], axis=1)
    columns = to.rr.Transform3D.columns(translation=poses.xyz_mm, quaternion=half)
    to.send("arm/tool", time_ns, columns, "poses")
    to.once("arm/tool/axes", to.rr.TransformAxes3D(axis_length=10.0))
    to.once("arm/path", to.rr.LineStrips3D([poses.xyz_mm]))
    for name, values in zip("xyz", poses.xyz_mm.T, strict=True):
        to.scalars(f"arm/{name}_mm", time_ns, values)


def _pulses(to: _Columns, subject: Subject) -> None:
    recording = subject.recording
    with recording.open() as reader:
        seen = {name: reader.pulses(f"{name}_pulses") for name in ("sync", "event", "arm")}
    seen["event"], seen["arm"] = (
        np.asarray(recording.clock(device).to_reference(seen[name]))
        if len(seen[name])
        else seen[name]
        for name, device in (("event", "events"), ("arm", "arm"))
    )
    for height, (name, title) in enumerate(
        (("sync", "sync_box"), ("event", "events"), ("arm", "arm"))
    ):
        path = f"pulses/{title}"
        to.once(path, to.rr.SeriesPoints(markers="up", names=title))
        to.scalars(path, seen[name], np.full(len(seen[name]), float(height)), f"pulses_{title}")


def _forces(to: _Columns, subject: Subject) -> None:
    """Send forces on the plate, if the trial has any."""
    if not has_forces(subject.recording):
        return
    found = plate_forces(subject.recording)
    to.scalars("force/normal", found.t_ns, found.normal_n, "forces")
    to.scalars("force/tangential", found.t_ns, found.tangential_n)
    for axis, values in zip("xy", found.force_n[:, :2].T, strict=True):
        to.scalars(f"force/{axis}", found.t_ns, values)


def _onsets(to: _Columns, subject: Subject, label: TrialLabel | None, key: str) -> None:
    recording = subject.recording
    known: dict[str, tuple[int | None, int | None]] = {
        "label": (None, None) if label is None else (label.incipient_ns, label.gross_ns)
    }
    decision = review.last(subject.store, subject.item.name, subject.trial)
    if decision is not None and state_of(decision, key) in {"accepted", "adjusted"}:
        known["review"] = (decision.new.incipient_ns, decision.new.gross_ns)
    truth = recording.simulation_truth()
    if truth is not None:
        known["truth_simulated"] = (truth.get("incipient_ns"), truth.get("gross_ns"))
    start, _ = recorded_span(recording)
    times, texts = [], []
    for name, onsets in known.items():
        both = zip(("incipient", "gross"), onsets, strict=True)
        there = [(t, kind) for kind, t in both if t is not None]
        curve = np.array([start, *(t for t, _ in there)], np.int64)
        to.scalars(f"onsets/{name}", curve, [0, *(1 + (k == "gross") for _, k in there)])
        to.once(f"onsets/{name}", to.rr.SeriesLines(names=name.replace("_", " ")))
        for time, kind in there:
            times.append(time)
            texts.append(f"{kind} onset: {name.replace('_', ', ')}")
    if decision is not None:
        to.once("review", to.rr.TextDocument(f"{decision}: {state_of(decision, key)}"))
    order = np.argsort(times, kind="stable")
    columns = to.rr.TextLog.columns(text=[texts[i] for i in order])
    to.send("onset_log", np.asarray(times, np.int64)[order], columns, "onsets")


def _network(to: _Columns, subject: Subject) -> None:
    """Send spike counts, if the trial was evaluated."""
    counted = Derived.of(subject.store, COUNTS, subject.item.name)
    if counted.key(subject.trial) is None:
        return
    arrays = counted.arrays(subject.trial)
    for name, values in zip(CLASSES, arrays["counts"].T, strict=True):
        to.scalars(f"network/{name}", arrays["end_ns"], values)
    to.sent["windows"] = len(arrays["end_ns"])


def blueprint(
    library: ModuleType, *, forces: bool = False, further: Mapping[str, str] | None = None
) -> Any:
    """Arrange the viewer; with a panel of the forces, where there are any.

    Args:
        further: kinds of the streams of further devices by name, each of which gets a panel.
    """
    views = library.blueprint
    force = [("force", "force on the plate (N)")] if forces else []
    cameras = _named(further, FRAMES_KIND, EVENTS_KIND)
    curves_of = [name for name in sorted(further or {}) if name not in cameras]
    curves = [
        views.TimeSeriesView(origin=f"/{path}", name=name)
        for path, name in (
            ("displacement", "displacement (px)"),
            ("events/rate", "events (1/s)"),
            ("onsets", "onsets: 1 incipient, 2 gross"),
            ("network", "network, spikes a window"),
            *force,
            ("pulses", "sync pulses"),
            *((f"streams/{name}", name) for name in curves_of),
        )
    ]
    pictures = [
        views.Spatial2DView(origin="/camera", name="outside camera, markers"),
        views.Spatial2DView(origin="/events", name="events"),
        views.Spatial3DView(origin="/arm", name="arm (mm)"),
        *(views.Spatial2DView(origin=f"/streams/{name}", name=name) for name in cameras),
    ]
    words = views.Horizontal(
        views.TextDocumentView(origin="/trial"), views.TextLogView(origin="/onset_log")
    )
    return views.Blueprint(
        views.Vertical(
            views.Horizontal(*pictures), views.Vertical(*curves), words, row_shares=[4, 5, 1]
        ),
        views.TimePanel(timeline=TIMELINE),
        collapse_panels=True,
    )


def _named(further: Mapping[str, str] | None, *kinds: str) -> list[str]:
    """Return the names of the streams of some kinds."""
    return [name for name, kind in sorted((further or {}).items()) if kind in kinds]
