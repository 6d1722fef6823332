"""Lens and scale from pictures of a board, rendered with a lens that is known."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from sliplab.analysis.calibration.charuco import Board, BoardError, Corners, find_corners, fit_lens
from sliplab.plugins.simulation.scene.lens import (
    VIEWS,
    BoardCamera,
    BoardPlace,
    BoardPrint,
    draw_board,
)

Picture = NDArray[np.uint8]
BOARD = Board()
SIZE = (960, 600)
LENSES: dict[str, tuple[tuple[float, float], tuple[float, ...]]] = {
    "straight": ((0.0, 0.0), (0.0,)),
    "barrel, askew": ((3.0, -4.0), (-0.3,)),
    "pincushion": ((0.0, 0.0), (0.25,)),
    "tangential": ((0.0, 0.0), (-0.3, 0.0, 0.004, -0.003, 0.0)),
}


def camera(lens: str) -> BoardCamera:
    """Half the pixels of the real one over the same field."""
    tilt, distortion = LENSES[lens]
    return BoardCamera(10.0, *SIZE, tilt, distortion, 300.0)


@cache
def picture(lens: str, place: BoardPlace, noise: float = 1.5) -> Picture:
    rng = np.random.default_rng(1)
    drawn = draw_board(camera(lens), place, BoardPrint())
    return np.clip(np.rint(drawn + noise * rng.standard_normal(drawn.shape)), 0, 255).astype(
        np.uint8
    )


def views(lens: str) -> list[Corners]:
    return [find_corners(picture(lens, place), BOARD) for place in VIEWS]


def test_the_board_that_is_printed_is_the_one_that_is_simulated() -> None:
    simulated = BoardPrint()
    assert (BOARD.columns, BOARD.rows, BOARD.square_mm, BOARD.marker_mm) == (
        simulated.columns,
        simulated.rows,
        simulated.square_mm,
        simulated.marker_mm,
    )


@pytest.mark.quick(1)
@pytest.mark.parametrize("lens", LENSES)
def test_the_lens_that_drew_the_pictures_is_found(lens: str) -> None:
    true = camera(lens)
    fit = fit_lens(views(lens), BOARD, SIZE)
    assert fit.matrix[0, 0] == pytest.approx(true.matrix[0, 0], rel=3e-3)
    assert fit.matrix[1, 1] == pytest.approx(true.matrix[1, 1], rel=3e-3)
    assert fit.residual_px < 0.15
    assert fit.cover == 1.0
    # scale on the plate at the picture's centre: the tilt takes sqrt(cos a cos b) of it
    a, b = np.radians(true.tilt_deg)
    expected = true.px_per_mm * np.sqrt(np.cos(a) * np.cos(b))
    assert fit.scale_px_per_mm == pytest.approx(expected, rel=3e-4)
    tilt = np.degrees(np.arccos(np.cos(a) * np.cos(b)))
    assert fit.tilt_deg == pytest.approx(tilt, abs=0.2)
    # what counts is where the model puts things, not each coefficient
    k, truth = fit.distortion, true.coefficients
    edge = np.hypot(*SIZE) / 2 / true.matrix[0, 0]
    for radius in (0.5 * edge, edge):
        bent = [c[0] * radius**2 + c[1] * radius**4 for c in (k, truth)]
        assert true.matrix[0, 0] * radius * abs(bent[0] - bent[1]) < 0.6
    assert fit.distortion[4] == 0.0


@pytest.mark.long
def test_coefficients_have_to_earn_their_place() -> None:
    assert fit_lens(views("straight"), BOARD, SIZE).model == "k1"
    assert fit_lens(views("tangential"), BOARD, SIZE).model == "k1 k2 p1 p2"


def test_a_board_on_its_head_is_the_same_board() -> None:
    upright = find_corners(picture("straight", BoardPlace()), BOARD)
    turned = find_corners(picture("straight", BoardPlace(spin_deg=180.0)), BOARD)
    assert np.array_equal(np.sort(upright.ids), np.sort(turned.ids))
    # each corner lies opposite
    opposite = np.array(SIZE) - 1 - turned.px[np.argsort(turned.ids)]
    assert np.abs(opposite - upright.px[np.argsort(upright.ids)]).max() < 0.3


def test_a_partly_hidden_board_gives_the_corners_that_are_seen() -> None:
    seen = picture("straight", BoardPlace()).copy()
    whole = find_corners(seen, BOARD)
    seen[:, : SIZE[0] // 2] = 25  # a hand before the left half
    half = find_corners(seen, BOARD)
    assert 12 <= len(half) < len(whole)
    by_id = dict(zip(whole.ids.tolist(), whole.px, strict=True))
    for number, px in zip(half.ids.tolist(), half.px, strict=True):
        assert np.hypot(*(px - by_id[number])) < 0.3


def test_a_few_hidden_boards_do_not_matter() -> None:
    seen = views("straight")
    nothing = Corners(np.empty(0, np.int64), np.empty((0, 2)))
    fit = fit_lens([*seen[:3], nothing, *seen[3:]], BOARD, SIZE)
    assert fit.used.tolist() == [0, 1, 2, 4, 5, 6, 7, 8]
    assert fit.scale_px_per_mm == pytest.approx(10.0, rel=3e-4)


def test_a_mirrored_board_is_told() -> None:
    with pytest.raises(BoardError, match="seen mirrored"):
        find_corners(picture("straight", BoardPlace(mirrored=True)), BOARD)


def test_no_board_is_no_corners() -> None:
    rng = np.random.default_rng(2)
    noise = rng.integers(0, 256, SIZE[::-1], dtype=np.uint8)
    assert len(find_corners(np.full(SIZE[::-1], 25, np.uint8), BOARD)) == 0
    assert len(find_corners(noise, BOARD)) == 0


def test_a_board_seen_only_in_one_place_is_refused() -> None:
    leans = [(0.0, 0.0), (28.0, 0.0), (-28.0, 0.0), (0.0, 30.0), (0.0, -30.0), (20.0, 20.0)]
    small = Board(7, 5, 4.0, 3.0)
    printed = BoardPrint(7, 5, 4.0, 3.0)
    places = [BoardPlace((-25.0, 12.0, 0.0), lean) for lean in leans]
    seen = [find_corners(draw_board(camera("straight"), p, printed), small) for p in places]
    with pytest.raises(BoardError, match="of the picture, at least 75 % is needed"):
        fit_lens(seen, small, SIZE)


def test_boards_that_do_not_lean_are_refused() -> None:
    flat = views("straight")[0]
    with pytest.raises(BoardError, match=r"lean"):
        fit_lens([flat] * 6, BOARD, SIZE)
    places = [
        BoardPlace((x, y, 0.0), (0, 0), s)
        for x, y, s in ((0, 0, 0), (-14, 8, 5), (14, -8, -5), (-14, -8, 90), (14, 8, 180))
    ]
    seen = [find_corners(picture("straight", place), BOARD) for place in places]
    with pytest.raises(BoardError, match=r"lean"):
        fit_lens(seen, BOARD, SIZE)


def test_too_few_pictures_are_refused() -> None:
    seen = views("straight")
    nothing = Corners(np.empty(0, np.int64), np.empty((0, 2)))
    with pytest.raises(BoardError, match=r"3 of 3 pictures .* 4 are needed"):
        fit_lens(seen[:3], BOARD, SIZE)
    with pytest.raises(BoardError, match="flat on the plate shows 0 corners"):
        fit_lens([nothing, *seen[1:]], BOARD, SIZE)
    with pytest.raises(BoardError, match="flat on the plate shows 0 corners"):
        fit_lens([], BOARD, SIZE)


@pytest.mark.parametrize(
    "sizes", [(2, 7, 6.0, 4.5), (11, 41, 6.0, 4.5), (20, 20, 6.0, 4.5), (11, 7, 6.0, 6.0)]
)
def test_boards_that_cannot_be_are_refused(sizes: tuple[int, int, float, float]) -> None:
    with pytest.raises(BoardError):
        Board(*sizes)
