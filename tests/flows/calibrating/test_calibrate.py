"""Teaching and calibrating from end to end on the simulated rig, as its commands do it."""

from __future__ import annotations

import io
import json
from dataclasses import replace
from datetime import date
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from sliplab.analysis.calibration.charuco import Board, find_corners
from sliplab.flows.calibrating import calibrate, measurement, teach
from sliplab.flows.calibrating.calibrate import PNG_PX_PER_MM, print_board
from sliplab.flows.running import exit_codes, stopping
from sliplab.protocols import InputError
from sliplab.protocols.program import Position
from sliplab.rigs.build import build_rig, taught_frame
from sliplab.rigs.core.capabilities import ArmState, Pose, RigError
from sliplab.rigs.core.plate_frame import PlateFrame
from sliplab.rigs.core.rig import Rig, StopRequested
from sliplab.rigs.core.teaching import Creep
from sliplab.rigs.rig_file import load_rig_file
from sliplab.storage.streams import FrameChunk
from tests.command_line import answer, here, sliplab
from tests.conftest import ROOT
from tests.patching import put

MOCK = (ROOT / "rigs" / "mock.yaml").read_text()
QUICK = Creep(clearance_mm=2.5, search_mm=2.0)
TRUE_PLANE = taught_frame(load_rig_file(Path("mock"))[0])
"""The shipped file's plane, which is the true one to 0.01 mm."""


def lab(
    folder: Path,
    *,
    moved_mm: float = 0.0,
    leant_mm: float = 0.0,
    level: str = "tracks",
    mock: str = "",
) -> Path:
    """A rig file whose plane lies `moved_mm` too deep, and leans by `leant_mm` over 60 mm."""
    text = MOCK.replace("400.35 mm, 0", f"{400.35 + moved_mm:.3f} mm, 0")
    text = text.replace("400.17 mm, 60", f"{400.17 + moved_mm + leant_mm:.3f} mm, 60")
    text = text.replace("400.73 mm, 0", f"{400.73 + moved_mm:.3f} mm, 0")
    path = folder / "lab.yaml"
    path.write_text(text + f"  frame_camera: {{level: {level}}}\n{mock}")
    return path


def session(path: Path, **attributes: Any) -> measurement.CalibrationSession:
    file, _ = load_rig_file(path)
    rig = build_rig(file)
    rig.connect()
    for name, value in attributes.items():
        setattr(rig, name, value)
    return measurement.CalibrationSession(file, rig, date(2026, 12, 1))


def taught(finding: measurement.MeasurementResult) -> PlateFrame:
    plane = finding.changes["calibration.contact_plane"]
    points = [
        [float(v.removesuffix(" mm")) for v in plane[k]] for k in ("centre", "right", "above")
    ]
    return PlateFrame.taught(points)


def error_of(frame: PlateFrame) -> tuple[float, float]:
    """Return a plane's error: mm within 12 mm of the centre, and degrees."""
    far = [
        TRUE_PLANE.position(frame.pose(Position(x, y, 0.0)).xyz_mm).depth_mm
        for x, y in ((0.0, 0.0), (12.0, 0.0), (0.0, 12.0), (-12.0, 0.0), (0.0, -12.0))
    ]
    turned = np.degrees(np.arccos(min(float(frame.axes[2] @ TRUE_PLANE.axes[2]), 1.0)))
    return float(np.abs(far).max()), float(turned)


@pytest.mark.long
@pytest.mark.parametrize(
    ("moved_mm", "leant_mm"),
    [
        (0.5, 1.5),
        pytest.param(-1.5, 0.0, marks=pytest.mark.long),
        pytest.param(1.2, 0.0, marks=pytest.mark.long),
        pytest.param(0.0, 0.0, marks=pytest.mark.long),
    ],
)
def test_a_wrong_plane_is_mended(tmp_path: Path, moved_mm: float, leant_mm: float) -> None:
    found = teach.teach_plane(
        session(lab(tmp_path, moved_mm=moved_mm, leant_mm=leant_mm)), 12.0, QUICK, 2
    )
    off, turned = error_of(taught(found))
    assert off < 0.12
    assert turned < 0.5
    assert found.figures["moved_mm"] == pytest.approx(-moved_mm, abs=0.08)
    assert found.figures["residual_mm"] <= teach.MOST_PLANE_MM
    assert found.remove == ("calibration.depth_zero",)


def test_a_plane_by_hand_is_found_too(tmp_path: Path) -> None:
    found = teach.teach_plane_by_hand(session(lab(tmp_path, moved_mm=8.0, leant_mm=6.0)))
    off, turned = error_of(taught(found))
    assert off < 0.15
    assert turned < 0.5
    assert found.changes["calibration.contact_plane"]["method"] == "jogged by hand and confirmed"


@pytest.mark.parametrize(
    ("right", "above", "check", "says"),
    [
        ((12, 0, 0), (-9, 0.5, 0), (3, 3, 0), "almost on one line"),
        ((2, 0, 0), (0, 12, 0), (3, 3, 0), "at least 5 mm"),
        ((12, 0, 0), (0, 12, 0), (-9, -9, 0.3), r"fourth touch is \+0.300 mm off"),
    ],
)
def test_points_that_make_no_plane_write_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, right: Any, above: Any, check: Any, says: str
) -> None:
    points = {"centre": (0, 0, 0), "right": right, "above": above, "check": check}

    def jog_poses(rig: Rig, prompts: list[tuple[str, str]]) -> list[Pose]:
        places = (points[word.removeprefix("touched ")] for _, word in prompts)
        return [TRUE_PLANE.pose(Position(*place)) for place in places]

    monkeypatch.setattr(teach, "jog_poses", jog_poses)
    with pytest.raises(RigError, match=says):
        teach.teach_plane_by_hand(session(lab(tmp_path)))


def test_depth_zero_by_both_ways_is_the_truth(tmp_path: Path) -> None:
    found = teach.teach_zero(session(lab(tmp_path, moved_mm=-0.6)), QUICK, 3, True)
    entry_ = found.changes["calibration.depth_zero"]
    assert found.figures["zero_mm"] == pytest.approx(0.6, abs=0.06)
    assert np.mean(found.figures["by_markers_mm"]) == pytest.approx(0.6, abs=0.06)
    assert abs(found.figures["difference_mm"]) < 0.1
    assert set(entry_) >= {"zero", "by_events", "by_markers", "difference", "residual", "taught"}


@pytest.mark.long
def test_a_touch_depth_that_is_wrong_is_told_by_the_markers(tmp_path: Path) -> None:
    path = lab(tmp_path)
    path.write_text(path.read_text().replace("touch_depth: 0.34 mm", "touch_depth: 0.04 mm"))
    with pytest.raises(RigError, match=r"apart. Is calibration.touch_depth = 0.04 mm right"):
        teach.teach_zero(session(path), QUICK, 1, True)
    found = teach.teach_zero(session(path), QUICK, 1, False)
    assert found.figures["by_markers_mm"] is None


def test_depth_zero_from_a_video(tmp_path: Path) -> None:
    path = lab(tmp_path, level="video")
    found = teach.teach_zero(session(path), Creep(clearance_mm=1.0, search_mm=1.0), 1, True)
    assert abs(found.figures["by_markers_mm"][0]) < 0.08


@pytest.mark.parametrize("tip", [(0.0, 0.0, 0.0), (0.8, -1.5, 3.0)])
def test_the_tip_is_found_by_pivoting(tmp_path: Path, tip: tuple[float, float, float]) -> None:
    path = lab(tmp_path, mock=f"  arm: {{tip_offset_mm: {list(tip)}}}\n")
    found = teach.teach_tool(session(path), 8, Pose((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)))
    assert np.linalg.norm(np.array(found.figures["offset_mm"]) - tip) < 0.1
    assert found.figures["residual_mm"] < 0.1
    assert found.figures["off_the_tool_set_mm"] == pytest.approx(np.linalg.norm(tip), abs=0.1)


def test_a_tool_that_the_controller_has_already_is_taken_off(tmp_path: Path) -> None:
    """Poses are those of a tool; what is found is from the flange."""
    path = lab(tmp_path, mock="  arm: {tip_offset_mm: [0.5, 0, 1]}\n")
    tool = Pose((10.0, -5.0, 80.0), (0.0, 0.0, 90.0))
    found = teach.teach_tool(session(path), 8, tool)
    # the tip in the tool's axes, turned by 90 degrees about z into the flange's
    assert np.allclose(found.figures["offset_mm"], [10.0, -5.0 + 0.5, 81.0], atol=0.1)


def test_poses_that_are_all_alike_write_nothing(tmp_path: Path) -> None:
    here = session(lab(tmp_path))
    put(here.rig.operator, "ask", lambda task, prompt, expected: True)
    with pytest.raises(RigError, match="too much alike"):
        teach.teach_tool(here, 5, Pose((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)))


def test_the_crop_is_where_the_skin_is(tmp_path: Path) -> None:
    found = calibrate.calibrate_crop(session(lab(tmp_path)), 2.4, 1.0)
    assert np.hypot(*(np.array(found.figures["centre_px"]) - [319.5, 239.5])) < 4.0
    # the outer ring's markers, and what they move
    assert 2 * (11.2 + 1.2) * 14 - 10 < found.figures["diameter_px"] < 400
    with pytest.raises(RigError, match="event camera"):
        calibrate.calibrate_crop(session(lab(tmp_path)), 0.01, 0.1)


@pytest.mark.long
def test_the_lens_of_the_simulated_camera_is_found(tmp_path: Path) -> None:
    path = tmp_path / "lab.yaml"
    path.write_text(MOCK + "  frame_camera: {k1: -0.2}\n")
    here = session(path)
    pictures = calibrate.see_boards(here, 8)
    assert len(pictures) == 8
    found = calibrate.calibrate_lens(pictures, Board(), here.today)
    assert found.figures["scale_px_per_mm"] == pytest.approx(20.0, rel=3e-4)
    assert found.figures["distortion"][0] == pytest.approx(-0.2, abs=0.02)
    assert found.changes["frame_camera.scale_px_per_mm"] == found.figures["scale_px_per_mm"]
    assert here.rig.simulation is not None
    # another size of square than was printed: the scale follows, the picture cannot tell
    large = calibrate.calibrate_lens(pictures, Board(square_mm=6.06, marker_mm=4.545), here.today)
    assert large.figures["scale_px_per_mm"] == pytest.approx(20.0 * 6.0 / 6.06, rel=3e-4)


def test_camera_that_repeats_its_image_gives_no_pictures_of_a_board(tmp_path: Path) -> None:
    path = tmp_path / "lab.yaml"
    path.write_text(MOCK)
    here = session(path)
    read, first = here.rig.frames.read, []

    def frozen() -> FrameChunk:
        chunk = read()
        first.extend(chunk.images[:1])
        images = np.repeat(first[0][None], len(chunk), 0) if first else chunk.images
        return replace(chunk, images=images)

    put(here.rig.frames, "read", frozen)
    with pytest.raises(RigError, match="frame camera: sent exactly the image of the picture befo"):
        calibrate.see_boards(here, 4)


def test_a_camera_of_tracks_has_no_pictures_of_a_board(tmp_path: Path) -> None:
    with pytest.raises(RigError, match="tracks and no images"):
        calibrate.see_boards(session(lab(tmp_path)), 4)


@pytest.mark.quick(1)
@pytest.mark.parametrize("name", ["board.png", "board.pdf"])
def test_the_printed_board_has_its_true_size(tmp_path: Path, name: str) -> None:
    sizes = print_board(Board(), tmp_path / name)
    assert (sizes["width_mm"], sizes["height_mm"]) == (66.0, 42.0)
    data = (tmp_path / name).read_bytes()
    if name.endswith("pdf"):
        assert data.startswith(b"%PDF")
        width, height = (sizes[f"page_{side}_mm"] / 25.4 * 72 for side in ("width", "height"))
        box = data.split(b"/MediaBox [")[1].split(b"]")[0].split()
        assert [float(v) for v in box[2:]] == pytest.approx([width, height], abs=0.01)
        return
    picture = cv2.imread(str(tmp_path / name), cv2.IMREAD_GRAYSCALE)
    small = cv2.resize(picture, None, fx=0.4, fy=0.4, interpolation=cv2.INTER_AREA)
    corners = find_corners(small, Board())
    assert len(corners) == 60
    places = Board().opencv().getChessboardCorners()[corners.ids][:, :2]
    across = np.ptp(corners.px, axis=0) / np.ptp(places, axis=0)
    assert np.allclose(across, 0.4 * PNG_PX_PER_MM, rtol=1e-4)
    # the file says how large a pixel is: px a metre, in the chunk pHYs
    where = data.index(b"pHYs") + 4
    assert int.from_bytes(data[where : where + 4], "big") == pytest.approx(50_000, abs=30)


def test_a_board_of_another_kind_of_file_is_refused(tmp_path: Path) -> None:
    for path in (tmp_path / "b.svg", tmp_path / "nowhere" / "b.pdf"):
        with pytest.raises(InputError):
            print_board(Board(), path)


def test_a_command_writes_and_says_what(tmp_path: Path) -> None:
    path = lab(tmp_path, moved_mm=1.0)
    before = path.read_text()
    done = here("teach", "plane", "--rig", path, "--yes", "--json", "--repeats", 1)
    assert done.returncode == 0
    data = json.loads(done.stdout)
    assert (data["simulated"], data["written"]) == (True, str(path))
    assert Path(data["kept"]).read_text() == before
    assert data["moved_mm"] == pytest.approx(-1.0, abs=0.1)
    assert "simulated" in done.stderr
    assert "mm/s" in done.stderr
    file, _ = load_rig_file(path)
    assert file.calibration.contact_plane.taught == date.today()
    done = here("teach", "zero", "--rig", path, "--yes", "--by", "events", "--repeats", 1)
    assert done.returncode == 0
    assert "zero_mm" in done.stdout
    assert load_rig_file(path)[0].calibration.depth_zero is not None
    # the zero belonged to the plane that was there
    by_hand = answer("teach", "plane", "--rig", path, "--yes", "--by", "hand")
    assert by_hand["removed"] == ["calibration.depth_zero"]
    assert load_rig_file(path)[0].calibration.depth_zero is None


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("teach", "plane", "--rig", "mock", "--yes"), "--out: is needed: mock.yaml ships"),
        (("teach", "plane", "--rig", "LAB"), "--yes: is required without a terminal"),
        (("teach", "plane", "--rig", "LAB", "--yes", "--search", 4.5), "limits.depth = 4 mm"),
        (("teach", "plane", "--rig", "LAB", "--yes", "--span", 20), "limits.reach = 15 mm"),
        (("teach", "plane", "--rig", "LAB", "--yes", "--span", 2), "at least 5 mm"),
        (("teach", "plane", "--rig", "LAB", "--yes", "--speed", 5), "--speed"),
        (("teach", "tool", "--rig", "LAB", "--yes", "--tool", "1,2"), "must be x,y,z"),
        (("calibrate", "crop", "--rig", "LAB", "--yes", "--depth", 5), "limits.depth = 4 mm"),
        (("calibrate", "lens", "--rig", "LAB", "--columns", 60), "3 to 40"),
        (("calibrate", "lens", "--rig", "LAB", "--images", "FOLDER"), "contains no .png"),
        (("calibrate", "board", "--out", "board.svg"), "must end in .pdf or .png"),
        (("teach", "plane", "--rig", "abacus"), "not one of the shipped rigs"),
    ],
)
def test_wrong_input_is_exit_2_and_moves_nothing(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    arguments: tuple[object, ...],
    says: str,
) -> None:
    path = lab(tmp_path)
    (tmp_path / "empty").mkdir()
    places = {"LAB": path, "FOLDER": tmp_path / "empty"}
    moved: list[object] = []
    monkeypatch.setattr(teach, "touch", lambda *_: moved.append(1))
    monkeypatch.setattr("sys.stdin", io.StringIO())
    done = here(*(places.get(str(a), a) for a in arguments))
    assert (done.returncode, done.stdout) == (exit_codes.WRONG_INPUT, "")
    assert says in " ".join(done.stderr.split())
    assert not moved
    assert [p.name for p in tmp_path.iterdir() if p.suffix] == ["lab.yaml"]


@pytest.mark.usefixtures("no_rig")
@pytest.mark.parametrize("what", ["plane", "zero", "tool"])
def test_a_dry_run_says_where_and_connects_to_nothing(what: str) -> None:
    data = answer("teach", what, "--rig", "mock", "--dry-run")
    assert data["dry_run"] is True
    assert len(data["moves"]) == {"plane": 4, "zero": 2, "tool": 0}[what]
    for move in data["moves"]:
        depth_mm = TRUE_PLANE.position(move["base_mm"]).depth_mm
        assert (move["to_mm"], depth_mm) == (2.0, pytest.approx(2.0, abs=0.01))
    done = here("teach", what, "--rig", "mock", "--dry-run")
    assert done.returncode == 0
    assert "dry run" in done.stdout


STOPPED = "  faults: [{kind: arm_protective_stop, trial: %d, at_s: 2, since: trial}]\n"


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"moved_mm": -6.0}, "found no plate within the hard limit"),
        ({"mock": STOPPED % 2}, "unlock the stop at the pendant"),
    ],
    ids=["no plate", "protective stop"],
)
def test_a_failed_measurement_is_exit_1_and_writes_nothing(
    tmp_path: Path, changes: dict[str, Any], says: str
) -> None:
    path = lab(tmp_path, **changes)
    before = path.read_text()
    done = here("teach", "plane", "--rig", path, "--yes")
    assert done.returncode == exit_codes.FAILED
    assert says in " ".join(done.stderr.split())
    assert path.read_text() == before
    assert [p.name for p in tmp_path.iterdir()] == ["lab.yaml"]


def stopped_after(looks: int, *words: object) -> tuple[Rig, int]:
    """Run a command with a stop after so many looks for one; return its rig, and looks left."""
    rigs: list[Rig] = []
    asked = iter([False] * looks)

    def built(file: Any, should_stop: Any) -> Rig:
        rigs.append(build_rig(file, should_stop))
        return rigs[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sliplab.rigs.build.build_rig", built)
        patch.setattr(stopping, "requested", lambda: next(asked, True))
        done = here(*words)
    assert done.returncode == exit_codes.INTERRUPTED
    assert "the arm is at rest, nothing was written" in done.stderr
    (rig,) = rigs
    return rig, len(list(asked))


def test_a_stop_in_the_middle_is_130_with_the_arm_at_rest(tmp_path: Path) -> None:
    path = lab(tmp_path)
    before = path.read_text()
    rig, _ = stopped_after(250, "teach", "plane", "--rig", path, "--yes")
    assert rig.arm.progress().done
    assert rig.position().depth_mm <= -2.9
    assert path.read_text() == before


def test_a_person_who_says_stop_ends_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def stops(*_: object) -> None:
        raise StopRequested

    monkeypatch.setattr(teach, "jog_poses", stops)
    path = lab(tmp_path)
    done = here("teach", "tool", "--rig", path, "--yes")
    assert done.returncode == exit_codes.INTERRUPTED
    assert "stopped" in done.stderr


def test_the_arm_is_asked_for_before_it_moves(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[str] = []

    class Terminal:
        def isatty(self) -> bool:
            return True

    def answer(text: str, **_: object) -> bool:
        asked.append(text)
        raise measurement.typer.Abort

    monkeypatch.setattr("sys.stdin", Terminal())
    monkeypatch.setattr(measurement.typer, "confirm", answer)
    assert here("teach", "zero", "--rig", lab(tmp_path)).returncode == exit_codes.INTERRUPTED
    assert "Move the arm?" in asked[0]


def test_the_commands_from_outside(tmp_path: Path) -> None:
    assert answer("calibrate", "board", "--out", tmp_path / "board.pdf")["width_mm"] == 66.0
    done = sliplab("teach", "plane", "--rig", "mock", "--dry-run", "--json")
    assert done.returncode == 0
    assert len(json.loads(done.stdout)["moves"]) == 4


def test_check_refuses_what_is_missing_or_old(tmp_path: Path) -> None:
    path = lab(tmp_path)
    path.write_text(
        path.read_text()
        .replace("taught: 2026-11-21", "taught: 2024-01-01")
        .replace("  touch_depth", "  max_age: {contact_plane: 30 d, lens: 90 d}\n  touch_depth")
    )
    asked = ("--rig", path, "--store", tmp_path / "s", "--json")
    done = here("check", "protocols/pilot.yaml", *asked)
    assert done.returncode == 1
    said = [c["finding"] for c in json.loads(done.stdout)["checks"] if not c["passed"]]
    assert len(said) == 2
    assert said[0].startswith(f"{path}: calibration.contact_plane.taught = 2024-01-01: is ")
    assert f"run `sliplab teach plane --rig {path}`" in said[0]
    assert f"calibration.lens: is missing: run `sliplab calibrate lens --rig {path}`" in said[1]


def test_an_arm_that_is_stopped_stays_so(tmp_path: Path) -> None:
    """Nothing here unlocks anything."""
    here = session(lab(tmp_path, mock=STOPPED % 1))
    with pytest.raises(RigError, match="protective stop"):
        teach.teach_zero(here, QUICK, 1, False)
    assert here.rig.arm.state() is ArmState.PROTECTIVE_STOP
