"""Settings of windows, and of how many a trial gives to training."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from sliplab.protocols.key_errors import KeyedError
from sliplab.protocols.yaml_file import StrictModel, rule


class Windows(StrictModel):
    """From events to samples of shape (steps, channels, cells, cells)."""

    length_ms: int = Field(default=30, ge=1, le=60_000)
    step_ms: int = Field(default=1, ge=1, le=1000)
    crop_px: int = Field(default=400, ge=1, le=8192)
    pool_px: int = Field(default=20, ge=1, le=8192)
    polarity: Literal["positive", "negative", "both"] = "positive"
    taxels: int | None = Field(
        default=None, ge=1, le=65_536, exclude_if=lambda value: value is None
    )
    """Taxels of a sensor that has no image: each is a channel, of each polarity one, and a sample
    has a single cell. `crop_px` and `pool_px` are then left out. null: the square crop."""

    parts: int = Field(default=1, ge=1, le=1000, exclude_if=lambda value: value == 1)
    """Equal parts of a window of taxels, each with channels of its own: a network then knows when
    in the window an event was, if recordings begin with the touch."""

    @rule
    def _fits(self) -> Windows:
        if self.length_ms % self.step_ms:
            raise KeyedError("analysis.windows.step_ms", self.step_ms, "must divide length_ms")
        if self.parts > self.steps:
            right = f"must not exceed the {self.steps} steps of a window"
            raise KeyedError("analysis.windows.parts", self.parts, right)
        if self.taxels is not None:
            for name in ("crop_px", "pool_px"):
                value = getattr(self, name)
                if value != type(self).model_fields[name].default:
                    raise KeyedError(
                        f"analysis.windows.{name}",
                        value,
                        f"must be left out with taxels = {self.taxels}: taxels have no crop",
                    )
        elif self.parts > 1:
            raise KeyedError("analysis.windows.parts", self.parts, "needs taxels")
        elif self.crop_px % self.pool_px:
            raise KeyedError("analysis.windows.pool_px", self.pool_px, "must divide crop_px")
        return self

    @property
    def steps(self) -> int:
        """Time steps of a sample (30)."""
        return self.length_ms // self.step_ms

    @property
    def cells(self) -> int:
        """Cells along one side of a sample (20); 1 of taxels."""
        return 1 if self.taxels is not None else self.crop_px // self.pool_px

    @property
    def polarities(self) -> int:
        """1, or 2 when both polarities are separate."""
        return 2 if self.polarity == "both" else 1

    @property
    def channels(self) -> int:
        """The polarities, of each taxel and part where there are taxels."""
        return self.polarities * (self.taxels or 1) * self.parts

    def part(self, step: int) -> int:
        """Return the part of a window that a step is in."""
        return step * self.parts // self.steps


class SampleSettings(StrictModel):
    """Windows per class and trial."""

    per_class: int = Field(default=50, ge=1, le=10_000)
    no_slip: Literal["last", "spread"] = Field(
        default="last", exclude_if=lambda value: value == "last"
    )
    """Windows without slip: the last ones before it begins, as in the paper; or random ones of all
    that was recorded before."""
