"""`sliplab calibrate detector` from end to end, and the detector that its document makes."""

from __future__ import annotations

from datetime import date
from pathlib import Path
from typing import Any

import pytest

from sliplab.analysis.detectors.papillae import LEAST, VERSION
from sliplab.analysis.detectors.skin import calibrated, load_calibration
from sliplab.flows.running import exit_codes
from sliplab.protocols import InputError
from sliplab.storage.files import read_json, write_json
from sliplab.storage.schema.detector import DetectorCalibration
from tests.command_line import answer, here
from tests.docs.nonsense import check_refusals, checker
from tests.flows.calibrating.test_calibrate import lab, stopped_after

QUICK = ("--hold", 5, "--yes")


@pytest.fixture(scope="module")
def document(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Made on the simulated rig."""
    out = tmp_path_factory.mktemp("skin") / "skin.json"
    answer("calibrate", "detector", "--rig", "mock", "--out", out, *QUICK)
    return out


def test_it_writes_what_this_skin_is(document: Path) -> None:
    found = load_calibration(document)
    assert (found.rig, found.skin, found.simulated) == ("mock", "simulated-1", True)
    assert found.measured == date.today().isoformat()
    assert (found.width_px, found.height_px, found.cell_px) == (640, 480, 8)
    assert len(found.places) >= 19, "one for each papilla at least"
    assert found.hold.hours == pytest.approx(5 / 3600, rel=0.05)
    assert found.hold.high == pytest.approx(3.689 / found.hold.hours, rel=1e-3)
    assert found.level >= max(LEAST, found.hold_largest, found.unload_largest)
    assert [rub.direction_deg for rub in found.rubs] == [0.0, 120.0, 240.0]
    late = [rub.alarm_ms for rub in found.rubs if rub.alarm_ms is not None]
    assert len(late) >= 2
    assert all(0 < ms < 1000 for ms in late)
    made = calibrated(found)
    assert made.settings.hot == found.hot
    with pytest.raises(ValueError, match="the sensor has 320 x 240 pixels"):
        made.begin(320, 240)


def test_the_document_has_a_schema(document: Path) -> None:
    data = read_json(document)
    assert not list(checker("detector").iter_errors(data))
    assert DetectorCalibration.parse(data, document).to_json() == data
    assert check_refusals("detector", document, every=False) > 25


@pytest.mark.long
def test_it_says_what_so_much_holding_supports(tmp_path: Path) -> None:
    (tmp_path / "mock.detector.json").write_text("the old one")
    done = here("calibrate", "detector", "--rig", "mock", *QUICK, cwd=tmp_path)
    assert done.returncode == 0
    said = " ".join(done.stdout.split())
    assert "detector of rig mock (simulated)" in said
    assert "1 an hour takes 3.69 h (--hold)" in said
    assert load_calibration(tmp_path / "mock.detector.json").rig == "mock"
    old = tmp_path / f"mock.detector.before-{date.today().isoformat()}.json"
    assert old.read_text() == "the old one"
    assert f"the old file is kept as {old}" in " ".join((done.stdout + done.stderr).split())


@pytest.mark.usefixtures("no_rig")
def test_a_dry_run_lists_the_motion_and_moves_nothing() -> None:
    moves = answer("calibrate", "detector", "--rig", "mock", "--dry-run")["moves"]
    assert [move["what"] for move in moves] == ["press", "unload", "rub 1", "rub 2", "rub 3"]


@pytest.mark.usefixtures("no_rig")
@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("--depth", 5), "--depth = 5: is more than the rig may: limits.depth = 4"),
        (("--rub", 16), "limits.reach = 15"),
        (("--out", "skin.yaml"), "must end in .json"),
        (("--out", "nowhere/skin.json"), "its folder does not exist"),
        (("--rig", "mock_frames"), "needs an event camera, and the rig mock-frames has none"),
    ],
)
def test_wrong_input_moves_nothing(arguments: tuple[object, ...], says: str) -> None:
    done = here("calibrate", "detector", "--rig", "mock", *arguments, *QUICK)
    assert done.returncode == exit_codes.WRONG_INPUT
    assert says in " ".join(done.stderr.split())


def test_a_stop_leaves_the_arm_at_rest_and_clear(tmp_path: Path) -> None:
    out = tmp_path / "skin.json"
    words = ("calibrate", "detector", "--rig", lab(tmp_path), "--out", out, *QUICK)
    rig, left = stopped_after(400, *words)
    assert left == 0, "it had begun to hold"
    assert rig.arm.progress().done
    assert rig.position().depth_mm <= -4.9
    assert not out.exists()


@pytest.mark.long
def test_a_skin_that_was_not_seen_writes_nothing(tmp_path: Path) -> None:
    out = tmp_path / "skin.json"
    shallow = ("--depth", 0.2, "--rub", 0.5)
    done = here("calibrate", "detector", "--rig", "mock", "--out", out, *shallow, *QUICK)
    assert done.returncode == exit_codes.FAILED
    assert "nothing was written" in done.stderr
    assert not out.exists()


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"detector": "rate"}, "detector = rate: must be papillae"),
        ({"version": 99}, f"version = 99: must be {VERSION}"),
        ({"level": "high"}, "level"),
        ({"format": 2}, "newer version"),
        ({"level": 1e9}, "level = .*: must be 12, of hold and unload"),
        ({"level": -5.0}, "level = -5"),
        ({"hot": [4800]}, "hot = .*must be from 0 to 4799"),
        ({"places": []}, "places = 0: some must have moved"),
        ({"fewest_places": 0}, "fewest_places = 0"),
        ({"cell_px": 0}, "cell_px = 0"),
        ({"measured": "lately"}, "measured = lately: must be a day"),
    ],
)
def test_a_document_of_another_kind_is_refused(
    document: Path, tmp_path: Path, change: dict[str, Any], says: str
) -> None:
    other = tmp_path / "other.json"
    write_json(other, {**read_json(document), **change})
    with pytest.raises(InputError, match=says):
        load_calibration(other)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"high": 0.001}, "hold.high = 0.001: so many hours without an alarm show "),
        ({"hours": 1e9, "high": 3.7e-9}, "hold.hours = 1000000000.*at most 10.1"),
        ({"hours": 0.0}, "hold.hours = 0"),
    ],
)
def test_a_promise_that_the_hold_does_not_show_is_refused(
    document: Path, tmp_path: Path, change: dict[str, float], says: str
) -> None:
    other, found = tmp_path / "other.json", read_json(document)
    write_json(other, {**found, "hold": {**found["hold"], **change}})
    with pytest.raises(InputError, match=says):
        load_calibration(other)


@pytest.mark.long  # simulated above; a trial through these drivers is in `test_loopback`
@pytest.mark.realtime
def test_it_runs_on_the_real_drivers(tmp_path: Path) -> None:
    out = tmp_path / "skin.json"
    answer("calibrate", "detector", "--rig", "loopback", "--out", out, *QUICK)
    found = load_calibration(out)
    assert found.simulated
    assert any(rub.alarm_ms is not None for rub in found.rubs)
