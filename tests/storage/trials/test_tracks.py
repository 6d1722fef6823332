"""Tracks in place of a video: every row comes back, and verify holds them against the frames."""

from pathlib import Path

import h5py
import hdf5plugin  # noqa: F401  (registers the filters)
import numpy as np
import pytest

from sliplab.storage.errors import StoreError
from sliplab.storage.files import read_json, write_json
from sliplab.storage.schema.trial import Provenance
from sliplab.storage.streams import FrameChunk
from sliplab.storage.trials.catalogue import catalogue
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import Campaign, TrialStore
from sliplab.storage.trials.verify import verify
from tests.storage.trial_files import FRAME, campaign, commit, fill, record


def tracks(count: int, plate: bool, start: int = 0, seed: int = 0) -> FrameChunk:
    """Random places of three markers and perhaps a plate; one marker is lost now and then."""
    rng = np.random.default_rng(seed)
    markers = rng.uniform(0, 800, (count, 3, 2)).astype(np.float32)
    markers[::4, 1] = np.nan
    times = (start + np.arange(count, dtype=np.int64)) * 10_000_000
    return FrameChunk(
        np.empty((count, 0, 0), np.uint8),
        start + np.arange(count, dtype=np.int64),
        times,
        times,
        np.ones(count, np.uint8),
        markers,
        rng.uniform(0, 800, (count, 2)).astype(np.float32) if plate else None,
    )


def take(where: Campaign, trial: str, chunks: list[FrameChunk], *, spool: bool = False) -> Path:
    """A committed trial whose frames are these."""
    writer = where.begin(trial, FRAME, 100, spool=spool)
    writer.add("frames", chunks[0])
    for chunk in chunks[1:]:
        writer.add("frames", chunk)
    fill(writer, with_frames=False)
    frames = sum(map(len, chunks))
    counts = {"events": 1000, "frames": frames, "poses": 10, "pulses": 10}
    return writer.commit(record(trial, counts=counts), Provenance())


@pytest.mark.parametrize("plate", [False, True])
@pytest.mark.parametrize("spool", [False, True])
def test_tracks_come_back_as_they_came(plate: bool, spool: bool, tmp_path: Path) -> None:
    where = campaign(tmp_path / "s")
    # over a chunk's 1,024 rows, in pieces that do not divide it
    chunks = [tracks(700, plate, 0, 1), tracks(700, plate, 700, 2), tracks(3, plate, 1400, 3)]
    recording = Recording(take(where, "t", chunks, spool=spool))
    assert not recording.has_video
    assert recording.has_tracks
    assert recording.frame_source == "tracks"
    assert not (recording.folder / "frames.mkv").exists()
    found = recording.tracks()
    sent = [chunk.markers_px for chunk in chunks if chunk.markers_px is not None]
    assert np.array_equal(found.markers_px, np.concatenate(sent), equal_nan=True)
    if plate:
        sent = [chunk.plate_px for chunk in chunks if chunk.plate_px is not None]
        assert found.plate_px is not None
        assert np.array_equal(found.plate_px, np.concatenate(sent))
    else:
        assert found.plate_px is None
    assert np.array_equal(recording.frame_times(), np.arange(1403) * 10_000_000)
    assert verify(TrialStore.open(tmp_path / "s")) == []


def test_a_plate_that_comes_late_or_goes_leaves_gaps_and_no_shift(tmp_path: Path) -> None:
    where = campaign(tmp_path / "s")
    chunks = [tracks(5, False), tracks(4, True, 5), tracks(3, False, 9), tracks(2, True, 12)]
    recording = Recording(take(where, "t", chunks))
    plate = recording.tracks().plate_px
    assert np.isfinite(plate[:, 0]).tolist() == [False] * 5 + [True] * 4 + [False] * 3 + [True] * 2
    assert np.array_equal(plate[5:9], chunks[1].plate_px)
    assert verify(TrialStore.open(tmp_path / "s")) == []


def test_the_same_tracks_are_the_same_bytes_and_units_are_said(tmp_path: Path) -> None:
    sums = []
    for name in "ab":
        folder = take(campaign(tmp_path / name), "t", [tracks(20, True)])
        sums.append(read_json(folder / "checksums.json"))
    assert sums[0] == sums[1]
    with h5py.File(folder / "data.h5") as file:
        for name in ("tracks/markers", "tracks/plate"):
            assert file[name].attrs["unit"].startswith("px")


def test_the_catalogue_says_what_there_is(where: Campaign, tmp_path: Path) -> None:
    commit(where, "a")
    take(where, "b", [tracks(20, False)])
    table = catalogue(TrialStore.open(tmp_path / "s"))
    assert list(table["frame_source"]) == ["video", "tracks"]
    assert list(table["frames"]) == [12, 20]


def test_what_is_not_there_is_said(where: Campaign) -> None:
    with pytest.raises(ValueError, match="contains no tracks"):
        Recording(commit(where, "a")).tracks()


@pytest.mark.parametrize("name", ["tracks/markers", "tracks/plate"])
def test_tracks_that_are_not_as_many_as_frames_are_damage(tmp_path: Path, name: str) -> None:
    recording = Recording(take(campaign(tmp_path / "s"), "t", [tracks(20, True)]))
    _damage(recording.folder, name, 19)
    with pytest.raises(StoreError, match=f"{name} has 19 rows, and there are 20 frames"):
        recording.tracks()


def _damage(folder: Path, name: str, rows: int) -> None:
    """Cut or delete a column, and mend size and checksum."""
    from sliplab.storage.files import sha256

    path = folder / "data.h5"
    with h5py.File(path, "a") as file:
        if rows:
            file[name].resize(rows, axis=0)
        else:
            del file[name]
    sums = read_json(folder / "checksums.json")
    sums["data.h5"] = {"sha256": sha256(path), "bytes": path.stat().st_size}
    write_json(folder / "checksums.json", sums)


@pytest.mark.parametrize(
    ("name", "rows", "says"),
    [
        ("tracks/markers", 19, "19 rows of tracks/markers, not 20"),
        ("tracks/plate", 3, "3 rows of tracks/plate, not 20"),
        ("tracks/markers", 0, "has frames, but neither video nor tracks"),
    ],
)
def test_verify_sees_tracks_that_do_not_fit_their_frames(
    name: str, rows: int, says: str, tmp_path: Path
) -> None:
    where = campaign(tmp_path / "s")
    _damage(take(where, "t", [tracks(20, True)]), name, rows)
    assert [problem.what for problem in verify(TrialStore.open(tmp_path / "s"))] == [says]
