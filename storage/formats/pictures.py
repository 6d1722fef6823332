"""Pictures of foreign files as grey levels: one from its bytes, and those of a video."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sliplab.protocols.later import Later
from sliplab.storage.formats.foreign import MOST_PX, Damage, FormatError, grey
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


def decode_picture(data: bytes | memoryview) -> U8:
    """Return the grey levels of a PNG, JPEG or other picture, shape (height, width).

    Raises:
        Damage: it cannot be read. FormatError: it has not 8 bits, or too many pixels.
    """
    try:
        there = np.frombuffer(data, np.uint8) if len(data) else None
        image = None if there is None else cv2.imdecode(there, cv2.IMREAD_UNCHANGED)
    except cv2.error:
        image = None
    if image is None:
        raise Damage("holds an image that cannot be read")
    if image.dtype != np.uint8 or max(image.shape[:2]) > MOST_PX:
        raise FormatError(f"holds images of {image.dtype} {image.shape}; read are those of 8 bits")
    return grey(image)


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
            if max(stream.width, stream.height) > MOST_PX:
                raise FormatError(f"holds frames of {stream.width} x {stream.height}")
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
