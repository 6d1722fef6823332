"""Windows of a frame-only sensor: displacement of the markers over the last few frames.

Each frame ends one window. Displacements count from the start of the hold, as labels do, so a
window needs nothing that comes after it but the correction of a knocked camera.

A slide to the left is as good as one to the right, and slip at one side of the rim as good as at
the other. So displacements are turned into the direction in which the markers moved on average,
and the markers are sorted by how far they moved: a network trained on a few directions, and on
slides, then generalises to all others, and to falling plates.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sliplab.analysis.campaigns import Collected, kinematic_campaigns
from sliplab.analysis.labels.places import TRACKS_PLATE_PX, Places
from sliplab.analysis.labels.plane import plane_of
from sliplab.analysis.labels.plate_tracking import PlateTrack
from sliplab.analysis.labels.rest import offsets
from sliplab.analysis.labels.reviewed import StoreLabels
from sliplab.analysis.metrics.classification import GROSS, INCIPIENT, NO_SLIP
from sliplab.analysis.windows.dataset import TrialId
from sliplab.protocols.hashing import hash_integer
from sliplab.storage.schema.label import LABELS
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import StoreError

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]
I64 = npt.NDArray[np.int64]

VERSION = 1
FRAMES = 5
"""Frames of a window: what the newest one shows, and how it came about."""


@dataclass(frozen=True)
class MarkerSamples:
    """Labelled windows of some trials.

    Attributes:
        x: (n, FRAMES, m, 2) px; see `cut_frames`.
        y: (n,) classes 0 no slip, 1 incipient, 2 gross, of the newest frame.
        trial: (n,) each sample's trial by its index in `trials`.
        newest_ns: (n,) middle of exposure of the newest frame, on the trial's time line.
    """

    x: F32
    y: I64
    trial: I64
    newest_ns: I64
    trials: tuple[TrialId, ...]

    def __len__(self) -> int:
        return len(self.y)


def marker_displacements(
    labels: StoreLabels, item: Collected, recording: Recording
) -> tuple[I64, F64]:
    """Return the displacement of a labelled trial's markers from the start of the hold.

    The markers' places are those that the label was read from; the video is not tracked again.

    Returns:
        times of the frames (n,) ns on the time line, and (n, m, 2) px: the place where a marker was
        last seen, and 0 before it was first seen.

    Raises:
        FileNotFoundError: the trial was never labelled.
    """
    stored = Derived.of(labels.store, LABELS, item.name).arrays(recording.folder.name)
    if "xy_px" not in stored:
        raise StoreError(
            f"{item.name}: {recording.trial_id}: its label came with the recording, so no markers "
            "were tracked, which the classifier on frames needs"
        )
    plate, plane = None, None
    if "plate_px" in stored:
        corners, seen = stored["plate_corners_px"].astype(np.float64), stored["plate_seen"]
        sigma = np.where(np.isfinite(stored["plate_px"]).all(axis=1), TRACKS_PLATE_PX, np.nan)
        plate = PlateTrack(stored["plate_px"].astype(np.float64), corners, seen, sigma)
        if recording.has_video:
            width, height = recording.frame_px[:2]
            plane = plane_of(corners, seen, (width, height))
    places = Places(
        stored["xy_px"].astype(np.float64),
        stored["sigma_px"].astype(np.float64),
        stored["quality"] / 100,
        plate,
        plane,
    )
    frame_ns: I64 = stored["frame_ns"]
    found = offsets(places, frame_ns, recording.motion_ns[0], item.settings.labelling.reference_ms)
    return frame_ns, _held(found.counted_from("hold_start"))


def _held(away: F64) -> F64:
    """Fill what was not seen with what was seen last."""
    seen = np.isfinite(away).all(axis=2)
    rows = np.where(seen, np.arange(len(away))[:, None], -1)
    last = np.maximum.accumulate(rows, axis=0)
    filled: F64 = np.where((last >= 0)[..., None], away[last, np.arange(away.shape[1])], 0.0)
    return filled


def cut_frames(displacement: F64, newest: I64) -> F32:
    """Return windows that end with given frames, each in its own direction and order.

    Args:
        displacement: (n, m, 2) px.
        newest: (k,) indices of frames, each at least ``FRAMES - 1``.

    Returns:
        (k, FRAMES, m, 2) float32 px: along the mean displacement of the newest frame, and across
        it to the left; of the marker that moved furthest in the newest frame first.
    """
    windows = displacement[newest[:, None] + np.arange(1 - FRAMES, 1)]
    last = windows[:, -1]
    order = np.argsort(-np.hypot(last[..., 0], last[..., 1]), axis=1, kind="stable")
    windows = np.take_along_axis(windows, order[:, None, :, None], axis=2)
    mean = last.mean(axis=1)
    length = np.hypot(mean[:, 0], mean[:, 1])
    unit = np.where(length[:, None] > 0, mean / np.where(length > 0, length, 1.0)[:, None], (1, 0))
    c, s = unit.T[..., None, None]
    along = c * windows[..., 0] + s * windows[..., 1]
    across = c * windows[..., 1] - s * windows[..., 0]
    return np.stack([along, across], axis=-1).astype(np.float32)


def all_frames(displacement: F64) -> tuple[F32, I64]:
    """Return the windows of all frames that end one, and the indices of these frames."""
    newest = np.arange(FRAMES - 1, len(displacement))
    return cut_frames(displacement, newest), newest


def choose_frames(
    frame_ns: I64, incipient_ns: int | None, gross_ns: int | None, per_class: int, seed: int
) -> dict[int, I64]:
    """Return the frames of one trial that end a sample, by class.

    As for windows of events: no slip is the last `per_class` frames before the incipient onset,
    gross the first ones from the gross onset on, and incipient random ones between. Without a
    gross onset only no slip is certain, without an incipient onset nothing is.

    Args:
        frame_ns: (n,) ascending. per_class: at most so many of each class.
        seed: of the random frames (PCG64).

    Returns:
        class to ascending indices; all three keys are always there.

    Raises:
        ValueError: `per_class` is not positive.
    """
    if per_class <= 0:
        raise ValueError(f"per_class = {per_class}: must be positive")
    none = np.empty(0, np.int64)
    chosen = {NO_SLIP: none, INCIPIENT: none, GROSS: none}
    if incipient_ns is None:
        return chosen
    newest = np.arange(FRAMES - 1, len(frame_ns))
    times = frame_ns[FRAMES - 1 :]
    chosen[NO_SLIP] = newest[times < incipient_ns][-per_class:]
    if gross_ns is None:
        return chosen
    chosen[GROSS] = newest[times >= gross_ns][:per_class]
    between = newest[(times >= incipient_ns) & (times < gross_ns)]
    if len(between) > per_class:
        rng = np.random.Generator(np.random.PCG64(seed))
        between = np.sort(rng.choice(between, per_class, replace=False))
    chosen[INCIPIENT] = between
    return chosen


def load_marker_samples(
    labels: StoreLabels, campaigns: list[Collected], split: str
) -> MarkerSamples:
    """Return the samples of all trials of one split of the kinematic campaigns.

    Raises:
        StoreError: two trials have different numbers of markers.
    """
    x: list[F32] = []
    y: list[I64] = []
    trial: list[I64] = []
    times: list[I64] = []
    names: list[TrialId] = []
    for item in kinematic_campaigns(campaigns):
        for known, recording in item.of_split(split):
            frame_ns, displacement = marker_displacements(labels, item, recording)
            label = labels.read(item, recording)
            chosen = choose_frames(
                frame_ns,
                label.incipient_ns,
                label.gross_ns,
                item.settings.samples.per_class,
                hash_integer("samples", known.id),
            )
            for name, newest in sorted(chosen.items()):
                x.append(cut_frames(displacement, newest))
                y.append(np.full(len(newest), name, np.int64))
                trial.append(np.full(len(newest), len(names), np.int64))
                times.append(frame_ns[newest])
            names.append(TrialId(item.name, known.id))
    _check_alike(x, names)
    none = np.empty(0, np.int64)
    return MarkerSamples(
        np.concatenate(x) if x else np.empty((0, FRAMES, 0, 2), np.float32),
        np.concatenate([none, *y]),
        np.concatenate([none, *trial]),
        np.concatenate([none, *times]),
        tuple(names),
    )


def _check_alike(x: Sequence[F32], names: Sequence[TrialId]) -> None:
    for place, part in enumerate(x):
        if part.shape[2] != x[0].shape[2]:
            known = names[place // 3]
            raise StoreError(
                f"{known.campaign}: {known.trial} has {part.shape[2]} markers and "
                f"{names[0].trial} has {x[0].shape[2]}; one network needs as many in every trial"
            )
