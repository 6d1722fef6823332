"""Pictures of foreign files: their size is judged before they are unpacked."""

from __future__ import annotations

import struct
import zlib
from typing import Any

import cv2
import numpy as np
import pytest

from sliplab.storage.formats import pictures
from sliplab.storage.formats.foreign import Damage, FormatError
from sliplab.storage.formats.pictures import decode_picture


def _packed(ending: str, image: Any) -> bytes:
    done, data = cv2.imencode(ending, image)
    assert done
    return bytes(data.tobytes())


@pytest.mark.parametrize("ending", [".png", ".jpg", ".tiff", ".bmp", ".gif"])
def test_a_size_is_known_before_a_picture_is_unpacked(ending: str, monkeypatch: Any) -> None:
    colours = np.zeros((40, 70, 3), np.uint8)
    assert decode_picture(_packed(ending, colours)).shape == (40, 70)
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("was unpacked"))
    monkeypatch.setattr(pictures, "check_size", lambda what, size: pytest.fail(str(size)))
    with pytest.raises(pytest.fail.Exception, match=r"\(70, 40\)"):
        decode_picture(_packed(ending, colours))


def test_a_small_file_of_a_huge_picture_is_refused(monkeypatch: Any) -> None:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    head = struct.pack(">IIBBBBB", 30_000, 20_000, 8, 0, 0, 0, 0)
    bomb = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(b""))
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("was unpacked"))
    with pytest.raises(
        FormatError, match="an image of 30000 x 20000 pixels; read are up to 16,384"
    ):
        decode_picture(bomb)


@pytest.mark.parametrize("ending", [".png", ".jpg", ".tiff", ".bmp", ".gif"])
def test_a_header_that_is_cut_short_is_damage(ending: str) -> None:
    whole = _packed(ending, np.zeros((40, 70, 3), np.uint8))
    for length in range(30):
        with pytest.raises(Damage):
            decode_picture(whole[:length])


def test_pictures_of_16_bits_are_named_by_their_type() -> None:
    with pytest.raises(FormatError, match=r"of uint16; read are those of 8 bits \(uint8\)"):
        decode_picture(_packed(".png", np.zeros((4, 7), np.uint16)))
