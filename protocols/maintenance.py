"""Maintenance of a long campaign: warm-up, depth zero, cleaning, and reference trials."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from sliplab.protocols.factors import MAX_TRIALS, ContextLevel
from sliplab.protocols.quantity import PositiveMillimetres, PositiveSpeed
from sliplab.protocols.yaml_file import StrictModel


class ReferenceSettings(StrictModel):
    """One condition taken again and again, to see the skin wear and the rig drift."""

    every: Annotated[int, Field(ge=1, le=MAX_TRIALS)]
    condition: dict[str, ContextLevel]


class WarmUp(StrictModel):
    """Presses before the first trial of every stretch of work."""

    presses: Annotated[int, Field(ge=1, le=100)]
    depth: PositiveMillimetres
    speed: PositiveSpeed
    clearance: PositiveMillimetres


class Rezero(StrictModel):
    """Depth zero found again by touching off, before every so many trials."""

    every: Annotated[int, Field(ge=1, le=MAX_TRIALS)]
    speed: PositiveSpeed
    search: PositiveMillimetres
    """Largest search distance beyond the taught plane for the touch; a hard limit."""
    touches: Annotated[int, Field(ge=1, le=100)] = 1
    """Touches whose mean is depth zero. Where few pixels see the first contact, single touches
    differ by up to a tenth of a millimetre."""


class Cleaning(StrictModel):
    """A person cleans skin and plate before every so many trials."""

    every: Annotated[int, Field(ge=1, le=MAX_TRIALS)]
    prompt: Annotated[str, Field(min_length=1, max_length=400)]


class Maintenance(StrictModel):
    """Maintenance that keeps a long campaign comparable from its first trial to its last."""

    warm_up: WarmUp | None = None
    rezero: Rezero | None = None
    clean: Cleaning | None = None
