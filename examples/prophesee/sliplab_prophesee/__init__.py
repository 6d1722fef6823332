"""Prophesee event cameras: a camera by the maker's library, a stream of its bytes, or a recording.

Imported whenever a rig file names it, by `sliplab plan` too: everything else is loaded when the
device is made.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from pydantic import Field, model_validator

from sliplab.protocols.key_errors import KeyedError
from sliplab.rigs.core.address import Host
from sliplab.rigs.core.capabilities import EventCamera
from sliplab.rigs.core.device_settings import DriverSettings
from sliplab.rigs.core.driver import EventCameraDriver, FakeEventCamera
from sliplab.rigs.core.network import answers


class PropheseeSettings(DriverSettings):
    """A Prophesee event camera (EVT 2.0 or EVT 3.0)."""

    driver: Literal["prophesee"] = "prophesee"
    source: Literal["camera", "stream", "file"] = "camera"
    """`camera`: a camera on this computer, by the maker's library (Metavision SDK or OpenEB).
    `stream`: the bytes of a RAW recording over TCP, header first, as they are made; another
    computer can serve a camera so. `file`: a RAW recording, played as fast as it was made."""
    serial: str = ""
    """Serial number of the camera, as the library lists it; left out, the first one."""
    host: Host = "127.0.0.1"
    """Address that serves the stream."""
    port: int = Field(default=7500, ge=1, le=65_535)
    """TCP port there."""
    file: str | None = None
    """The recording."""
    trigger: int = Field(default=0, ge=0, le=15)
    """Number of the trigger input with the sync pulses: 0 is the main one, where a stream or a
    recording says `id`; a camera's main input is switched on."""
    buffer_mb: float = Field(default=256.0, ge=1, le=65_536)
    """Memory for events that nobody has read yet, megabytes (13 bytes an event)."""
    stall_s: float = Field(default=1.0, ge=0.1, le=60)
    """A camera that sends nothing for so long is a fault, seconds: it sends its time always."""

    @model_validator(mode="after")
    def _has_file(self) -> PropheseeSettings:
        if (self.source == "file") != (self.file is not None):
            need = "is needed by source: file" if self.file is None else "needs source: file"
            raise KeyedError(".file", self.file, need)
        return self

    @property
    def where(self) -> str:
        """The source in words."""
        if self.source == "stream":
            return f"{self.host}:{self.port}"
        return self.file or f"camera {self.serial}".strip()


def build(settings: PropheseeSettings) -> EventCamera:
    """Open the camera, not streaming yet. Raises RigError."""
    from sliplab_prophesee.driver import Prophesee
    from sliplab_prophesee.sources import open_source

    return Prophesee(settings, open_source(settings))


def ping(settings: PropheseeSettings) -> str | None:
    """Look for the camera without opening it."""
    if settings.source == "stream":
        return answers(settings.host, settings.port)
    if settings.file is not None:
        return None if Path(settings.file).is_file() else f"{settings.file}: no such file"
    from sliplab_prophesee.sources import find_camera

    return find_camera(settings.serial)


def fake(size: tuple[int, int]) -> FakeEventCamera:
    """Serve a stream of so many columns and rows on a free port."""
    from sliplab_prophesee.fake import FakeProphesee

    return FakeProphesee(size)


def reach(settings: PropheseeSettings, address: Any) -> PropheseeSettings:
    """Return settings that reach a fake."""
    host, port = address
    update = {"source": "stream", "host": host, "port": port, "file": None}
    return settings.model_copy(update=update)


def locks(settings: PropheseeSettings) -> dict[str, str]:
    """Return the lock of the camera: it serves one program."""
    name = "".join(letter if letter.isalnum() else "-" for letter in settings.where.lower())
    return {} if settings.source == "file" else {f"camera-{name}": f"the {settings.where}"}


DRIVER = EventCameraDriver(
    name="prophesee",
    title="Prophesee",
    settings=PropheseeSettings,
    ping=ping,
    address=lambda settings: settings.where,
    locks=locks,
    build=build,
    fake=fake,
    reach=reach,
)
