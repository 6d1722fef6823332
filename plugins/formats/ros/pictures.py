"""Frames in messages that the drivers of cameras publish under ROS 1 and ROS 2, as grey levels."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from sliplab.plugins.formats.ros.messages import Fields
from sliplab.storage.formats.foreign import FormatError, check_size, grey
from sliplab.storage.formats.pictures import decode_picture
from sliplab.storage.streams import U8

COMPRESSED = "sensor_msgs/msg/CompressedImage"
_AS_OPENCV = {"8UC1": "mono8", "8UC3": "bgr8", "8UC4": "bgra8", "16UC1": "mono16"}
"""Encodings that name the numbers of a pixel alone; OpenCV's colours are blue, green, red."""
_BRIGHTNESS = {"yuv422": 1, "uyvy": 1, "yuv422_yuy2": 0, "yuyv": 0}
"""Place of the brightness in each pair of bytes, by encoding."""
_COLOURS = {"mono": 1, "bgr": 3, "rgb": 3, "bgra": 4, "rgba": 4}
_BAYER = {
    "bayer_rggb": cv2.COLOR_BayerRGGB2BGR,
    "bayer_bggr": cv2.COLOR_BayerBGGR2BGR,
    "bayer_gbrg": cv2.COLOR_BayerGBRG2BGR,
    "bayer_grbg": cv2.COLOR_BayerGRBG2BGR,
}
_CHANNELS = {**_COLOURS, **dict.fromkeys(_BAYER, 1)}
"""Numbers of a pixel by encoding, whose name continues with their bits: 8 or 16."""


class PictureDecoder:
    """Decoder of the messages of one topic, in their order.

    Attributes:
        encoding: of the first frame.

    Args:
        kind: type of the messages, sensor_msgs' Image or CompressedImage.
    """

    def __init__(self, kind: str) -> None:
        self.encoding = ""
        self._compressed = kind == COMPRESSED
        self._shape: tuple[int, ...] | None = None
        self._most = 0

    def read(self, fields: Fields) -> tuple[int, U8]:
        """Return the time, ns, and the grey levels of a message, shape (height, width).

        Raises:
            FormatError: it is damaged, of an unknown encoding, or of another size than the frames
                before it.
        """
        if self._compressed:
            encoding = fields.text()
            levels = decode_picture(fields.block())
        else:
            encoding, levels = self._raw(fields)
        if levels.shape != (self._shape or levels.shape):
            raise FormatError("holds a frame of another size than the first")
        self.encoding = self.encoding or encoding
        self._shape = levels.shape
        return fields.t_ns, levels

    def warnings(self) -> list[str]:
        """Return a line about bits that grey levels lack."""
        if not self._most:
            return []
        return [
            f"holds frames of 16 bits with values of up to {self._most:,}; their grey levels are "
            "the upper 8 bits"
        ]

    def _raw(self, fields: Fields) -> tuple[str, U8]:
        height, width, encoding = fields.number("I"), fields.number("I"), fields.text()
        big_endian = fields.number("B") != 0
        step, data = fields.number("I"), fields.block()
        plain = _AS_OPENCV.get(encoding, encoding)
        colours = plain.removesuffix("16").removesuffix("8")
        wide = plain.endswith("16")
        if encoding in _BRIGHTNESS:
            size = 2
        elif colours in _CHANNELS and plain != colours:
            size = _CHANNELS[colours] * (1 + wide)
        else:
            raise FormatError(f"holds frames as {encoding!r:.40}, which are not read")
        if not width or not height:
            raise FormatError(f"holds a frame of {width} x {height}")
        check_size("holds a frame", (width, height))
        if step < width * size or len(data) < step * height:
            raise FormatError(f"holds a frame of {width} x {height} in {len(data)} bytes")
        rows = np.frombuffer(data, np.uint8, step * height).reshape(height, step)[:, : width * size]
        if encoding in _BRIGHTNESS:
            return encoding, rows[:, _BRIGHTNESS[encoding] :: 2].copy()
        pixels: npt.NDArray[Any] = np.ascontiguousarray(rows)
        if wide:
            values = pixels.view(">u2" if big_endian else "<u2")
            self._most = max(self._most, int(values.max()))
            pixels = (values >> 8).astype(np.uint8)
        return encoding, _grey(pixels.reshape(height, width, -1), colours)


def _grey(pixels: npt.NDArray[np.uint8], colours: str) -> U8:
    if colours in _BAYER:
        return grey(cv2.cvtColor(pixels, _BAYER[colours]))
    if colours.startswith("rgb"):
        pixels = pixels[..., 2::-1]
    return grey(pixels)
