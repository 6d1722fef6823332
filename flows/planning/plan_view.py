"""Display of a plan as tables or JSON: trials in order, totals, and a simulated rig's scene."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypedDict

from sliplab.flows.running import console
from sliplab.protocols import Plan
from sliplab.protocols.shown import plural

if TYPE_CHECKING:  # a plan without a rig is answered before numpy is loaded
    from sliplab.rigs.physics_levels import LevelChoice, SlipExpected
    from sliplab.rigs.rig_file import RigFile
    from sliplab.storage.streams import Json

MOST_STRETCHES = 8
"""Stretches without a person that are printed one by one."""


class SceneJson(TypedDict):
    """`PlannedScene` as part of a plan's JSON."""

    level: str
    reason: str
    expected: SlipExpected | None


class TaskJson(TypedDict):
    """A task before a trial."""

    kind: str
    by_person: bool
    prompt: str


class TrialRow(TypedDict):
    """One trial of a plan; `condition` by factor, with units; `seconds` of motion."""

    index: int
    id: str
    role: str
    block: int
    repetition: int
    condition: dict[str, str]
    split: str | None
    seconds: float
    before: list[TaskJson]


class PlanJson(TypedDict):
    """A plan as `sliplab plan --json` prints it.

    Attributes:
        bytes: None without a rig; scene: None but on a simulated rig.
        stretches: first and last trial of each stretch without a person.
        claims: predictions of a pilot about them, as in power.json; None without one.
    """

    protocol: str
    trials: list[TrialRow]
    count: int
    seconds: float
    bytes: int | None
    scene: SceneJson | None
    stretches: list[tuple[int, int]]
    warnings: list[str]
    claims: Json | None


@dataclass(frozen=True)
class Forecast:
    """A pilot's predictions about a plan's claims: a table with lines below it, and all as data."""

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    lines: Sequence[str]
    data: Json

    def print(self) -> None:
        """Print it."""
        console.print_table(self.title, self.columns, self.rows, spare=0)
        for line in self.lines:
            console.say(line)


@dataclass(frozen=True)
class PlannedScene:
    """A simulated rig's level of physics for a plan, and the slip to expect.

    Attributes:
        expected: see `rigs.physics_levels.SlipExpected`.
    """

    choice: LevelChoice
    expected: SlipExpected | None

    def as_json(self) -> SceneJson:
        """Return it as part of the plan's JSON."""
        return {
            "level": self.choice.name,
            "reason": self.choice.reason,
            "expected": self.expected,
        }

    def as_pairs(self) -> dict[str, str]:
        """Return titles and values to print."""
        pairs = {"physics": f"{self.choice.name}: {self.choice.reason}"}
        if self.expected is not None:
            for title, (low, high) in (
                ("first slip after the start (s)", self.expected["first_slip_s"]),
                ("incipient slip lasts (s)", self.expected["incipient_s"]),
            ):
                pairs[title] = f"{low:.2f} to {high:.2f} (simulated, assuming uniform friction)"
        return pairs


def scene_of(rig: RigFile, plan: Plan) -> PlannedScene | None:
    """Return the scene of a plan, None on a real rig."""
    from sliplab.rigs.physics_levels import levels_of

    levels = levels_of(rig)
    if levels is None:
        return None
    return PlannedScene(levels.choose(rig, plan), levels.expected(rig, plan))


def plan_json(
    found: Plan, needed: int | None, scene: PlannedScene | None, claims: Forecast | None
) -> PlanJson:
    """Return the plan as one JSON object.

    Args:
        needed: its bytes; None without a rig.
        claims: predictions of a pilot about them; None without one.
    """
    rows: list[TrialRow] = [
        {
            "index": trial.index,
            "id": trial.id,
            "role": trial.role,
            "block": trial.block,
            "repetition": trial.repetition,
            "condition": found.describe(trial),
            "split": trial.split,
            "seconds": found.seconds(trial),
            "before": [
                {"kind": task.kind, "by_person": task.by_person, "prompt": task.prompt}
                for task in found.tasks_before(trial)
            ],
        }
        for trial in found
    ]
    return {
        "protocol": found.protocol.name,
        "trials": rows,
        "count": len(found),
        "seconds": found.total_seconds,
        "bytes": needed,
        "scene": scene.as_json() if scene else None,
        "stretches": found.stretches(),
        "warnings": found.warnings(),
        "claims": claims.data if claims else None,
    }


def _stretches(found: Plan) -> str:
    """Return how many trials need no person in between; of many stretches, how many there are."""
    sizes = [last - first + 1 for first, last in found.stretches()]
    if len(sizes) > MOST_STRETCHES:
        return f"{len(sizes)} of {min(sizes)} to {max(sizes)} trials"
    return ", ".join(plural(size, "trial") for size in sizes)


def _claims(found: Plan) -> Iterator[str]:
    """Yield lines about the claims of a plan, and their effect on it."""
    collection = found.protocol.collection
    if collection.stopping is None:
        return
    if (choice := collection.adaptive) is not None:
        how = (
            f"every batch of {plural(choice.batch, 'trial')}, which are chosen then, not "
            "in this order"
        )
    else:
        often = collection.stopping.repetitions
        how = f"{'each' if often == 1 else f'every {often}'} repetition of all conditions"
    yield f"The campaign ends when these claims are settled; they are looked at after {how}:"
    for claim in collection.stopping.claims:
        yield f"  {claim.text(collection.all_factors)}"


def print_plan(
    found: Plan, needed: int | None, scene: PlannedScene | None, claims: Forecast | None
) -> None:
    """Print the plan as tables; arguments as of `plan_json`."""
    factors = list(found.protocol.collection.all_factors)
    table = []
    for trial in found:
        known = found.describe(trial)
        before = ", ".join(
            f"{task.kind} (person)" if task.by_person else task.kind
            for task in found.tasks_before(trial)
        )
        table.append(
            [
                trial.index,
                trial.block,
                *(known[name].split()[0] for name in factors),
                trial.repetition,
                trial.split if trial.role == "measured" else trial.role,
                f"{found.seconds(trial):.1f}",
                before,
            ]
        )
    units = {name: factor.unit for name, factor in found.protocol.collection.all_factors.items()}
    named = [f"{name} ({units[name]})" if units[name] else name for name in factors]
    columns = ["#", "block", *named, "rep.", "split", "motion (s)", "before"]
    console.print_table(f"{found.file}: {found.protocol.title}", columns, table, limit=40)
    console.print_pairs(
        "Total",
        {
            "trials": len(found),
            "motion": console.duration(found.total_seconds),
            "disk": console.size(needed) if needed is not None else "give --rig to estimate",
            "unattended stretches": _stretches(found),
        },
    )
    if scene is not None:
        console.print_pairs("The simulated scene", scene.as_pairs())
    for line in _claims(found):
        console.say(line)
    if claims is not None:
        claims.print()
    for warning in found.warnings():
        console.say(f"note: {warning}")
