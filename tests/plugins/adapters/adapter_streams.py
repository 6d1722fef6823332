"""Folders with streams, their adapters, and how tests take them in."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest

from sliplab.protocols.errors import InputError
from sliplab.storage.trials.recording import Recording
from tests.plugins.adapters.adapters import bring

EVENTS: dict[str, Any] = {"format": "csv", "columns": {"t": 0, "x": 1, "y": 2, "p": 3}}
EVENTS |= {"unit": "us", "size_px": [8, 6]}
BASE: dict[str, Any] = {"adapter": 1, "name": "streams", "experiment": "kinematic"}
BASE |= {"trials": {"files": "{who}/events.csv", "id": "{who}"}, "streams": {"events": EVENTS}}
ONSETS = {"file": "marks.csv", "match": {"who": "{id}"}, "incipient": "first", "gross": "full"}
FRAMES: dict[str, Any] = {
    "images": {"files": "{who}/img/*.png"},
    "numpy": {"files": "{who}/frames.npy"},
    "video": {"files": "{who}/film.mkv"},
}


def adapter(streams: Mapping[str, Any] | None = None, **more: Any) -> dict[str, Any]:
    """An adapter with streams beside the events, and further keys."""
    return {**BASE, "streams": {**BASE["streams"], **(streams or {})}, **more}


def folder_of(tmp_path: Path, who: str = "ann", last_us: int = 1_000_000) -> Path:
    """Make the folder of a trial with two events, and return it."""
    folder = tmp_path / "set" / who
    folder.mkdir(parents=True)
    (folder / "events.csv").write_text(f"0,1,2,1\n{last_us},7,5,0\n")
    return folder


def imported(made: dict[str, Any], tmp_path: Path, who: str = "ann") -> Recording:
    """Import the set of a test, and return one of its trials."""
    return bring(made, tmp_path / "set", tmp_path / "store").recording(who)


def refused(made: dict[str, Any], tmp_path: Path, message: str) -> None:
    """Import what is wrong: it is named, and nothing of it stays."""
    with pytest.raises(InputError, match=message):
        bring(made, tmp_path / "set", tmp_path / "store")
    assert not list((tmp_path / "store").glob("campaigns/*"))


def write_frames(folder: Path, form: str, images: Any) -> None:
    """Write frames in a form that loses nothing; the names of images sort otherwise as text."""
    if form == "numpy":
        np.save(folder / "frames.npy", images)
    elif form == "images":
        (folder / "img").mkdir()
        for number, image in enumerate(images):
            assert cv2.imwrite(str(folder / "img" / f"{8 + number}.png"), image)
    else:
        with av.open(str(folder / "film.mkv"), "w") as file:
            stream = file.add_stream("ffv1", rate=30)
            stream.height, stream.width = images.shape[1:]
            stream.pix_fmt = "gray"
            for image in images:
                file.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="gray")))
            file.mux(stream.encode(None))


def some_frames(count: int = 35) -> Any:
    """Frames of noise: none is like another."""
    return np.random.default_rng(count).integers(0, 256, (count, 12, 16)).astype(np.uint8)


def zipped(path: Path) -> Path:
    """Pack a folder into a zip beside it, and return that."""
    packed = path.parent / f"{path.name}.zip"
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as file:
        for each in sorted(path.rglob("*")):
            file.write(each, each.relative_to(path))
    return packed


def marked(data: bytes, *, flag: int) -> bytes:
    """Set a flag of every file in a zip."""
    made = bytearray(data)
    for signature, at in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        place = -1
        while (place := made.find(signature, place + 1)) >= 0:
            made[place + at] |= flag
    return bytes(made)
