"""Claims that a campaign is to settle, and when it may stop: `collection.stopping`.

A claim is about one figure of a trial, taken over the whole grid with every condition counted
alike. Which figures there are, their units and statistics are in `FIGURES`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, PlainSerializer, WithJsonSchema, field_validator

from sliplab.protocols.factors import MAX_TRIALS, ContextLevel, Factor, unknown_factor
from sliplab.protocols.hashing import hash_data
from sliplab.protocols.key_errors import KeyedError
from sliplab.protocols.quantity import canonical, parse
from sliplab.protocols.shown import one_of
from sliplab.protocols.yaml_file import StrictModel, rule

FigureName = Literal[
    "accuracy", "latency_incipient", "latency_gross", "lead", "slip_duration", "first_slip"
]
Statistic = Literal["mean", "median", "p05", "p10", "p25", "p75", "p90", "p95"]
Kind = Literal["within", "at_least", "at_most", "apart"]
QUANTILES: Mapping[str, float] = {
    "median": 0.5,
    "p05": 0.05,
    "p10": 0.1,
    "p25": 0.25,
    "p75": 0.75,
    "p90": 0.9,
    "p95": 0.95,
}
LEAST_BLOCKS = 6
"""Blocks before which nothing is called."""
RARE = 3.0
"""Blocks times share of the trials beyond a percentile, before which nothing is called: trials of
one cause may all lie in one block, and 3 / share blocks miss it with a chance of 5 % at most."""


@dataclass(frozen=True)
class ClaimFigure:
    """A figure that each trial has.

    Attributes:
        unit: that claims are stated in; canonical: the unit of their decimals.
        scale: of the figure in that unit, times this, is the figure as `trial_figures` gives it.
        network: a network's output is needed.
    """

    title: str
    unit: str
    canonical: str
    scale: float
    network: bool


FIGURES: Mapping[str, ClaimFigure] = {
    "accuracy": ClaimFigure("windows of a trial classified correctly", "%", "percent", 1.0, True),
    "latency_incipient": ClaimFigure("latency of incipient slip", "ms", "s", 1000.0, True),
    "latency_gross": ClaimFigure("latency of gross slip", "ms", "s", 1000.0, True),
    "lead": ClaimFigure("lead of the detection before gross slip", "ms", "s", 1000.0, True),
    "slip_duration": ClaimFigure("true length of incipient slip", "ms", "s", 1000.0, False),
    "first_slip": ClaimFigure("incipient onset after the motion's start", "ms", "s", 1000.0, False),
}


def _quantity(info: Any, raw: object) -> object:
    name = info.data.get("figure")
    if raw is None or name not in FIGURES:  # an unknown figure is a fault already
        return None
    return parse(raw, FIGURES[name].canonical)


def _statistic(info: Any, raw: object) -> object:
    figure = info.data.get("figure")
    known = ("mean",) if figure == "accuracy" else tuple(QUANTILES)
    if raw is None or raw in known or figure is None:
        return raw
    if figure == "accuracy":
        raise ValueError("must be 'mean' for the accuracy")
    if raw == "mean":
        raise ValueError(
            "must be 'median' or a percentile such as 'p95': times have no bound, and a trial "
            "without a detection has none"
        )
    raise ValueError("must be 'median'" if raw == "p50" else one_of(raw, known))


Amount = Annotated[Decimal, PlainSerializer(canonical), WithJsonSchema({"type": "string"})]
"""A percentage or a time, by the claim's figure."""


class LevelDifference(StrictModel):
    """Two levels of a factor that are compared, all else averaged."""

    factor: str
    levels: tuple[ContextLevel, ContextLevel]


class Claim(StrictModel):
    """One claim; exactly one of `within`, `at_least` and `at_most` says what holds."""

    figure: FigureName
    statistic: Statistic | None = None
    """Left out: the mean of accuracy, the median of times."""
    between: LevelDifference | None = None
    """The claim is about the second level's statistic less the first one's; with `at_least`, about
    its size."""
    within: Amount | None = None
    """Half the width of the interval that the statistic shall be known to."""
    at_least: Amount | None = None
    at_most: Amount | None = None

    _known = field_validator("statistic", mode="before")(lambda raw, info: _statistic(info, raw))
    _read = field_validator("within", "at_least", "at_most", mode="before")(
        lambda raw, info: _quantity(info, raw)
    )

    @rule
    def _whole(self) -> Claim:
        said = [
            name for name in ("within", "at_least", "at_most") if getattr(self, name) is not None
        ]
        if len(said) != 1:
            raise ValueError(
                "must have exactly one of 'within', 'at_least' and 'at_most'"
                f"{', not ' + ' and '.join(said) if said else ''}"
            )
        if self.within is not None and self.within <= 0:
            raise KeyedError(".within", canonical(self.within), "must be more than 0")
        return self

    @property
    def of(self) -> Statistic:
        """The statistic, the default written out."""
        return self.statistic or ("mean" if self.figure == "accuracy" else "median")

    @property
    def least_blocks(self) -> int:
        """Number of blocks before which the claim is not called."""
        if self.of == "mean":
            return LEAST_BLOCKS
        share = QUANTILES[self.of]
        return max(LEAST_BLOCKS, math.ceil(RARE / min(share, 1.0 - share) - 1e-9))

    @property
    def kind(self) -> Kind:
        """Which of the three bounds is given; a difference of at least a size is `apart`."""
        if self.within is not None:
            return "within"
        if self.between is not None and self.at_least is not None:
            return "apart"
        return "at_least" if self.at_least is not None else "at_most"

    @property
    def value(self) -> float:
        """Claimed value, in the figure's own unit: percent or ms."""
        said = next(v for v in (self.within, self.at_least, self.at_most) if v is not None)
        return float(said) * FIGURES[self.figure].scale

    def text(self, factors: Mapping[str, Factor]) -> str:
        """Return the claim in words, with units.

        Args:
            factors: of the protocol, with its context.
        """
        figure = FIGURES[self.figure]
        words = f"{self.of} {figure.title}"
        if self.between is not None:
            name = self.between.factor
            first, second = map(factors[name].text, self.between.levels)
            words = f"{words}, {name} {second} less {first},"
        said = {
            "within": "known within +-",
            "at_least": "at least ",
            "at_most": "at most ",
            "apart": "in size at least ",
        }
        return f"{words} {said[self.kind]}{self.value:g} {figure.unit}"


def repeated(claims: Sequence[Claim]) -> Iterator[int | None]:
    """Yield the number of the earlier claim that each claim repeats; None where it is new."""
    plain = [claim.model_copy(update={"statistic": claim.of}) for claim in claims]
    for k, claim in enumerate(plain):
        yield plain.index(claim) if claim in plain[:k] else None


class AdaptiveChoice(StrictModel):
    """How `order: adaptive` chooses the next trials."""

    batch: Annotated[int, Field(ge=1, le=1000)] = 12
    """Trials that are chosen at once, while those before them are taken."""
    random: Annotated[float, Field(ge=0.05, le=1)] = 0.3
    """Share of chance in each choice, which keeps the estimates free of bias."""
    start: Annotated[int, Field(ge=2, le=MAX_TRIALS)] = 36
    """Trials taken first, spread over the grid."""


class Stopping(StrictModel):
    """A campaign ends when every claim holds, or is refuted, at the stated error."""

    claims: Annotated[tuple[Claim, ...], Field(min_length=1, max_length=20)]
    error: Annotated[float, Field(gt=0, le=0.5)] = 0.05
    """Chance at most of calling a claim that is false, for each claim, over all looks together."""
    least: Annotated[int, Field(ge=1, le=MAX_TRIALS)] = 1
    """Trials before which no decision is taken."""
    most: Annotated[int, Field(ge=1, le=MAX_TRIALS)] | None = None
    """Trials after which the campaign ends in any case; left out: the whole plan."""
    repetitions: Annotated[int, Field(ge=1, le=1000)] = 1
    """Of each condition between two looks, with `order: shuffled` or `listed`. Every one of these
    rounds goes through all levels that a person changes."""
    block: Annotated[int, Field(ge=2, le=MAX_TRIALS)] | None = None
    """Trials in a row that may resemble each other, such as those after one touch, with `order:
    shuffled` or `listed`; left out: a repetition of every condition. Only blocks count as
    independent."""
    model: str | None = None
    """File of the network that judges the trials, from the protocol's folder; it was trained on
    other ones. Needed where a claim is about a network's output."""

    @rule
    def _ordered(self) -> Stopping:
        if self.most is not None and self.most < self.least:
            raise KeyedError(
                ".most", self.most, f"must be at least collection.stopping.least = {self.least}"
            )
        return self

    @property
    def needs_network(self) -> bool:
        """Whether a claim is about the output of a network."""
        return any(FIGURES[claim.figure].network for claim in self.claims)

    def network_file(self, protocol: str | Path) -> Path | None:
        """Return the file of the network that judges the claims; None where none is needed.

        Args:
            protocol: the file that names it.

        Raises:
            KeyedError: one is needed, and there is none.
        """
        if not self.needs_network:
            return None
        key = "collection.stopping.model"
        if self.model is None:
            raise KeyedError(
                key,
                None,
                "is needed: a claim is about a network's output; name the file of a "
                "trained one, such as STORE/models/seed0.pt of a pilot",
            )
        path = Path(protocol).parent / self.model
        if not path.is_file():
            raise KeyedError(key, self.model, f"{path} is no file")
        return path.resolve()

    def factor_faults(self, factors: Mapping[str, Factor]) -> Iterator[KeyedError]:
        """Return a fault for each compared factor or level that the plan does not have."""
        for number, claim in enumerate(self.claims):
            if claim.between is None:
                continue
            key = f"collection.stopping.claims[{number}].between"
            name, levels = claim.between.factor, claim.between.levels
            if name not in factors:
                yield KeyedError(f"{key}.factor", name, unknown_factor(name, factors))
                continue
            there = (*factors[name].levels(), *factors[name].optional)
            for place, level in enumerate(levels):
                if level not in there:
                    texts = ", ".join(factors[name].text(item) for item in there)
                    yield KeyedError(
                        f"{key}.levels[{place}]", level, f"is not a level of {name}: {texts}"
                    )
            if levels[0] == levels[1]:
                yield KeyedError(f"{key}.levels", levels[0], "must be two different levels")


def section_hash(stopping: Stopping) -> str:
    """Return a hash of all that claims ask for."""
    return hash_data(stopping.model_dump(mode="json"))
