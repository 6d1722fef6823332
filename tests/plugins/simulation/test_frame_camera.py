"""The frame camera's two levels: the same times, and tracks as good as tracking the video."""

from typing import Any

import numpy as np
import pytest

from sliplab.analysis.labels.plate_tracking import track_video
from sliplab.plugins.simulation import physics
from sliplab.plugins.simulation.devices import MockDevices, build_mock
from sliplab.plugins.simulation.scene.frames import FrameOptics, PlateView
from sliplab.plugins.simulation.settings import MockFrameCameraSettings, MockSettings
from sliplab.rigs.core.capabilities import Segment
from sliplab.storage.streams import FrameChunk

SIZE = 832


def rig(**camera: Any) -> MockDevices:
    """A connected rig, its skin 2.6 mm deep in the plate."""
    devices = build_mock(MockSettings(frame_camera=MockFrameCameraSettings(**camera)))
    devices.arm.connect()
    devices.begin_trial(7)
    return devices


def reach(devices: MockDevices, x_mm: float, depth_mm: float, speed_mm_s: float) -> None:
    """Go there and wait until it is done."""
    devices.arm.start([Segment(devices.world.plane.pose(x_mm, 0, depth_mm), speed_mm_s)])
    while not devices.arm.progress().done:
        devices.clock.wait(0.05)


def grab(devices: MockDevices, seconds: float, chunk_s: float, size: int = SIZE) -> FrameChunk:
    """Slide at 5 mm/s and read frames every so often; all of them as one chunk."""
    devices.frames.set_region(size, size)
    devices.frames.start()
    devices.sync.start(100.0, 4321)
    devices.arm.start([Segment(devices.world.plane.pose(5.0 * seconds, 0, 2.6), 5.0)])
    chunks = []
    for _ in range(round(seconds / chunk_s)):
        devices.clock.wait(chunk_s)
        chunks.append(devices.frames.read())
    devices.frames.stop()
    devices.clock.wait(0.1)
    chunks.append(devices.frames.read())
    return FrameChunk.concatenate(chunks)


def slide(chunk_s: float = 0.1, size: int = SIZE, **camera: Any) -> tuple[MockDevices, FrameChunk]:
    """A whole slide of 0.4 s."""
    devices = rig(**camera)
    reach(devices, 0.0, 2.6, 20.0)
    return devices, grab(devices, 0.4, chunk_s, size)


def test_both_levels_have_the_same_times_and_only_one_has_pictures() -> None:
    _, video = slide(size=320)
    _, tracks = slide(level="tracks")
    for name in ("number", "t_ns", "host_ns", "sync"):
        assert np.array_equal(getattr(video, name), getattr(tracks, name))
    assert len(video) >= 40
    assert video.images.shape == (len(video), 320, 320)
    assert video.markers_px is None
    assert tracks.images.shape == (len(tracks), 0, 0)
    assert tracks.markers_px.shape == (len(tracks), 19, 2)
    assert tracks.markers_px.dtype == np.float32
    assert tracks.plate_px is None


@pytest.mark.parametrize("level", ["video", "tracks"])
def test_how_it_is_read_changes_nothing(level: str) -> None:
    name = "images" if level == "video" else "markers_px"
    once, often = (slide(chunk_s, 320, level=level)[1] for chunk_s in (0.4, 0.02))
    assert np.array_equal(getattr(once, name), getattr(often, name), equal_nan=level == "tracks")


def test_tracks_are_where_the_video_shows_the_markers() -> None:
    devices, video = slide()
    _, tracks = slide(level="tracks")
    layout = devices.world.skin.layout_mm * 20.0 * np.array([1.0, -1.0])
    found = track_video(video.images, layout, False).markers
    assert found.ok.all()
    error = found.xy - tracks.markers_px
    # two noises of 0.0045 px
    assert np.sqrt(np.mean(error**2)) == pytest.approx(0.0045 * np.sqrt(2), rel=0.3)
    assert np.ptp(tracks.markers_px[:, :, 0], axis=0).max() > 10.0


def test_a_marker_cut_by_the_edge_is_not_seen() -> None:
    _, tracks = slide(level="tracks", size=480)
    # the outer ring is 224 px from the centre, a spot's radius is 20 px: the edge at 240 cuts it
    assert np.isnan(tracks.markers_px[:, 7]).all()
    assert np.isfinite(tracks.markers_px[:, 0]).all()


def test_a_tilted_camera_tracks_through_its_homography() -> None:
    _, straight = slide(level="tracks", centroid_noise_px=0.0)
    _, tilted = slide(level="tracks", centroid_noise_px=0.0, tilt_deg=(5.0, -3.0))
    assert tilted.markers_px is not None
    view = PlateView(FrameOptics(tilt_deg=(5.0, -3.0)), SIZE, SIZE)
    flat = straight.markers_px.astype(float)
    place_mm = (flat - 0.5 * (SIZE - 1)) / 20.0 * np.array([1.0, -1.0])
    far = np.concatenate([place_mm, np.ones((*place_mm.shape[:2], 1))], axis=2)
    seen = far @ view.lens.homography.T
    assert tilted.markers_px == pytest.approx(seen[..., :2] / seen[..., 2:], abs=1e-3)
    assert np.abs(tilted.markers_px - straight.markers_px).max() > 0.5


def test_a_released_plate_is_followed_until_it_stands_on_its_stop() -> None:
    devices = rig(level="tracks", plate_noise_px=0.0)
    devices.plate.act("raise", 0.0)
    devices.plate.act("release", 0.0)
    chunk = grab(devices, 0.4, 0.1)
    assert chunk.plate_px.shape == (len(chunk), 2)
    assert chunk.plate_px[:, 0] == pytest.approx(415.5 + 332.0, abs=1e-3)
    assert np.all(np.diff(chunk.plate_px[:, 1]) >= 0)
    # 25 mm down from 16.6 mm above the centre
    assert chunk.plate_px[-1, 1] == pytest.approx(415.5 + 20.0 * (25.0 - 16.6), abs=1e-3)


def test_a_fast_fall_is_smeared_in_the_video_and_its_mean_in_the_tracks() -> None:
    falls = []
    for level in ("video", "tracks"):
        devices = rig(level=level, plate_noise_px=0.0, noise=0.0, exposure_us=8000)
        devices.plate.act("raise", 0.0)
        devices.plate.act("release", 0.0)
        falls.append(grab(devices, 0.2, 0.1))
    video, tracks = falls
    speed = np.diff(tracks.plate_px[:, 1].astype(float))
    fast = int(np.argmax(speed > 5.0))
    image = video.images[fast][:, SIZE // 2 + 246 :]
    flanks = (
        np.abs(np.diff(image.astype(int), axis=0)).max(),
        np.abs(np.diff(image.astype(int), axis=1)).max(),
    )
    assert flanks[1] > 2 * flanks[0]  # sharp across the motion, soft along it
    # the mean grey moves as the mean place does, from the frame before
    before = video.images[0][:, SIZE // 2 + 246 :]
    rows = np.arange(SIZE)
    moved = [
        float((rows @ (part.astype(float) - 25)).sum() / (part - 25.0).sum())
        for part in (before, image)
    ]
    expected = tracks.plate_px[fast, 1] - tracks.plate_px[0, 1]
    assert moved[1] - moved[0] == pytest.approx(expected, abs=0.1)


def test_the_noise_of_tracks_is_that_of_tracking_the_video() -> None:
    settings = MockFrameCameraSettings()
    devices = build_mock(MockSettings())
    layout = devices.world.skin.layout_mm
    frames = 160
    along = np.linspace(0.0, 3.0, frames)[:, None, None] * np.array([1.0, 0.3])
    tips, plate = layout + along, -np.linspace(0.0, 1.6, frames)
    view = PlateView(FrameOptics(noise=settings.noise), SIZE, SIZE)
    images = np.empty((frames, SIZE, SIZE), np.uint8)
    view.draw(images, tips, plate, np.arange(frames), 5)
    found = track_video(images, layout * 20.0 * np.array([1.0, -1.0]), True)
    assert found.plate.ok.all()
    papilla = found.markers.xy - view.centre_px(tips)
    marker = found.plate.xy - view.marker.centre_px(plate)
    assert np.sqrt(np.mean(papilla**2)) == pytest.approx(settings.centroid_noise_px, rel=0.3)
    assert np.sqrt(np.mean(marker**2)) == pytest.approx(settings.plate_noise_px, rel=0.3)


def test_frames_that_are_read_too_late_are_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(physics, "KEPT_NS", 1_000_000_000)
    devices = rig(level="tracks")
    devices.frames.set_region(SIZE, SIZE)
    devices.frames.start()
    devices.sync.start(100.0, 4321)
    devices.clock.wait(5.0)
    number = devices.frames.read().number
    assert number[0] > 0
    assert number[-1] > 490
    assert (np.diff(number) == 1).all()
