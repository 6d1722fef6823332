"""What a new skin asks for: measurements and results of a campaign that belong to the old one."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from sliplab.protocols import Plan
from sliplab.protocols.shown import plural
from sliplab.rigs.core.calibration import COMMANDS, ON_THE_SKIN, measured_on
from sliplab.rigs.rig_file import RigFile, load_rig_file
from sliplab.storage.schema.label import LABELS
from sliplab.storage.trials.context import ContextChange
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.store import Campaign, TrialStore


@dataclass(frozen=True)
class RepeatItem:
    """Something to be done again.

    Attributes:
        what: it, and why.
        command: that does it; empty where a collection does it by itself.
    """

    what: str
    command: str = ""

    def __str__(self) -> str:
        return f"{self.what}: `{self.command}`" if self.command else self.what


def to_repeat(
    store: TrialStore,
    campaign: Campaign,
    plan: Plan,
    change: ContextChange,
    skins: Mapping[str, str | None],
    rig: RigFile | None = None,
) -> list[RepeatItem]:
    """Return what is still to be done since a skin was logged, in the order in which to do it.

    Args:
        change: by which the skin was logged.
        skins: of the committed trials, by id.
        rig: the rig file as it is now; by default that of the last session.

    Raises:
        InputError: the campaign's copy of its rig file cannot be read.
    """
    skin, since = change.context["skin"], datetime.fromisoformat(change.when).astimezone()
    rig = rig or load_rig_file(campaign.folder / "rig.yaml", stored=True)[0]
    new = {trial for trial, found in skins.items() if found == skin}
    return [
        *_at_the_rig(store, rig, plan, skin, since, begun=bool(new)),
        *_references(plan, new),
        *_results(store, campaign, since, new),
    ]


def _at_the_rig(
    store: TrialStore, rig: RigFile, plan: Plan, skin: str, since: datetime, *, begun: bool
) -> Iterator[RepeatItem]:
    if rig.skin.serial != skin and not rig.simulated:
        yield RepeatItem(f"rig file: skin.serial: {skin}, and skin.made")
    for name in ON_THE_SKIN:
        if name == "depth_zero" and plan.protocol.collection.maintenance.rezero is not None:
            continue  # each session finds it
        day = measured_on(rig.calibration, name)
        if (day is None and not rig.simulated) or (day is not None and day < since.date()):
            measured = "is missing" if day is None else f"was measured on {day}, before the change"
            touch = ", as touch_depth" if name == "depth_zero" else ""
            yield RepeatItem(f"calibration.{name}{touch} {measured}", f"{COMMANDS[name]} --rig RIG")
    if not begun:
        command = f"sliplab check PROTOCOL --rig RIG --store {store.folder}"
        yield RepeatItem("clocks and devices, which may have been touched", command)


def _references(plan: Plan, new: set[str]) -> Iterator[RepeatItem]:
    references = [trial.id for trial in plan if trial.role == "reference"]
    if references and not new.intersection(references):
        yield RepeatItem(
            "reference trials: those so far are of another skin; the next one is the first of this "
            "skin, to which later ones are compared"
        )


def _results(
    store: TrialStore, campaign: Campaign, since: datetime, new: set[str]
) -> Iterator[RepeatItem]:
    labels = Derived.of(store, LABELS, campaign.name)
    if missing := sum(labels.key(trial) is None for trial in new):
        yield RepeatItem(f"labels of {plural(missing, 'trial')}", f"sliplab label {store.folder}")
    old = [path.stem for path in _models(store) if path.stat().st_mtime < since.timestamp()]
    if old:
        yield RepeatItem(
            f"networks that never saw this skin ({', '.join(old)}), and their evaluation",
            f"sliplab train {store.folder}",
        )


def _models(store: TrialStore) -> list[Path]:
    return sorted((store.folder / "models").glob("*.pt"))
