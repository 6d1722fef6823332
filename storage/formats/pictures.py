"""Pictures of foreign files as grey levels: one from its bytes, and those of a video."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sliplab.protocols.later import Later
from sliplab.storage.formats.foreign import Damage, FormatError, check_size, grey
from sliplab.storage.streams import U8
from sliplab.storage.trials.video import video_url

if TYPE_CHECKING:
    import av
    import cv2
else:
    av = Later("av")
    cv2 = Later("cv2")

_CONTAINERS = "avi,matroska,webm,mov,mp4,m4a,3gp,3g2,mj2"
"""Kinds of video that hold their own frames; others may name files and addresses to be read."""

_JPEG_FRAMES = {*range(0xFFC0, 0xFFD0)} - {0xFFC4, 0xFFC8, 0xFFCC}
"""Marks of a JPEG's segment with its size."""


def decode_picture(data: bytes | memoryview) -> U8:
    """Return the grey levels of a PNG, JPEG or other picture, shape (height, width).

    Raises:
        Damage: it cannot be read. FormatError: it has not 8 bits, or too many pixels.
    """
    with suppress(struct.error):  # of a header that is cut short, which OpenCV finds as well
        check_size("holds an image", _stated_size(data))
    try:
        there = np.frombuffer(data, np.uint8) if len(data) else None
        image = None if there is None else cv2.imdecode(there, cv2.IMREAD_UNCHANGED)
    except cv2.error:
        image = None
    if image is None:
        raise Damage("holds an image that cannot be read")
    if image.dtype != np.uint8:
        raise FormatError(f"holds an image of {image.dtype}; read are those of 8 bits (uint8)")
    check_size("holds an image", (image.shape[1], image.shape[0]))
    return grey(image)


def _stated_size(data: bytes | memoryview) -> tuple[int, int]:
    """Return columns and rows by the header of a PNG, JPEG, TIFF, GIF or BMP, else zeros.

    A small file may unpack to gigabytes, and OpenCV tells no size before that.
    """
    head = bytes(data[:4])
    if head == b"\x89PNG":
        return _two(">II", data, 16)
    if head[:2] == b"BM":
        return _two("<ii", data, 18)
    if head == b"GIF8":
        return _two("<HH", data, 6)
    if head[:2] == b"\xff\xd8":
        at = 2
        while (segment := _two(">HH", data, at))[0] not in _JPEG_FRAMES:
            at += 2 + segment[1]
        rows, columns = _two(">HH", data, at + 5)
        return columns, rows
    if head in (b"II*\0", b"MM\0*"):
        order = "<" if head[:1] == b"I" else ">"
        (at,) = struct.unpack_from(f"{order}I", data, 4)
        sides = {}
        for entry in range(at + 2, at + 2 + 12 * _two(f"{order}HH", data, at)[0], 12):
            tag, kind = _two(f"{order}HH", data, entry)
            (sides[tag],) = struct.unpack_from(
                f"{order}{'H' if kind == 3 else 'I'}", data, entry + 8
            )
        return sides.get(256, 0), sides.get(257, 0)
    return 0, 0


def _two(form: str, data: bytes | memoryview, at: int) -> tuple[int, int]:
    first, second = struct.unpack_from(form, data, at)
    return abs(first), abs(second)  # rows of a BMP from the top on are negative


@contextmanager
def opened_video(path: Path) -> Iterator[tuple[Any, Any]]:
    """Open a video; yields its container and its first stream of frames.

    Raises:
        Damage: it is no video that can be read. FormatError: it has too many pixels.
    """
    options = {"format_whitelist": _CONTAINERS, "protocol_whitelist": "file"}
    try:
        with av.open(video_url(path), options=options) as container:
            if not container.streams.video or container.streams.video[0].codec_context is None:
                raise Damage("holds no video, or one of an unknown codec")
            stream = container.streams.video[0]
            check_size("holds frames", (stream.width, stream.height))
            yield container, stream
    except av.FFmpegError as error:
        raise Damage(f"is no video that can be read ({error.strerror})") from None


def video_frames(path: Path) -> Iterator[U8]:
    """Yield the grey levels of each frame of a video; raises as `opened_video`."""
    with opened_video(path) as (container, stream):
        for frame in container.decode(stream):
            yield levels_of(frame)


def levels_of(frame: Any) -> U8:
    """Return the grey levels of a decoded frame, shape (height, width).

    The pixel values of a grey video are unchanged.
    """
    if frame.format.name in {"gray", "gray8"}:
        return np.asarray(frame.to_ndarray(format="gray"), np.uint8)
    return grey(frame.to_ndarray(format="bgr24"))
