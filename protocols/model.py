"""Frozen models of a protocol file's `collection:` section.

They define the measurement; the analysis settings are in `protocols.settings`.
Quantities are decimals in the canonical unit of their kind
(mm, mm/s, deg, s, kg, percent, px), whatever unit the file used.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from decimal import Decimal
from typing import Annotated, Any, Literal

from pydantic import Field, field_validator, model_validator

from sliplab.protocols.claims import AdaptiveChoice, Stopping
from sliplab.protocols.factors import (
    MAX_TRIALS,
    Context,
    Factor,
    levels_in_canonical_units,
    unknown_factor,
    written_units,
)
from sliplab.protocols.gates import Gates
from sliplab.protocols.key_errors import NAME_PATTERN, KeyedError
from sliplab.protocols.maintenance import Maintenance, ReferenceSettings
from sliplab.protocols.nuisances import Nuisances
from sliplab.protocols.phases import Phase
from sliplab.protocols.protocol_limits import ProtocolLimits
from sliplab.protocols.quantity import FactorRef, KilogramsOrRef
from sliplab.protocols.recording import RecordingSettings
from sliplab.protocols.settings import AnalysisSettings
from sliplab.protocols.shown import nearest
from sliplab.protocols.templates import expand, templates
from sliplab.protocols.yaml_file import StrictModel, rule

_NAME = re.compile(r"[a-z][a-z0-9_]{0,31}")


COLUMNS = (
    "campaign",
    "trial",
    "experiment",
    "role",
    "repetition",
    "block",
    "attempt",
    "simulated",
    "recorded_s",
    "events",
    "frames",
    "frame_source",
    "sync_uncertainty_us",
    "passed",
    "split",
    "motion_s",
)
"""Columns of tables of trials in addition to the conditions."""


def _check_names(factors: Iterable[str], section: str) -> None:
    for name in factors:
        if not _NAME.fullmatch(name) or name == "r":
            raise KeyedError(
                f"collection.{section}.{name}",
                name,
                "a factor's name is a small letter, then small letters, digits and '_' "
                "('r' stands for the repetition)",
            )


def _or_template(schema: dict[str, Any]) -> None:
    """Let the schema of a motion be a list of phases, or a template with its parameters."""
    phases = {key: schema.pop(key) for key in ("type", "items") if key in schema}
    parts = [
        {
            "type": "object",
            "properties": {
                "template": {"const": name},
                **{key: {"type": "string"} for key in template.parameters},
            },
            "required": [
                "template",
                *(key for key, each in template.parameters.items() if each.default is None),
            ],
            "additionalProperties": False,
        }
        for name, template in templates().items()
    ]
    schema["anyOf"] = [phases, *parts]


class PlateSetup(StrictModel):
    """The plate that hangs on the slider in gravity and disturbance trials."""

    mass: KilogramsOrRef


class Collection(StrictModel):
    """The `collection:` section: it alone decides whether a campaign may continue."""

    experiment: Literal["kinematic", "gravity", "disturbance"]
    seed: Annotated[int, Field(ge=0, lt=2**63)]
    factors: dict[str, Factor] = Field(
        json_schema_extra={"minProperties": 1, "propertyNames": {"pattern": f"^{_NAME.pattern}$"}}
    )
    """Factors that are varied; every combination of their levels is a condition."""
    context: dict[str, Context] = Field(
        default_factory=dict, json_schema_extra={"propertyNames": {"pattern": f"^{_NAME.pattern}$"}}
    )
    """What is known of a trial and moves nothing: skin, temperature, serial number, operator. It
    is part of every condition, id, table and split."""
    repetitions: Annotated[int, Field(ge=1, le=100_000)]
    order: Literal["shuffled", "listed", "adaptive"] = "shuffled"
    """Inside a block; ``adaptive``: the next trials are those that tell most about the claims."""
    stopping: Stopping | None = None
    choice: AdaptiveChoice | None = None
    """Of `order: adaptive`; left out, its defaults."""
    references: ReferenceSettings | None = None
    plate: PlateSetup | None = None
    motion: tuple[Phase, ...] = Field(json_schema_extra=_or_template)
    """The phases of a trial in order; or a template and its parameters."""
    nuisances: Nuisances | None = None
    recording: RecordingSettings
    limits: ProtocolLimits
    gates: Gates = Gates()
    maintenance: Maintenance = Maintenance()

    @model_validator(mode="before")
    @classmethod
    def _template_written_out(cls, data: Any) -> Any:
        if not isinstance(data, dict) or "motion" not in data:
            return data
        return {**data, "motion": expand(data["motion"])}

    @model_validator(mode="before")
    @classmethod
    def _levels_in_canonical_units(cls, data: Any) -> Any:
        if not isinstance(data, dict):
            return data
        units, faults = written_units(data.get("factors"), data.get("context")), list[KeyedError]()
        made = dict(data)
        if isinstance(references := data.get("references"), dict) and "condition" in references:
            key = "collection.references.condition"
            condition = levels_in_canonical_units(references["condition"], key, units.get, faults)
            made["references"] = {**references, "condition": condition}
        stopping = data.get("stopping")
        if isinstance(stopping, dict) and isinstance(claims := stopping.get("claims"), list):
            made["stopping"] = {
                **stopping,
                "claims": [
                    _claim_in_canonical_units(
                        claim, f"collection.stopping.claims[{k}]", units, faults
                    )
                    for k, claim in enumerate(claims)
                ],
            }
        if faults:
            raise KeyedError.joined(faults)
        return made

    @field_validator("factors")
    @classmethod
    def _named(cls, factors: dict[str, Factor]) -> dict[str, Factor]:
        if not factors:
            raise ValueError("is empty; define at least one factor")
        _check_names(factors, "factors")
        return factors

    @field_validator("context")
    @classmethod
    def _context_named(cls, context: dict[str, Context]) -> dict[str, Context]:
        _check_names(context, "context")
        for name in context:
            if name in COLUMNS:
                raise KeyedError(
                    f"collection.context.{name}", name, "is a column of every table; choose another"
                )
        return context

    @property
    def all_factors(self) -> dict[str, Factor]:
        """Factors and context by name, in the order in which a condition has them."""
        return {**self.factors, **self.context}

    @property
    def acting(self) -> tuple[int, ...]:
        """Places in the motion of the phases in which the sensor moves in contact."""
        names = [phase.phase for phase in self.motion]
        press, release = names.index("press"), names.index("release")
        return tuple(
            index
            for index, name in enumerate(names)
            if name in {"slide", "retract", "twist"} or (name == "move" and press < index < release)
        )

    def key_of(self, name: str) -> str:
        """The key of a factor or of context: ``collection.context.skin``."""
        return f"collection.{'context' if name in self.context else 'factors'}.{name}"

    @rule
    def _names_are_distinct(self) -> Iterator[KeyedError]:
        for name in self.context:
            if name in self.factors:
                yield KeyedError(f"collection.context.{name}", name, "is a factor already")

    @rule
    def _few_trials(self) -> None:
        count = self.repetitions
        for name, factor in self.all_factors.items():
            count *= len(factor.levels())
            if count > MAX_TRIALS:
                raise KeyedError(
                    self.key_of(name),
                    f"{count:,} trials",
                    f"the factorial has more than {MAX_TRIALS:,} trials",
                )

    def bindings(self) -> list[tuple[str, FactorRef]]:
        """Each ``$name`` of motion, plate and nuisances, with the key at which it occurs."""
        return [
            *_references_in(self.motion, "collection.motion"),
            *_references_in(self.plate, "collection.plate"),
            *_references_in(self.nuisances, "collection.nuisances"),
        ]

    @property
    def adaptive(self) -> AdaptiveChoice | None:
        """How the next trials are chosen; None where the plan says their order."""
        return (self.choice or AdaptiveChoice()) if self.order == "adaptive" else None

    @rule
    def _stopping_fits(self) -> Iterator[KeyedError]:
        if self.order == "adaptive" and self.stopping is None:
            yield KeyedError(
                "collection.stopping",
                None,
                "is needed by order: adaptive: its claims say what the trials are chosen for",
            )
        if self.choice is not None and self.order != "adaptive":
            yield KeyedError("collection.choice", None, "is only used by order: adaptive")
        if self.stopping is not None and self.stopping.block is not None and self.adaptive:
            yield KeyedError(
                "collection.stopping.block",
                self.stopping.block,
                "has no meaning with order: adaptive, whose batches are the blocks "
                "(collection.choice.batch)",
            )
        if self.stopping is not None:
            yield from self.stopping.factor_faults(self.all_factors)

    @rule
    def _references_fit(self) -> Iterator[KeyedError]:
        if self.references is None:
            if self.gates.reference is not None:
                yield KeyedError(
                    "collection.gates.reference",
                    None,
                    "needs reference trials, and the protocol defines none: add references",
                )
            return
        gate = self.gates.reference
        slides = any(step.phase == "slide" for step in self.motion)
        if gate is not None and gate.friction is not None and not slides:
            yield KeyedError(
                "collection.gates.reference.friction",
                f"{gate.friction} %",
                "needs a motion that slides: leave it out",
            )
        given = self.references.condition
        for name, factor in self.all_factors.items():
            key = f"collection.references.condition.{name}"
            if name not in given:
                yield KeyedError(
                    key, None, "is missing: a reference trial must give a level for every factor"
                )
                continue
            if isinstance(given[name], str) == (factor.unit is not None):
                yield KeyedError(key, given[name], f"must be a level in '{factor.unit or 'words'}'")
            if factor.changeover == "person":
                yield KeyedError(
                    key,
                    given[name],
                    "a reference trial cannot require a changeover; remove references",
                )
        for name in given:
            if name not in self.all_factors:
                yield KeyedError(
                    f"collection.references.condition.{name}",
                    given[name],
                    unknown_factor(name, self.all_factors),
                )

    @rule
    def _phases_are_in_order(self) -> None:
        names = [phase.phase for phase in self.motion]

        def fail(expected: str, value: object = None) -> None:
            raise KeyedError("collection.motion", value or " -> ".join(names) or [], expected)

        if names[:1] != ["approach"] and names[:1] != ["plate"]:
            fail("must begin with 'approach' (or 'plate')")
        if names[-1:] != ["return"]:
            fail("must end with 'return'")
        for name in ("approach", "press", "release", "return"):
            if names.count(name) != 1:
                fail(f"must contain the phase '{name}' exactly once")
        acting = self.acting
        if not acting:
            text = "must contain a 'slide', 'retract' or 'twist', or a 'move' between press and"
            fail(f"{text} release")
        if "hold" not in names[: acting[0]]:
            fail("must have a 'hold' before it moves in contact, where recording starts")
        ordered = [name for name in names if name in {"approach", "press", "release", "return"}]
        if ordered != ["approach", "press", "release", "return"]:
            fail("must have approach, press, release and return, in this order")
        press, release = names.index("press"), names.index("release")
        if not all(press < index < release for index in acting):
            fail("must slide or retract between press and release")
        if any(names.index("approach") > i for i, name in enumerate(names) if name == "hold"):
            fail("cannot have a hold before the approach")
        if "twist" in names and self.plate is not None:
            fail("cannot twist on a sliding plate")
        if ("plate" in names) != (self.plate is not None):
            fail("a phase 'plate' and the section 'plate' require each other")

    @rule
    def _twist_is_limited(self) -> Iterator[KeyedError]:
        if not any(phase.phase == "twist" for phase in self.motion):
            return
        for name in ("twist", "twist_speed"):
            if getattr(self.limits, name) is None:
                key = f"collection.limits.{name}"
                yield KeyedError(key, None, "is needed: the motion has a twist")

    @rule
    def _bindings_are_known(self) -> Iterator[KeyedError]:
        references = self.bindings()
        used = {str(ref) for _, ref in references}
        used |= {f"${nearest(ref.factor, self.factors)}" for _, ref in references}  # misspelt
        for key, ref in references:
            if ref.factor in self.context:
                text = "is context, which moves nothing; put it below collection.factors"
                yield KeyedError(key, ref, text)
            elif ref.factor not in self.factors:
                yield KeyedError(key, ref, unknown_factor(str(ref), self.factors))
        for key, each in references:
            if each.factor not in self.factors:
                continue
            unit = self.factors[each.factor].unit
            if unit is not None and unit != each.unit:
                yield KeyedError(
                    f"collection.factors.{each.factor}.unit",
                    unit,
                    f"must be {each.unit or 'left out, with words as levels'} where {each} stands "
                    f"({key})",
                )
        for name in self.factors:
            if f"${name}" not in used:
                yield KeyedError(
                    f"collection.factors.{name}",
                    name,
                    f"is not used by any phase; write ${name} as the value of a phase's key, or "
                    "move it to collection.context if it moves nothing",
                )


def _claim_in_canonical_units(
    claim: Any, key: str, units: Mapping[str, Any], faults: list[KeyedError]
) -> Any:
    between = claim.get("between") if isinstance(claim, dict) else None
    if not isinstance(between, dict) or not isinstance(between.get("factor"), str):
        return claim
    unit = units.get(between["factor"])
    levels = levels_in_canonical_units(
        between.get("levels"), f"{key}.between.levels", lambda _: unit, faults
    )
    return {**claim, "between": {**between, "levels": levels}}


def _references_in(part: Any, key: str) -> list[tuple[str, FactorRef]]:
    """Each reference to a factor in `part`, with the key at which it occurs."""
    if isinstance(part, FactorRef):
        return [(key, part)]
    inner: list[tuple[str, Any]] = []
    if isinstance(part, tuple):
        inner = [(f"{key}[{index}]", item) for index, item in enumerate(part)]
    elif isinstance(part, StrictModel):
        inner = [(f"{key}.{name}", getattr(part, name)) for name in type(part).model_fields]
    return [found for place, item in inner for found in _references_in(item, place)]


class Protocol(StrictModel):
    """A whole protocol file."""

    protocol: Literal[1]
    """Version of the file format."""
    name: Annotated[str, Field(pattern=NAME_PATTERN)]
    title: Annotated[str, Field(max_length=200)] = ""
    question: Annotated[str, Field(max_length=300)] = ""
    """What the campaign is to answer; the report begins with it."""
    collection: Collection
    analysis: AnalysisSettings = AnalysisSettings()

    @model_validator(mode="before")
    @classmethod
    def _held_out_levels_as_text(cls, data: Any) -> Any:
        """Levels of the split may be numbers in the unit of their factor, too."""
        sections = data if isinstance(data, dict) else {}
        collection, analysis = sections.get("collection"), sections.get("analysis")
        if not isinstance(collection, dict) or not isinstance(analysis, dict):
            return data
        if not isinstance(split := analysis.get("split"), dict):
            return data
        units = written_units(collection.get("factors"), collection.get("context"))
        made = {
            part: {name: _as_text(levels, units.get(name)) for name, levels in split[part].items()}
            for part in ("validation_levels", "test_levels")
            if isinstance(split.get(part), dict)
        }
        return {**data, "analysis": {**analysis, "split": {**split, **made}}}


def _as_text(levels: Any, symbol: object) -> Any:
    """Return levels with numbers as text in their unit, ``2.4 mm``."""
    if not isinstance(symbol, str) or not isinstance(levels, list):
        return levels
    return [
        f"{level} {symbol}"
        if isinstance(level, int | Decimal) and not isinstance(level, bool)
        else level
        for level in levels
    ]
