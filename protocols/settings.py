"""The `analysis:` section of a protocol: settings of the analysis of stored data.

It is hashed separately from the collection: no change here can make collected data unusable. Each
part has a module of its own: `protocols.labelling`, `protocols.windows` and so on. Its model is
passed as a whole to the step that uses it, and that step is stale when its model changes.
"""

from __future__ import annotations

from typing import Any, Literal

from pydantic import model_validator

from sliplab.protocols.detection import Detection
from sliplab.protocols.key_errors import KeyedError
from sliplab.protocols.labelling import Labelling
from sliplab.protocols.network_settings import MOST_CHANNELS, SIZES, NetworkSettings
from sliplab.protocols.presets import COMPARED, PAPER, Value, at, expanded
from sliplab.protocols.split import Split
from sliplab.protocols.training import Training
from sliplab.protocols.windows import SampleSettings, Windows
from sliplab.protocols.yaml_file import StrictModel, rule

BEGUN_SLOWER = 8.0
"""Factor between the usual learning rates of the two starts of a network."""


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
        return _begun_by_data(expanded(data)) if isinstance(data, dict) else data

    @model_validator(mode="after")
    def _spikes(self) -> AnalysisSettings:
        """Margins in spikes scale with the number of output neurons per class.

        A network that begins as a regression learns slower, so that it does not forget it.
        """
        factor = self.network.outputs_per_class / NetworkSettings().outputs_per_class
        usual, rule = Training(), Detection()
        begun = self.network.start != "random"
        rate = {"learning_rate": usual.learning_rate / BEGUN_SLOWER} if begun else {}
        changes: tuple[tuple[str, StrictModel, dict[str, Any]], ...] = (
            ("training", self.training, {"gain": usual.gain / factor, **rate}),
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
    def _start(self) -> AnalysisSettings:
        network = self.network
        if network.start == "random":
            return self
        key = "analysis.network"
        if self.windows.taxels is None:
            raise KeyedError(f"{key}.start", network.start, "needs windows.taxels")
        if not network.biases:
            raise KeyedError(f"{key}.biases", False, "must be true with start: regression")
        if self.windows.channels > MOST_CHANNELS:
            raise KeyedError(
                f"{key}.start", network.start, f"is for {MOST_CHANNELS} channels at most"
            )
        for size in sorted(SIZES):
            value = getattr(network, size)
            if value != NetworkSettings.model_fields[size].default:
                right = "must be left out with start: regression, which sets it"
                raise KeyedError(f"{key}.{size}", value, right)
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
        data["network"]["start"] = "random"  # a preset sets the sizes
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


def _begun_by_data(data: dict[str, Any]) -> dict[str, Any]:
    """Return the section with the start of a network of taxels, where it says nothing of that."""
    given, network = data.get("windows"), data.get("network", {})
    if not (isinstance(given, dict) and given.get("taxels") and isinstance(network, dict)):
        return data
    if network.keys() & (SIZES | {"start"}) or not network.get("biases", True):
        return data
    try:
        windows = Windows.model_validate(given)
    except ValueError:  # its faults are reported later
        return data
    if windows.channels > MOST_CHANNELS:
        return data
    return {**data, "network": {"start": "regression", **network}}
