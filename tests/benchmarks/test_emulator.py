"""Loading and driving v2e's emulator class, tested with a fake package of the same names."""

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from benchmarks.emulator import FRAME_NS, SOURCE, draw, emulate, find_emulator
from sliplab.plugins.simulation.scene.events import EventOptics, MarkerSensor

OPTICS = EventOptics(width=160, height=120, noise_hz=0.0, hot_pixels=0, readout_hz=0.0)
LAYOUT = np.array([[-2.5, 0.0], [2.0, 1.0]])
PACKAGE = '''
import numpy as np


class EventEmulator:
    """Events of the crossings between two frames, all of them at the later one."""

    def __init__(self, *, pos_thres, neg_thres, sigma_thres, cutoff_hz, leak_rate_hz,
                 shot_noise_rate_hz, refractory_period_s, output_width, output_height, device):
        assert (sigma_thres, cutoff_hz, leak_rate_hz, shot_noise_rate_hz) == (0, 0, 0, 0)
        assert (output_width, output_height, device) == (160, 120, "cpu")
        self.memory = None

    def generate_events(self, frame, t_s):
        level = np.log(frame)
        if self.memory is None:
            self.memory = level
            return None
        threshold = self.pos_thres.numpy()
        steps = np.trunc((level - self.memory) / threshold)
        self.memory = self.memory + steps * threshold
        y, x = np.nonzero(steps)
        if not len(y):
            return None
        events = np.column_stack([np.full(len(y), t_s), x, y, np.sign(steps[y, x])])
        return np.repeat(events, np.abs(steps[y, x]).astype(int), axis=0)
'''


@pytest.fixture
def checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder with a package `v2ecore`, named by the variable."""
    (tmp_path / "v2ecore").mkdir()
    (tmp_path / "v2ecore" / "emulator.py").write_text(PACKAGE)
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.setenv(SOURCE, str(tmp_path))
    yield tmp_path
    for name in ("v2ecore.emulator", "v2ecore"):
        sys.modules.pop(name, None)


def circling(px_per_s: float, milliseconds: int) -> tuple[np.ndarray, np.ndarray]:
    t_ns = np.arange(milliseconds + 1, dtype=np.int64) * FRAME_NS
    turn = px_per_s / 8.0 * t_ns[:, None] * 1e-9 + np.array([0.0, 1.0])
    loads = np.zeros((len(t_ns), 2, 3))
    loads[:, :, 0], loads[:, :, 1] = 8.0 / 63.0 * np.cos(turn), 8.0 / 63.0 * np.sin(turn)
    return loads.reshape(len(t_ns), -1), t_ns


@pytest.mark.usefixtures("checkout")
def test_v2e_gets_our_frames_and_thresholds() -> None:
    """The emulator returns our events, each at the end of its frame."""
    optics = OPTICS.model_copy(update={"refractory_us": 0.0})
    loads, t_ns = circling(40.0, 400)
    sensor = MarkerSensor(optics, LAYOUT, 3)
    sensor.reset(loads[0], 1)
    exact = sensor.sense(loads, t_ns)
    path = np.ascontiguousarray(sensor.path(loads).transpose(2, 0, 1))
    found = emulate(find_emulator(), path, optics, sensor.threshold)
    assert [column.dtype for column in found] == [np.int64, np.uint16, np.uint16, np.uint8]
    assert np.all(np.diff(found[0]) >= 0)
    assert len(exact[0]) > 2000
    # in single precision a level that is just met is met a frame later
    ours = np.lexsort((exact[0], exact[3], exact[2], exact[1]))
    theirs = np.lexsort((found[0], found[3], found[2], found[1]))
    assert len(found[0]) == pytest.approx(len(exact[0]), rel=0.01)
    keys = [
        {tuple(key) for key in np.column_stack([each[1], each[2], each[3]]).tolist()}
        for each in (exact, found)
    ]
    assert len(keys[0] & keys[1]) > 0.99 * len(keys[0])
    if len(ours) == len(theirs):
        late = found[0][theirs] - exact[0][ours]
        assert 0 <= np.percentile(late, 5) <= np.percentile(late, 95) <= FRAME_NS


def test_without_v2e_its_rows_are_left_out(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delenv(SOURCE, raising=False)
    monkeypatch.setitem(sys.modules, "v2ecore", None)
    assert find_emulator() is None
    assert "v2e was not found, its rows are left out" in capsys.readouterr().err


def test_a_folder_without_v2e_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(SOURCE, str(tmp_path))
    with pytest.raises(ValueError, match=r"must be a folder with v2ecore/emulator\.py in it"):
        find_emulator()


def test_what_v2e_needs_and_is_not_there_is_named(checkout: Path) -> None:
    (checkout / "v2ecore" / "emulator.py").write_text("import no_such_thing\n")
    with pytest.raises(ValueError, match="No module named 'no_such_thing'"):
        find_emulator()


def test_discs_are_white_on_their_ground() -> None:
    picture = np.empty((120, 160))
    draw(np.array([[80.0, 60.0, 17.0]]), 2.08, 0.8, picture)
    assert picture[60, 80] == 255.0
    assert picture[0, 0] == pytest.approx(255.0 * np.exp(-2.08))
    # on the rim the log intensity is half the contrast
    assert picture[60, 97] == pytest.approx(255.0 * np.exp(-1.04))
