"""The plan: the ordered table of trials that a protocol expands to.

Ids come from decimal text, the order from hashes of ids: the same protocol gives the same plan on
every machine, and a level added later changes no id, no split and no relative order of the trials
that were there already.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from decimal import Decimal
from functools import cached_property, partial
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from sliplab.protocols.consistency import check_consistency
from sliplab.protocols.errors import InputError
from sliplab.protocols.factors import Level, in_canonical_unit, unknown_factor
from sliplab.protocols.gates import Gates
from sliplab.protocols.hashing import hash_data, hash_integer
from sliplab.protocols.key_errors import KeyedError
from sliplab.protocols.model import Protocol
from sliplab.protocols.motion import build_program, check_limits, path_fault
from sliplab.protocols.nuisances import requests
from sliplab.protocols.program import Dwell, Program
from sliplab.protocols.quantity import FactorRef, canonical, to_decimal
from sliplab.protocols.rounds import block_warnings, check_first_round
from sliplab.protocols.shipped import protocol_path
from sliplab.protocols.shown import did_you_mean, plural
from sliplab.protocols.split import assign, check_split
from sliplab.protocols.templates import in_terms_of_template
from sliplab.protocols.units import file_text
from sliplab.protocols.yaml_file import input_error, parse_leniently, raise_all, read_text, validate

if TYPE_CHECKING:
    import pandas as pd

Role = Literal["measured", "reference"]
MAX_ID = 240
"""A trial's id is a folder's name, which has 255 bytes at most; in quarantine it gets a number."""


@dataclass(frozen=True)
class PlannedTrial:
    """One planned trial."""

    index: int
    """Place in the plan, from 0."""
    id: str
    """Content-derived: ``depth=2.4mm,direction=45deg,speed=0.6mmps,r=1``."""
    role: Role
    block: int
    repetition: int
    condition: tuple[tuple[str, Level], ...]
    split: str
    """``train``, ``validation``, ``test``, or ``none`` for reference trials."""
    seed: int


@dataclass(frozen=True)
class Task:
    """Something to be done before a trial: by the arm, or by a person."""

    kind: Literal["changeover", "warm_up", "rezero", "clean"]
    by_person: bool
    prompt: str
    expected: str
    slot: int
    """Number of the occurrence; with the rig's seed it decides a simulated rezero."""
    mounts_plate: bool = False
    """It is the change to another plate, which a rig can weigh."""

    @property
    def request(self) -> str:
        """Name of the task to a rig's operator: a `condition` is a changeover of no plate."""
        return "condition" if self.kind == "changeover" and not self.mounts_plate else self.kind


def condition_columns(condition: Mapping[str, str]) -> dict[str, float | str]:
    """A condition's levels by the names of table columns.

    A level with a unit is a number, and the unit is in the column's name: ``depth_mm``, or
    ``speed_mm_per_s`` where the unit has a slash.

    Args:
        condition: text with unit, by factor: ``{"depth": "2.4 mm"}``.
    """
    columns: dict[str, float | str] = {}
    for name, text in condition.items():
        number, _, unit = text.partition(" ")
        if unit:
            columns[f"{name}_{unit.replace('/', '_per_')}"] = float(number)
        else:
            columns[name] = number
    return columns


@dataclass(frozen=True, repr=False)
class Plan:
    """A protocol expanded. Iterating gives the trials in the order they are taken."""

    protocol: Protocol
    file: str
    enabled: Mapping[str, tuple[Level, ...]]
    trials: tuple[PlannedTrial, ...]
    _programs: dict[tuple[tuple[str, Level], ...], Program] = field(
        default_factory=dict, repr=False, compare=False
    )
    _seconds: dict[tuple[tuple[tuple[str, Level], ...], bool], float] = field(
        default_factory=dict, repr=False, compare=False
    )

    def __repr__(self) -> str:
        hours = self.total_seconds / 3600
        return f"<Plan {self.protocol.name}: {plural(len(self), 'trial')}, {hours:.2f} h of motion>"

    def table(self) -> pd.DataFrame:
        """The trials as a table, in the order in which they are taken; units in the headers."""
        import pandas as pd  # most plans are never read as a table

        rows = [
            {
                "trial": trial.id,
                "role": trial.role,
                "block": trial.block,
                "repetition": trial.repetition,
                **condition_columns(self.describe(trial)),
                "split": trial.split,
                "motion_s": self.seconds(trial),
            }
            for trial in self
        ]
        return pd.DataFrame(rows)

    def __len__(self) -> int:
        return len(self.trials)

    def __iter__(self) -> Iterator[PlannedTrial]:
        return iter(self.trials)

    def program(self, trial: PlannedTrial) -> Program:
        """The motion program of `trial`."""
        if trial.condition not in self._programs:
            self._programs[trial.condition] = build_program(
                self.protocol.collection, dict(trial.condition)
            )
        return self._programs[trial.condition]

    def seconds(self, trial: PlannedTrial, *, recorded_only: bool = False) -> float:
        """Planned seconds of motion of one trial."""
        key = trial.condition, recorded_only
        if key not in self._seconds:  # the live page asks for all trials every few seconds
            self._seconds[key] = self.program(trial).seconds(recorded_only=recorded_only)
        return self._seconds[key]

    @cached_property
    def total_seconds(self) -> float:
        """Planned seconds of motion of all trials, maintenance and people's work left out."""
        return sum(self.seconds(trial) for trial in self.trials)

    def describe(self, trial: PlannedTrial) -> dict[str, str]:
        """The trial's condition as text with units, by factor."""
        factors = self.protocol.collection.all_factors
        return {name: factors[name].text(level) for name, level in trial.condition}

    @property
    def name(self) -> str:
        """The protocol's name."""
        return self.protocol.name

    @property
    def seed(self) -> int:
        """The protocol's seed."""
        return self.protocol.collection.seed

    @cached_property
    def levels(self) -> dict[str, tuple[str, ...]]:
        """Levels of each factor as text with unit, in the order of the file."""
        factors = self.protocol.collection.all_factors
        return {name: tuple(map(factors[name].text, of)) for name, of in self.enabled.items()}

    def level_texts(self, field: Decimal | FactorRef, unit: str) -> tuple[str, ...]:
        """A phase's field as text (``2.8 mm``): its one value, or the levels of its factor."""
        if not isinstance(field, FactorRef):
            return (f"{field} {unit}",)
        factor = self.protocol.collection.all_factors[field.factor]
        return tuple(factor.text(level) for level in self.enabled[field.factor])

    def mass_kg(self, trial: PlannedTrial) -> float | None:
        """Mass of the sliding plate in this trial; None if there is none."""
        plate = self.protocol.collection.plate
        if plate is None:
            return None
        mass = plate.mass
        return float(dict(trial.condition)[mass.factor] if isinstance(mass, FactorRef) else mass)

    def tasks_before(self, trial: PlannedTrial) -> tuple[Task, ...]:
        """List the tasks before `trial`, in order, in an undisturbed campaign."""
        before = self.trials[trial.index - 1] if trial.index else None
        tasks = list(self.changeovers(before, trial))
        upkeep = self.protocol.collection.maintenance
        if upkeep.clean is not None and trial.index and trial.index % upkeep.clean.every == 0:
            tasks.append(
                Task("clean", True, upkeep.clean.prompt, "done", trial.index // upkeep.clean.every)
            )
        if upkeep.warm_up is not None and trial.index == 0:
            tasks.append(Task("warm_up", False, "warm-up presses", "", 0))
        if upkeep.rezero is not None and trial.index % upkeep.rezero.every == 0:
            tasks.append(self.rezero_task(trial))
        return tuple(tasks)

    def rezero_task(self, trial: PlannedTrial) -> Task:
        """The search for depth zero that `trial` relies on."""
        upkeep = self.protocol.collection.maintenance.rezero
        slot = 0 if upkeep is None else trial.index // upkeep.every
        return Task("rezero", False, "touch off to find depth zero", "", slot)

    def changeovers(self, before: PlannedTrial | None, trial: PlannedTrial) -> tuple[Task, ...]:
        """List what a person must change or do between two trials (or before the first)."""
        past = dict(before.condition) if before is not None else {}
        plate = self.protocol.collection.plate
        mass = plate.mass if plate is not None else None
        tasks = []
        nuisances = self.protocol.collection.nuisances
        disturbing = set() if nuisances is None else {str(nuisances.apply), str(nuisances.strength)}
        for name, level in trial.condition:
            factor = self.protocol.collection.all_factors[name]
            if f"${name}" in disturbing:
                continue  # what is to be done follows below
            if factor.changeover == "person" and past.get(name) != level:
                text = factor.text(level)
                prompt, mounts = f"set {name} to {text}", str(mass) == f"${name}"
                tasks.append(Task("changeover", True, prompt, text, trial.block, mounts))
        wanted = requests(self.program(trial).nuisances)
        if wanted != ("" if before is None else requests(self.program(before).nuisances)):
            prompt = f"from now on: {wanted or 'leave the rig alone again'}"
            tasks.append(Task("changeover", True, prompt, "ready", trial.block))
        return tuple(tasks)

    def stretches(self) -> list[tuple[int, int]]:
        """(first, last) indices of runs of trials that need no person in between."""
        starts = [t.index for t in self.trials if any(x.by_person for x in self.tasks_before(t))]
        starts = sorted({0, *starts})
        ends = [start - 1 for start in starts[1:]] + [len(self.trials) - 1]
        return list(zip(starts, ends, strict=True))

    def warnings(self) -> list[str]:
        """List settings that are allowed but probably not meant."""
        windows, samples = self.protocol.analysis.windows, self.protocol.analysis.samples
        need = windows.length_ms * samples.per_class / 1000
        preset = self.protocol.analysis.preset is not None
        found = [
            f"analysis.{each.key}: {here} overrides {each.value} of the preset"
            for each, here in (self.protocol.analysis.overrides if preset else ())
        ]
        hold = min(
            sum(
                step.seconds
                for step in self.program(trial).steps
                if isinstance(step, Dwell) and step.recorded
            )
            for trial in self.trials
        )
        if hold < need:
            found.append(
                f"collection.motion: the recorded hold of {hold:g} s is shorter than "
                f"{samples.per_class} no-slip windows of {windows.length_ms} ms ({need:g} s)"
            )
        for name, factor in self.protocol.collection.context.items():
            if factor.changeover == "none" and len(self.enabled[name]) > 1:
                found.append(
                    f"collection.context.{name}: has {len(self.enabled[name])} levels and no one "
                    "is asked to change it; write changeover: person if somebody does"
                )
        return [*found, *block_warnings(self.protocol.collection, self.enabled)]

    @cached_property
    def collection_hash(self) -> str:
        """Hash of all settings that determine the trials, except the levels taken.

        Levels, repetitions and reference trials only add trials; the ids say which.
        """
        data = self.collection_data
        for factor in (*data["factors"].values(), *data.get("context", {}).values()):
            for key in ("values", "range", "optional"):
                factor.pop(key)
        for key in ("repetitions", "references"):
            data.pop(key)
        # which of the trials are taken, and when, makes none of them another one
        for key in ("stopping", "choice"):
            data.pop(key, None)
        if data["order"] == "adaptive":
            data["order"] = "shuffled"
        return hash_data(data)

    @property
    def collection_data(self) -> dict[str, Any]:
        """The `collection:` section as JSON data, defaults written out."""
        data: dict[str, Any] = self.protocol.collection.model_dump(mode="json", by_alias=True)
        for key in ("context", "stopping", "choice", "nuisances"):
            if not data[key]:  # as in protocols from before it came
                data.pop(key)
        for name in ("twist", "twist_speed"):
            if data["limits"][name] is None:
                data["limits"].pop(name)
        for phase in data["motion"]:
            if phase["phase"] == "press" and phase["force"] is None:
                phase.pop("force")
        gates = self.protocol.collection.gates
        for name in ("reference", "hold_slip", "normal_force", "hold_force"):
            if getattr(gates, name) is None:  # hashes of protocols from before it came stay
                data["gates"].pop(name)
        if gates.reference is not None and gates.reference.friction is None:
            data["gates"]["reference"].pop("friction")
        rezero = self.protocol.collection.maintenance.rezero
        if rezero is not None and rezero.touches == 1:
            data["maintenance"]["rezero"].pop("touches")
        if gates.speed_deviation == Gates().speed_deviation:  # the same
            data["gates"].pop("speed_deviation")
        return data

    @cached_property
    def analysis_hash(self) -> str:
        """Hash of the `analysis:` section."""
        return hash_data(self.protocol.analysis.model_dump(mode="json"))


def load_plan(
    path: Path, enable: Iterable[str] = (), judged: bool = False, *, stored: bool = False
) -> Plan:
    """Read the protocol at `path` and expand it.

    Args:
        path: of the file, or the name of a protocol that ships with the package (``pilot``).
        enable: levels to switch on, as ``factor=level`` (``disturbance=125``).
        judged: the network that its claims need must be there.
        stored: it is a campaign's own copy, which is not held to rules that came after it.

    Raises:
        InputError: anything wrong, with file, key, value and what would be right.
    """
    path = path if stored else protocol_path(path)
    return parse_plan(read_text(path, "protocol"), path, enable, stored=stored, judged=judged)


def parse_plan(
    text: str,
    path: Path,
    enable: Iterable[str] = (),
    *,
    stored: bool = False,
    judged: bool = False,
) -> Plan:
    """Expand a protocol that was read from `path`; arguments and errors as of `load_plan`."""
    document = parse_leniently(text, path)
    try:
        check = partial(_check, path=path if judged else None)
        protocol = validate(Protocol, document, path, None if stored else check)
        plan = make_plan(protocol, str(path), enable)
        if not stored:  # with the levels that were switched on
            check_first_round(protocol.collection, plan.enabled)
        return plan
    except KeyedError as error:
        raise input_error(path, error) from None
    except InputError as error:
        raise InputError.joined(
            in_terms_of_template(each, document) for each in error.faults
        ) from None


def _check(protocol: Protocol, path: Path | None) -> None:
    """Check a protocol that a person gives. Raises KeyedError, all that is wrong.

    Args:
        path: of the file, if the network that it names must be there.
    """
    levels, stopping = _levels(protocol), protocol.collection.stopping
    raise_all(
        (
            lambda: check_consistency(protocol),
            lambda: check_limits(protocol, levels),
            lambda: check_first_round(protocol.collection, levels),
            lambda: stopping.network_file(path) if path is not None and stopping else None,
        )
    )


def make_plan(protocol: Protocol, file: str, enable: Iterable[str] = ()) -> Plan:
    """Expand a protocol that was read from `file`."""
    levels = _enabled(protocol, enable)
    try:
        check_limits(protocol, levels)
        split = check_split(protocol.analysis.split, protocol.collection.all_factors)
    except KeyedError as error:
        raise input_error(file, error) from None
    analysis = protocol.analysis.model_copy(update={"split": split})
    protocol = protocol.model_copy(update={"analysis": analysis})
    plan = Plan(protocol, file, levels, tuple(_expand(protocol, levels)))
    limit = float(protocol.collection.limits.duration)
    for trial in plan:
        if len(trial.id) > MAX_ID:
            raise InputError(
                file,
                "collection.factors",
                trial.id,
                f"gives ids of {len(trial.id)} characters; a folder's name has {MAX_ID} at most: "
                "shorten names of factors or levels",
            )
        if broken := path_fault(protocol.collection, plan.program(trial)):
            raise InputError(file, "collection.motion", trial.id, f"the motion of it {broken}")
        if plan.seconds(trial) > limit:
            raise InputError(
                file,
                "collection.limits.duration",
                f"{limit:g} s",
                f"trial {trial.id} would take {plan.seconds(trial):.1f} s; raise the limit or "
                "shorten the motion",
            )
    return plan


def _enabled(protocol: Protocol, enable: Iterable[str]) -> dict[str, tuple[Level, ...]]:
    factors, levels = protocol.collection.all_factors, _levels(protocol)
    for text in enable:
        name, equals, raw = text.partition("=")
        if not equals and name in factors:
            raise InputError("--enable", "", text, f"must be factor=level, such as {name}=LEVEL")
        if name not in factors:
            raise InputError("--enable", "", text, unknown_factor(name or text, factors))
        factor = factors[name]
        try:
            level: Level = raw if factor.unit is None else _number(raw.strip(), factor.unit)
        except ValueError as error:
            raise InputError("--enable", name, raw, str(error)) from None
        if level not in (*factor.levels(), *factor.optional):
            optional = ", ".join(factor.text(item) for item in factor.optional) or "none"
            raise InputError(
                "--enable",
                name,
                raw,
                f"is not an optional level; optional levels: {optional}"
                f"{did_you_mean(raw, optional.split(', '))}",
            )
        if level not in levels[name]:
            levels[name] = (*levels[name], level)
    return levels


def _levels(protocol: Protocol) -> dict[str, tuple[Level, ...]]:
    return {name: each.levels() for name, each in protocol.collection.all_factors.items()}


def _number(raw: str, unit: str) -> Decimal:
    """A level as a number in a canonical unit, or with any unit of its dimension."""
    return to_decimal(in_canonical_unit(raw, unit))


def condition_id(protocol: Protocol, condition: Mapping[str, Level]) -> str:
    """``depth=2.4mm,direction=45deg``: factors by name, levels as decimal text with unit."""
    parts = []
    for name in sorted(condition):
        level, unit = condition[name], protocol.collection.all_factors[name].unit
        text = level if isinstance(level, str) else canonical(level)
        parts.append(f"{name}={text}{file_text(unit)}")
    return ",".join(parts)


def _expand(protocol: Protocol, levels: Mapping[str, tuple[Level, ...]]) -> Iterator[PlannedTrial]:
    collection = protocol.collection
    factors = collection.all_factors
    outer = [name for name in factors if factors[name].changeover == "person"]
    inner = [name for name in factors if name not in outer]
    repetitions = range(1, collection.repetitions + 1)
    splits: dict[str, str] = {}
    references = collection.references
    index = block = taken = 0

    def trial(
        condition: Mapping[str, Level], trial_id: str, repetition: int, role: Role, split: str
    ) -> PlannedTrial:
        ordered = tuple((name, condition[name]) for name in factors)
        seed = hash_integer(collection.seed, trial_id)
        return PlannedTrial(index, trial_id, role, block, repetition, ordered, split, seed)

    stretches = []
    for outer_levels in product(*(levels[name] for name in outer)):
        fixed = dict(zip(outer, outer_levels, strict=True))
        cells = []
        for inner_levels in product(*(levels[name] for name in inner)):
            condition = {**fixed, **dict(zip(inner, inner_levels, strict=True))}
            cell = condition_id(protocol, condition)
            ids = [f"{cell},r={repetition}" for repetition in repetitions]
            parts = assign(condition, ids, protocol.analysis.split)
            splits.update(zip(ids, parts, strict=True))
            cells.append((cell, condition))
        stretches.append(cells)
    size = collection.repetitions
    if collection.stopping is not None and collection.adaptive is None:
        size = collection.stopping.repetitions
    rounds = [repetitions[first : first + size] for first in range(0, len(repetitions), size)]
    for within, cells in product(rounds, stretches):
        for repetition in within:
            ordered = cells
            if collection.order != "listed":
                ordered = sorted(
                    cells, key=lambda item: hash_integer(collection.seed, repetition, item[0])
                )
            for cell, condition in ordered:
                if references is not None and taken % references.every == 0:
                    number = taken // references.every + 1
                    reference_id = f"reference,{condition_id(protocol, references.condition)}"
                    yield trial(
                        references.condition,
                        f"{reference_id},r={number}",
                        number,
                        "reference",
                        "none",
                    )
                    index += 1
                name = f"{cell},r={repetition}"
                yield trial(condition, name, repetition, "measured", splits.pop(name))
                index += 1
                taken += 1
            block += 1


Trial = PlannedTrial
"""Its former name, which plug-ins import."""
