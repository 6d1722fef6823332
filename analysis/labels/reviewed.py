"""Labels as later steps read them: automatic, or with people's decisions applied.

A decision counts only for the very label it was made on. Where that label has changed since, the
automatic one is used and the decision is counted as stale, so that no decision is applied to a
label that its reviewer never saw.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from sliplab.analysis.campaigns import Collected
from sliplab.analysis.labels import event_labels, labelling
from sliplab.protocols.labelling import Labelling
from sliplab.storage.schema.label import LABELS, OnsetDoubts, TrialLabel
from sliplab.storage.trials.derived import Derived, make_key
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.review import Decision, last
from sliplab.storage.trials.store import TrialStore

VERSION = 1
State = Literal["open", "accepted", "adjusted", "rejected", "stale"]
STATES: tuple[State, ...] = ("open", "accepted", "adjusted", "rejected", "stale")
_AFTER: dict[str, State] = {
    "accept": "accepted",
    "adjust": "adjusted",
    "reject": "rejected",
    "reopen": "open",
}


def label_key(recording: Recording, settings: Labelling) -> str:
    """Return the key of a trial's automatic label."""
    parameters = settings.model_dump(mode="json")
    if recording.frame_source == "none":
        made_of = [recording.checksum, event_labels.VERSION]
        return make_key(LABELS, labelling.VERSION, made_of, parameters)
    return make_key(LABELS, labelling.VERSION, recording.checksum, parameters)


def state_of(decision: Decision | None, key: str) -> State:
    """Return a decision's state for the label with this key; ``stale``: of an older label."""
    if decision is None or decision.verdict == "reopen":
        return "open"
    return _AFTER[decision.verdict] if decision.label == key else "stale"


@dataclass(frozen=True)
class StoreLabels:
    """The labels of a store.

    Attributes:
        reviewed: people's decisions are applied.
    """

    store: TrialStore
    reviewed: bool = False

    def fresh(self, item: Collected, recording: Recording) -> bool:
        """Check that a trial has its automatic label."""
        name = recording.folder.name
        return Derived.of(self.store, LABELS, item.name).fresh(name, _automatic(item, recording))

    def key(self, item: Collected, recording: Recording) -> str:
        """The key of a trial's label: the automatic one's where no decision changes it.

        Raises:
            StoreError: its decision is damaged.
        """
        automatic = _automatic(item, recording)
        decision = self._applied(item, recording)
        if decision is None or decision.verdict == "accept":
            return automatic
        return make_key("reviewed", VERSION, automatic, [decision.verdict, vars(decision.new)])

    def read(self, item: Collected, recording: Recording) -> TrialLabel:
        """A trial's label; a rejected one has no onsets.

        Raises:
            FileNotFoundError: it was never labelled.
            StoreError: its decision is damaged.
        """
        label = Derived.of(self.store, LABELS, item.name).load(recording.folder.name, TrialLabel)
        decision = self._applied(item, recording)
        if decision is None or decision.verdict == "accept":
            return label
        doubt = f"rejected: {decision.why}" if decision.verdict == "reject" else None
        doubts = OnsetDoubts(incipient=doubt, gross=doubt)
        return label.model_copy(update={**vars(decision.new), "doubts": doubts})

    def states(self, campaigns: list[Collected]) -> dict[State, int] | None:
        """Count the trials of each state; None where no decision is requested."""
        if not self.reviewed:
            return None
        found = dict.fromkeys(STATES, 0)
        for item in campaigns:
            for _, recording in item.trials:
                decision = last(self.store, item.name, recording.folder.name)
                found[state_of(decision, _automatic(item, recording))] += 1
        return found

    def _applied(self, item: Collected, recording: Recording) -> Decision | None:
        if not self.reviewed:
            return None
        decision = last(self.store, item.name, recording.folder.name)
        state = state_of(decision, _automatic(item, recording))
        return None if state in {"open", "stale"} else decision


def _automatic(item: Collected, recording: Recording) -> str:
    return label_key(recording, item.settings.labelling)
