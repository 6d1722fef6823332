"""Adapter: what a foreign data set consists of, as data.

An adapter says which files are the streams of a trial, which names and columns are factors, where
the labels are, and how trials are split. `sliplab import --adapter` reads by it; its text stays
with the campaign in place of a protocol, and the analysis takes split and settings from it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from sliplab.protocols.adapter_parts import (
    AdaptedStreams,
    AdapterFactor,
    AdapterLabels,
    FieldName,
    FieldRule,
    GivenMotion,
    Markers,
    TrialFiles,
)
from sliplab.protocols.key_errors import NAME_PATTERN, KeyedError
from sliplab.protocols.settings import AnalysisSettings
from sliplab.protocols.yaml_file import StrictModel, load, rule

CLASSES = "classes"
"""The experiment whose recordings show one of several classes each, instead of a slip."""
Experiment = Literal["kinematic", "gravity", "disturbance", "classes"]
Role = Literal["train", "validation", "test"]
FactorName = Annotated[str, Field(pattern=NAME_PATTERN)]
Share = Annotated[float, Field(ge=0, le=1)]


class AdapterSplit(StrictModel):
    """Trials that train, choose the model, and test it."""

    given: str | None = None
    """Field that names the part of a trial, where the data set has a split of its own. If it has no
    validation part, `validation` over `train` and `validation` of its training trials are taken."""
    parts: dict[str, Role] = Field(default_factory=dict)
    """The part that a value of `given` stands for, where it is not named so."""
    together: str | None = None
    """Field whose trials stay together, such as an object or a session; by default each trial
    stands by itself."""
    train: Share = 0.70
    validation: Share = 0.15
    test: Share = 0.15

    @rule
    def _sums(self) -> AdapterSplit:
        if abs(self.train + self.validation + self.test - 1.0) > 1e-9:
            raise KeyedError(
                ".train",
                (self.train, self.validation, self.test),
                "train, validation and test must add up to 1",
            )
        if self.parts and self.given is None:
            raise KeyedError(".parts", self.parts, "needs the key 'given'")
        return self


class Adapter(StrictModel):
    """A whole adapter file."""

    adapter: Literal[1]
    """Version of the file format."""
    name: Annotated[str, Field(pattern=NAME_PATTERN)]
    """Of the campaign."""
    title: Annotated[str, Field(max_length=200)] = ""
    about: dict[str, str] = Field(default_factory=dict)
    """Who made the data, where they are, under what licence: text that stays with them."""
    simulated: bool = False
    experiment: Experiment
    """What the trials are; ``classes``: each recording shows one of several classes."""
    classes: tuple[str, ...] = ()
    """Names of the classes in their order; by default those that occur."""
    trials: TrialFiles
    fields: dict[FieldName, FieldRule] = Field(default_factory=dict)
    """Fields that are made from others, in their order."""
    factors: dict[FactorName, AdapterFactor] = Field(default_factory=dict)
    """What was varied, each the values of a field."""
    streams: AdaptedStreams
    labels: AdapterLabels = AdapterLabels()
    motion: GivenMotion | None = None
    """When the slide begins and ends, where that is known."""
    markers: Markers | None = None
    """Where the skin's markers are, for `analysis.labelling.rule` other than ``given``."""
    split: AdapterSplit = AdapterSplit()
    analysis: AnalysisSettings = AnalysisSettings()

    @model_validator(mode="before")
    @classmethod
    def _given_labels_rule(cls, data: Any) -> Any:
        """Labels of the data set rule unless another rule is named."""
        if not isinstance(data, dict) or not isinstance(data.get("analysis", {}), dict):
            return data
        analysis = data.get("analysis", {})
        labelling = analysis.get("labelling", {})
        if not isinstance(labelling, dict):
            return data
        return {**data, "analysis": {**analysis, "labelling": {"rule": "given", **labelling}}}

    @rule
    def _classes_of_a_kind(self) -> Adapter:
        if self.classes and self.experiment != CLASSES:
            raise KeyedError("classes", list(self.classes), "is for experiment: classes")
        if len(set(self.classes)) != len(self.classes):
            raise KeyedError("classes", list(self.classes), "names a class twice")
        return self

    @rule
    def _labels_of_a_kind(self) -> Adapter:
        if self.labels.whole is not None and self.experiment != CLASSES:
            raise KeyedError("labels.class", self.labels.whole, "is for experiment: classes")
        if self.labels.onsets is not None and self.experiment == CLASSES:
            raise KeyedError(
                "labels.onsets", None, "are of slip; an experiment of classes has class or spans"
            )
        if self.motion is not None and self.experiment == CLASSES:
            raise KeyedError("motion", None, "is for experiments of slip")
        return self

    @rule
    def _clocks_there(self) -> Adapter:
        for key, part in (
            ("labels.onsets", self.labels.onsets),
            ("labels.spans", self.labels.spans),
            ("motion", self.motion),
        ):
            if part is not None and getattr(self.streams, part.clock, part) is None:
                raise KeyedError(f"{key}.clock", part.clock, "is of a stream that there is not")
        return self

    def of_the_trials(self) -> dict[str, Any]:
        """Return all that decides what the trials are, as plain data by key."""
        return self.model_dump(mode="json", exclude={"analysis", "split", "title", "about"})


def load_adapter(path: Path) -> Adapter:
    """Read an adapter file.

    Raises:
        InputError: anything wrong, with file, key, value and what would be right.
    """
    return load(Adapter, path, "adapter")
