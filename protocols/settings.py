"""The `analysis:` section of a protocol: settings of the analysis of stored data.

It is hashed separately from the collection: no change here can make collected data unusable. Each
model is passed as a whole to the step that uses it, and that step is stale when its model changes.
"""

from __future__ import annotations

import re
from typing import Annotated, Any, Literal

from pydantic import Field, WithJsonSchema, field_validator, model_validator

from sliplab.protocols.presets import COMPARED, PAPER, Value, at, expanded
from sliplab.protocols.yaml_file import KeyedError, StrictModel, rule

Scale = Annotated[float, Field(ge=0, le=1e6)]
Seed = Annotated[int, Field(ge=0, lt=2**63)]
MARGIN = 2.0
"""Spikes by which a class must lead for each of its output neurons: the paper's rule."""
Spikes = Annotated[float, Field(ge=0, le=1e6)]


class Labelling(StrictModel):
    """Ground truth from the outside video."""

    rule: Literal["paper", "change_point", "force", "given"] = "paper"
    """Onset rule that later steps use; all are kept (docs/labels.md). `force` needs a rig with a
    force sensor (docs/force.md); `given` takes the labels that came with an imported recording
    (docs/adapters.md)."""
    threshold_px: float = Field(default=2.0, gt=0, le=100)
    """A marker slips when its displacement exceeds this, pixels."""
    reference: Literal["hold_start", "hold_end"] = "hold_start"
    """From where the paper's rule counts displacements: from the start of the recorded hold, as in
    the paper, so that a slip in the hold counts; or from its end, just before the motion."""
    reference_ms: float = Field(default=200.0, gt=0, le=1e6)
    """The markers' reference positions are their means over this part of the hold; a frame's length
    takes the first frame (or the last)."""
    hold_slip_px: float | None = Field(default=1.0, gt=0, le=100)
    """A marker that moved further than this in the recorded hold leaves the trial's onsets in
    doubt, pixels; null: none does."""


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

    @rule
    def _fits(self) -> Windows:
        if self.length_ms % self.step_ms:
            raise KeyedError("analysis.windows.step_ms", self.step_ms, "must divide length_ms")
        if self.taxels is not None:
            for name in ("crop_px", "pool_px"):
                value = getattr(self, name)
                if value != type(self).model_fields[name].default:
                    raise KeyedError(
                        f"analysis.windows.{name}",
                        value,
                        f"must be left out with taxels = {self.taxels}: taxels have no crop",
                    )
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
        """The polarities, of each taxel where there are taxels."""
        return self.polarities * (self.taxels or 1)


class SampleSettings(StrictModel):
    """Windows per class and trial."""

    per_class: int = Field(default=50, ge=1, le=10_000)
    no_slip: Literal["last", "spread"] = Field(
        default="last", exclude_if=lambda value: value == "last"
    )
    """Windows without slip: the last ones before it begins, as in the paper; or random ones of all
    that was recorded before."""


HeldOut = Annotated[str, WithJsonSchema({"anyOf": [{"type": "string"}, {"type": "number"}]})]
"""A level; a number without a unit is in its factor's, see `protocols.model`."""


class Split(StrictModel):
    """Trials that train, choose the model, and test it.

    ``ranked``: repetitions ranked by a hash inside each condition, conditions spread evenly
    inside the strata. ``leave_conditions_out``: whole levels are held out.
    """

    method: Literal["ranked", "leave_conditions_out"] = "ranked"
    train: float = Field(default=0.70, ge=0, le=1)
    validation: float = Field(default=0.15, ge=0, le=1)
    test: float = Field(default=0.15, ge=0, le=1)
    strata: tuple[str, ...] = ("depth", "speed")
    validation_levels: dict[str, tuple[HeldOut, ...]] = Field(default_factory=dict)
    test_levels: dict[str, tuple[HeldOut, ...]] = Field(default_factory=dict)

    @rule
    def _sums(self) -> Split:
        if abs(self.train + self.validation + self.test - 1.0) > 1e-9:
            raise KeyedError(
                "analysis.split",
                (self.train, self.validation, self.test),
                "train, validation and test must add up to 1",
            )
        if self.method == "leave_conditions_out" and not self.test_levels:
            raise KeyedError("analysis.split.test_levels", {}, "must list the held-out levels")
        return self


class NetworkSettings(StrictModel):
    """The spiking network: two convolutions, two fully connected layers, IAF neurons."""

    conv1_channels: int = Field(default=8, ge=1, le=256)
    conv2_channels: int = Field(default=16, ge=1, le=256)
    hidden: int = Field(default=32, ge=1, le=1024)
    outputs_per_class: int = Field(default=4, ge=1, le=64)
    """Output neurons of each class, whose spikes are counted together: with one, as in the paper,
    a window of 30 steps has 31 counts to distinguish classes by, and more ties."""
    biases: bool = True
    """Biases in the full layers: without them nothing can say "no events" (docs/network.md)."""
    conv1_kernel: Literal[1, 3, 5, 7] = 5
    conv2_kernel: Literal[1, 3, 5, 7] = 3
    """Side of the square kernels, cells."""
    weight_scale: tuple[Scale, Scale, Scale, Scale] = (4.0, 3.0, 4.0, 3.0)
    """Factors on the default initial weights; without them the deep layers stay silent."""

    @property
    def margin(self) -> float:
        """The paper's lead of a winner, in spikes of a class: two for each of its neurons."""
        return MARGIN * self.outputs_per_class


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


class AnalysisSettings(StrictModel):
    """The whole `analysis:` section."""

    preset: Literal["paper"] | None = None
    """``paper``: network, training and rule of the paper (docs/network.md). Keys that are beside
    it go before its values."""
    also: Literal["paper"] | None = None
    """A preset whose network is trained and judged as well, on the same windows and labels, with
    the first seed; the report compares its figures with the others."""
    labelling: Labelling = Labelling()
    windows: Windows = Windows()
    samples: SampleSettings = SampleSettings()
    split: Split = Split()
    network: NetworkSettings = NetworkSettings()
    training: Training = Training()
    detection: Detection = Detection()

    @model_validator(mode="before")
    @classmethod
    def _preset(cls, data: Any) -> Any:
        return expanded(data) if isinstance(data, dict) else data

    @model_validator(mode="after")
    def _spikes(self) -> AnalysisSettings:
        """Margins in spikes scale with the number of output neurons per class."""
        factor = self.network.outputs_per_class / NetworkSettings().outputs_per_class
        usual, rule = Training(), Detection()
        changes: tuple[tuple[str, StrictModel, dict[str, Any]], ...] = (
            ("training", self.training, {"gain": usual.gain / factor}),
            (
                "detection",
                self.detection,
                {
                    "margin": self.network.margin,
                    "margin_grid": tuple(each * factor for each in rule.margin_grid),
                },
            ),
        )
        for name, part, wanted in changes:
            left = {key: wanted[key] for key in wanted.keys() - part.model_fields_set}
            found = part.model_copy(update=left)
            found.model_fields_set.difference_update(left)  # the user did not set them: `rule_for`
            object.__setattr__(self, name, found)  # frozen for all others
        return self

    @rule
    def _strides(self) -> AnalysisSettings:
        length = self.windows.length_ms
        stride = self.detection.stride_ms
        if stride is not None and stride > length:
            raise KeyedError(
                "analysis.detection.stride_ms", stride, f"must not exceed length_ms = {length}"
            )
        compare = self.detection.compare
        fine = None if compare is None else compare.stride_ms
        if fine is not None and (length % fine or fine % self.windows.step_ms):
            raise KeyedError(
                "analysis.detection.compare.stride_ms",
                fine,
                f"must divide length_ms = {length}, and be whole steps of {self.windows.step_ms}",
            )
        return self

    @property
    def overrides(self) -> tuple[tuple[Value, Any], ...]:
        """Settings in which this differs from the paper's preset, with the values here."""
        found = ((each, at(self, each.key)) for each in PAPER)
        return tuple((each, value) for each, value in found if value != each.value)

    def comparison_settings(self) -> AnalysisSettings | None:
        """Settings of the comparison network that `also` names; None without one.

        Network, training and rule are the preset's; epochs, batch, patience and device of the
        training, and all else, are those here.
        """
        if self.also is None or self.also == self.preset:
            return None
        data = self.model_dump()
        for section in COMPARED:
            data[section] |= {
                each.key.split(".")[1]: each.value
                for each in PAPER
                if each.key.startswith(f"{section}.")
            }
        data["training"]["seeds"] = self.training.seeds[:1]
        data["detection"]["compare"] = None
        return AnalysisSettings.model_validate({**data, "preset": self.also, "also": None})

    def rule_for(self, outputs_per_class: float, margin: float) -> Detection:
        """Return the rule of detection in units of the spikes that another network gives.

        Gravity trials are evaluated by the network of the kinematic campaign. A margin that is set
        here is a lead by so many spikes of as many neurons as are here.

        Args:
            outputs_per_class: of the network; it may have fewer of one class than of another.
            margin: the lead in its spikes where none is set here.
        """
        factor = outputs_per_class / self.network.outputs_per_class
        stated = "margin" in self.detection.model_fields_set
        margin = self.detection.margin * factor if stated else margin
        grid = tuple(each * factor for each in self.detection.margin_grid)
        return self.detection.model_copy(update={"margin": margin, "margin_grid": grid})

    @property
    def stride_ms(self) -> int:
        """From one window's begin to the next one's in detection."""
        return self.detection.stride_ms or self.windows.length_ms

    @property
    def most_spikes(self) -> int:
        """That a class can give in a window: a neuron fires once a step at most."""
        return self.windows.steps * self.network.outputs_per_class

    @property
    def fine_stride_ms(self) -> int | None:
        """The finer stride that detectors are compared at; None where they are not."""
        if self.detection.compare is None:
            return None
        length, step = self.windows.length_ms, self.windows.step_ms
        third = length // 3
        whole = length % 3 == 0 and third % step == 0
        return self.detection.compare.stride_ms or (third if whole else length)
