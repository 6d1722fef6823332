"""Settings of training: epochs, learning rate, seeds, device."""

from __future__ import annotations

import re
from typing import Annotated, Literal

from pydantic import Field, field_validator

from sliplab.protocols.yaml_file import StrictModel

Seed = Annotated[int, Field(ge=0, lt=2**63)]
_DEVICE = r"^(cpu|cuda(:\d+)?)$"
_DEVICES = "cpu, or a GPU as cuda or cuda:1"


class Training(StrictModel):
    """Settings by which the network is fitted."""

    epochs: int = Field(default=12, ge=1, le=10_000)
    batch: int = Field(default=32, ge=1, le=4096)
    learning_rate: float = Field(default=4e-3, gt=0, le=1)
    schedule: Literal["constant", "cosine"] = "cosine"
    """Of the learning rate over the epochs."""
    warm_up: float = Field(default=0.02, ge=0, le=1)
    """Share of all steps over which the learning rate rises from nothing: a neuron that a first
    large step puts far below its threshold never learns again."""
    gain: float = Field(default=0.0625, gt=0, le=10)
    """Gain of a spike count in the cross-entropy. A smaller one asks for counts further apart. By
    default a quarter over ``network.outputs_per_class``."""
    mirror: bool = True
    """Each epoch shows each training window as it is, or mirrored along one side or both, drawn
    anew: a slide to the left is as good as one to the right."""
    patience: int = Field(default=5, ge=1, le=10_000)
    """Epochs without a better validation accuracy before it stops."""
    seeds: tuple[Seed, ...] = (0,)
    nuisances: bool = Field(default=False, exclude_if=lambda value: not value)
    """Train with the training trials of campaigns with nuisances, too (docs/stress.md)."""
    device: str = Field(
        default="cpu",
        json_schema_extra={"pattern": _DEVICE, "patternErrorMessage": f"must be {_DEVICES}"},
    )
    """Device: the processor by the event-driven kernels, or a GPU (``cuda``, ``cuda:1``)
    by compiled layers. Last bits differ between devices."""

    @field_validator("device")
    @classmethod
    def _known(cls, device: str) -> str:
        if not re.fullmatch(_DEVICE, device):
            raise ValueError(f"must be {_DEVICES}")
        return device

    @field_validator("seeds")
    @classmethod
    def _some(cls, seeds: tuple[int, ...]) -> tuple[int, ...]:
        if not seeds or len(set(seeds)) != len(seeds) or min(seeds) < 0:
            raise ValueError("must be a non-empty list of distinct seeds of 0 or more")
        return seeds
