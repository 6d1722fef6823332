"""Split trials into training, validation and test: a function of a trial's own condition only.

A split that is cut from a ranking of all trials moves when a level is added. Here a trial's place
in [0, 1) is (rank of its repetition in its condition + u) / repetitions, where u is a point of a
low-discrepancy sequence over the condition's levels, shifted by a hash of its stratum. So adding
a level to any factor moves nothing, and every stratum still gets its shares to within about one
trial (docs/decisions/test-trials.md).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Literal

from pydantic import Field, WithJsonSchema

from sliplab.protocols.factors import Factor, Level, unknown_factor
from sliplab.protocols.hashing import hash_integer
from sliplab.protocols.key_errors import KeyedError
from sliplab.protocols.quantity import canonical, parse
from sliplab.protocols.shown import did_you_mean
from sliplab.protocols.yaml_file import StrictModel, rule

GOLDEN = 0.6180339887498949
_SCALE = float(1 << 63)
PARTS = ("train", "validation", "test")

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
    held_out: dict[str, tuple[str, ...]] = Field(
        default_factory=dict, exclude_if=lambda held: not held
    )
    """Values that people logged, such as a skin's serial number: trials with one of them are test
    trials, and no others are. Settings without any stay what they were, with their hash."""

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


def held_out_part(split: Split, context: Mapping[str, str], planned: str) -> str:
    """Return the part of a trial, by the context that it was taken in.

    Args:
        planned: its part by its condition alone.
    """
    if not split.held_out or planned not in PARTS:
        return planned
    if any(context.get(name) in values for name, values in split.held_out.items()):
        return "test"
    return "train" if planned == "test" else planned


def assign(
    condition: Mapping[str, Level], repetition_ids: Sequence[str], split: Split
) -> list[str]:
    """The split (``train``, ``validation``, ``test``) of each repetition of one condition."""
    if split.method == "leave_conditions_out":
        texts = {name: _text(level) for name, level in condition.items()}
        for part, held in (("test", split.test_levels), ("validation", split.validation_levels)):
            if any(texts.get(name) in levels for name, levels in _canonical(held).items()):
                return [part] * len(repetition_ids)
        return ["train"] * len(repetition_ids)
    stratum = [(name, _text(condition[name])) for name in sorted(split.strata) if name in condition]
    u = hash_integer("split", stratum) / _SCALE
    for name in sorted(condition):
        if name not in split.strata:
            u += _point(name, condition[name])
    u %= 1.0
    ranks = sorted(
        range(len(repetition_ids)), key=lambda i: hash_integer("split", repetition_ids[i])
    )
    result = ["test"] * len(repetition_ids)
    for rank, index in enumerate(ranks):
        place = (rank + u) / len(repetition_ids)
        if place < split.train:
            result[index] = "train"
        elif place < split.train + split.validation:
            result[index] = "validation"
    return result


def _point(name: str, level: Level) -> float:
    """Levels in even steps become a golden-ratio (Weyl) sequence; words a hash."""
    if isinstance(level, str):
        return hash_integer("split", name, level) / _SCALE
    return (float(level) * GOLDEN) % 1.0


def _text(level: Level) -> str:
    return level if isinstance(level, str) else canonical(level)


def _canonical(held: Mapping[str, Sequence[str]]) -> dict[str, set[str]]:
    return {name: {level.split()[0] for level in levels} for name, levels in held.items()}


def check_split(split: Split, factors: Mapping[str, Factor]) -> Split:
    """`split` with its levels in canonical text.

    Raises:
        KeyedError: a factor or a level that the protocol does not have.
    """
    if split.method != "leave_conditions_out":
        return split
    fixed: dict[str, dict[str, tuple[str, ...]]] = {}
    for part in ("validation_levels", "test_levels"):
        fixed[part] = {}
        for name, levels in getattr(split, part).items():
            key = f"analysis.split.{part}.{name}"
            if name not in factors:
                raise KeyedError(key, name, unknown_factor(name, factors))
            factor = factors[name]
            known = {factor.text(level) for level in (*factor.levels(), *factor.optional)}
            texts = []
            for level in levels:
                text = level
                if factor.unit is not None:
                    try:
                        text = f"{canonical(parse(level, factor.unit))} {factor.unit}"
                    except ValueError as error:
                        raise KeyedError(key, level, str(error)) from None
                if text not in known:
                    raise KeyedError(
                        key,
                        level,
                        f"is not one of its levels: {sorted(known)}{did_you_mean(text, known)}",
                    )
                texts.append(text)
            fixed[part][name] = tuple(texts)
    return split.model_copy(update=fixed)
