"""Recording of a protocol: streams, and the region that the outside camera reads out."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, field_validator

from sliplab.protocols.quantity import PositiveMillimetres
from sliplab.protocols.yaml_file import StrictModel


class Region(StrictModel):
    """The part of the plate that the outside camera reads out, centred."""

    width: PositiveMillimetres
    height: PositiveMillimetres


class RecordingSettings(StrictModel):
    """Streams kept of each trial, from the end of settling to the end of the motion."""

    region: Region
    sync_rate: Annotated[Literal[100], Field()] = 100
    """Ticks of the sync box a second, Hz: frames are taken on them."""
    streams: tuple[Literal["events", "frames", "poses"], ...] = ("events", "frames", "poses")

    @field_validator("streams")
    @classmethod
    def _needed(cls, streams: tuple[str, ...]) -> tuple[str, ...]:
        seen = {"events", "frames"} & set(streams)
        if len(set(streams)) != len(streams) or not seen or "poses" not in streams:
            raise ValueError("must hold 'poses', and 'events' or 'frames' or both, none twice")
        return streams
