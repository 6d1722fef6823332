"""The ChArUco board to print: a PDF of lines at true size, or a PNG that says its resolution."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sliplab.protocols.errors import InputError

if TYPE_CHECKING:
    from sliplab.analysis.calibration.charuco import Board

PNG_PX_PER_MM = 50
_MM_PER_INCH = 25.4
_RULER_MM = 50.0
_MARGIN_MM = 12.0


def print_board(board: Board, path: Path) -> dict[str, float]:
    """Write the board with its true size beside it; returns sizes in mm.

    Raises:
        InputError: the file's name ends in neither .pdf nor .png, or its folder is missing.
    """
    if path.suffix not in {".pdf", ".png"}:
        raise InputError("--out", "", str(path), "must end in .pdf or .png")
    if not path.parent.is_dir():
        raise InputError("--out", "", str(path), "its folder does not exist")
    import matplotlib

    matplotlib.use("agg")
    from matplotlib.figure import Figure

    width, height = board.size_mm
    page = max(width, _RULER_MM + 40) + 2 * _MARGIN_MM, height + 4 * _MARGIN_MM
    figure = Figure(figsize=(page[0] / _MM_PER_INCH, page[1] / _MM_PER_INCH))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set_xlim(0, page[0])
    axes.set_ylim(0, page[1])
    axes.axis("off")
    _squares(board, axes, ((page[0] - width) / 2, 2.8 * _MARGIN_MM))
    left = (page[0] - width) / 2
    y = 2.0 * _MARGIN_MM
    axes.plot([left, left + _RULER_MM], [y, y], color="black", linewidth=0.5)
    for end in (left, left + _RULER_MM):
        axes.plot([end, end], [y - 1.5, y + 1.5], color="black", linewidth=0.5)
    text = (
        f"between the ticks: {_RULER_MM:g} mm. Print at 100 %, measure it; squares that are not "
        f"{board.square_mm:g} mm\nare given with --square. ChArUco {board.columns} x {board.rows}, "
        f"squares {board.square_mm:g} mm, markers {board.marker_mm:g} mm\n(DICT_5X5_100), "
        f"together {width:g} x {height:g} mm"
    )
    axes.text(left, y - 4, text, fontsize=6, va="top")
    dpi = PNG_PX_PER_MM * _MM_PER_INCH
    if path.suffix == ".pdf":
        figure.savefig(path, format="pdf", metadata={"CreationDate": None})
    else:
        figure.savefig(path, format="png", dpi=dpi)
    return {
        "width_mm": width,
        "height_mm": height,
        "square_mm": board.square_mm,
        "marker_mm": board.marker_mm,
        "page_width_mm": page[0],
        "page_height_mm": page[1],
    }


def _squares(board: Board, axes: object, corner: tuple[float, float]) -> None:
    """Black rectangles, rows of the finest cells that squares and markers have in common."""
    from matplotlib.collections import PolyCollection

    module = board.marker_mm / 7  # five bits and a border of one on either side
    dictionary = board.opencv().getDictionary()
    quads, number = [], 0

    def quad(x: float, y: float, side_x: float, side_y: float) -> None:
        # y counts down the page from the board's top
        top = corner[1] + board.size_mm[1] - y
        quads.append(
            [(corner[0] + x + a, top - b) for a, b in (
                (0, 0), (side_x, 0), (side_x, side_y), (0, side_y)
            )]
        )  # fmt: skip

    for row in range(board.rows):
        for column in range(board.columns):
            x, y = column * board.square_mm, row * board.square_mm
            if (row + column) % 2 == 0:
                quad(x, y, board.square_mm, board.square_mm)
                continue
            inset = (board.square_mm - board.marker_mm) / 2
            bits = dictionary.generateImageMarker(number, 7, borderBits=1)
            number += 1
            for line, black in enumerate(np.asarray(bits) < 128):
                edges = np.flatnonzero(np.diff(np.concatenate([[0], black, [0]]).astype(int)))
                for begin, end in edges.reshape(-1, 2).tolist():
                    quad(
                        x + inset + begin * module, y + inset + line * module,
                        (end - begin) * module, module,
                    )  # fmt: skip
    shapes = PolyCollection(quads, facecolors="black", edgecolors="none", antialiased=False)
    axes.add_collection(shapes)  # type: ignore[attr-defined]
