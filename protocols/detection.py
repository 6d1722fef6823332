"""Settings of detection: the rule from spike counts to onsets, and detectors to compare."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, field_validator

from sliplab.protocols.yaml_file import StrictModel

Spikes = Annotated[float, Field(ge=0, le=1e6)]


class ComparisonSettings(StrictModel):
    """Other detectors compared with the paper's rule, at equal rates of false early detections."""

    rates: tuple[Annotated[float, Field(le=1)], ...] = (0.005, 0.01, 0.02)
    """False early detections allowed, as shares of the validation trials."""
    stride_ms: int | None = Field(default=None, ge=1, le=1000)
    """The finer of two strides that they are compared at; by default a third of the window's
    length where that is whole, else the length."""
    train_trials: int = Field(default=200, ge=1, le=1_000_000)
    """Training trials, of the plan's first ones, that they learn from."""
    carried: bool = False
    """Also the network with its neurons' states carried from window to window."""

    @field_validator("rates")
    @classmethod
    def _shares(cls, rates: tuple[Annotated[float, Field(le=1)], ...]) -> tuple[float, ...]:
        if not rates or list(rates) != sorted(set(rates)) or not 0 <= rates[0] <= rates[-1] < 1:
            raise ValueError("must be a non-empty ascending list of shares from 0 to below 1")
        return rates


class Detection(StrictModel):
    """From spike counts of windows to two estimated onsets."""

    smoothing: int = Field(default=4, ge=1, le=1000)
    """Windows over which spike counts are averaged."""
    margin: Spikes = 8.0
    """The winner must exceed every other class by at least this many mean spikes. By default two,
    as in the paper, for each of a class's ``network.outputs_per_class`` neurons."""
    false_early_ms: float = Field(default=30.0, ge=0, le=1e6)
    """A detection earlier than the label's onset by more than this is false."""
    stride_ms: int | None = Field(default=None, ge=1, le=1000)
    """From one window's begin to the next one's; by default a window's length, so that they
    follow each other. Shorter ones overlap, and `smoothing` of them then span less time."""
    choose: Literal["protocol", "validation", "test"] = "protocol"
    """Source of smoothing and margin: this file; the grid below, by validation trials; or
    by the test trials themselves, as in the paper, which flatters the result."""
    smoothing_grid: tuple[Annotated[int, Field(le=1000)], ...] = (1, 2, 3, 4, 6, 8)
    margin_grid: tuple[Spikes, ...] = (2.0, 4.0, 6.0, 8.0, 12.0, 16.0, 24.0, 32.0)
    """Grid of `choose`: every smoothing with every margin. By default from a half to eight
    for each of a class's output neurons."""
    false_early_rate: float = Field(default=0.02, ge=0, lt=1)
    """Share of trials that a choice may leave false early, and as many missed."""
    compare: ComparisonSettings | None = ComparisonSettings()
    """Other detectors to compare with this rule (docs/detection.md); null leaves them out."""

    @field_validator("smoothing_grid", "margin_grid")
    @classmethod
    def _grid(cls, values: tuple[float, ...]) -> tuple[float, ...]:
        if not values or list(values) != sorted(set(values)) or values[0] < 0:
            raise ValueError("must be a non-empty ascending list of values of 0 or more")
        return values

    @field_validator("smoothing_grid")
    @classmethod
    def _windows(cls, values: tuple[int, ...]) -> tuple[int, ...]:
        if values[0] < 1:
            raise ValueError("must be whole numbers from 1")
        return values
