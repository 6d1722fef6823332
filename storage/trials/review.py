"""Review decisions about automatic labels: stored separately, append-only, one file per decision.

    STORE/review/CAMPAIGN/TRIAL/000001.json   the first decision about a trial's label, and so on

A decision names the label that it was made on by that label's key, which shows whether the label
has changed since. The last decision counts; the earlier ones remain. Of two people who decide on
one trial at the same time, both decisions are stored, or the second person is warned.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from sliplab.storage.errors import StoreError
from sliplab.storage.files import read_json, safe_name
from sliplab.storage.streams import Json
from sliplab.storage.trials.journal import Entry, Journal, signature
from sliplab.storage.trials.store import TrialStore

Verdict = Literal["accept", "adjust", "reject", "reopen"]
FOLDER = "review"
_FORMAT = 1


class Overtaken(StoreError):
    """The last decision is not the one that was seen; the message names it."""


@dataclass(frozen=True)
class ReviewedOnsets:
    """Two onsets on the trial's time line, ns; None if there is none, or it is not known."""

    incipient_ns: int | None = None
    gross_ns: int | None = None

    def problem(self) -> str | None:
        """Return why these cannot be the onsets of a trial; None if they can."""
        if self.gross_ns is None:
            return None
        if self.incipient_ns is None:
            return "a gross onset needs an incipient one"
        if self.gross_ns < self.incipient_ns:
            return "the gross onset must not come before the incipient one"
        return None

    @staticmethod
    def parse(data: Json) -> ReviewedOnsets:
        """Check onsets that were read.

        Raises:
            ValueError, KeyError, TypeError: they cannot be right.
        """
        values = {name: data[name] for name in ("incipient_ns", "gross_ns")}
        for name, value in values.items():
            if value is not None and (isinstance(value, bool) or not isinstance(value, int)):
                raise ValueError(f"{name} = {value!r}: must be whole nanoseconds")
            if value is not None and abs(value) >= 2**63:
                raise ValueError(f"{name} = {value}: must be less than 2^63 ns in size")
        return ReviewedOnsets(**values)


@dataclass(frozen=True, kw_only=True)
class Decision(Entry):
    """One decision of a person about one label.

    Attributes:
        verdict: ``accept`` (the label holds), ``adjust`` (the onsets are these), ``reject`` (the
            trial is not to be used) or ``reopen`` (the label is undecided again).
        label: key of the label that it was made on.
        old: the label's onsets; new: those that hold by this decision.
    """

    verdict: Verdict
    label: str
    old: ReviewedOnsets
    new: ReviewedOnsets

    def __str__(self) -> str:
        return self._summary(self.verdict)


def decide(
    store: TrialStore,
    campaign: str,
    trial: str,
    verdict: Verdict,
    *,
    label: str,
    old: ReviewedOnsets,
    new: ReviewedOnsets,
    seen: int,
    who: str = "",
    why: str = "",
) -> Decision:
    """Keep a decision, after all that were made before.

    Args:
        label: key of the label that was checked.
        seen: number of the last decision that was checked, 0 for none.

    Raises:
        Overtaken: the last decision is not `seen`; nothing was written.
        ValueError: a rejection without a reason, or onsets that cannot be.
        OSError: it cannot be written.
    """
    if verdict not in get_args(Verdict):
        raise ValueError(f"verdict = {verdict!r}: must be one of {', '.join(get_args(Verdict))}")
    if verdict == "reject" and not why.strip():
        raise ValueError("a rejection needs a reason")
    if verdict == "adjust" and (problem := new.problem()) is not None:
        raise ValueError(problem)
    signed = signature(who, why.strip())
    made = Decision(number=seen + 1, verdict=verdict, label=label, old=old, new=new, **signed)
    journal = _journal(store, campaign, trial)
    data = {
        "format": _FORMAT,
        "verdict": verdict,
        "label": label,
        "old": vars(old),
        "new": vars(new),
        **signed,
    }
    if max(journal.numbers(), default=0) == seen and journal.add(made.number, data):
        return made
    newest = last(store, campaign, trial)
    if newest is None or newest.number < seen:  # moved away, as the message of a damaged one says
        raise Overtaken(f"{trial}: the decision that was seen is there no longer")
    raise Overtaken(f"{trial}: there is a newer decision:  {newest}")


def history(store: TrialStore, campaign: str, trial: str) -> list[Decision]:
    """Return all decisions about a trial in their order.

    Raises:
        StoreError: one of them is damaged.
    """
    journal = _journal(store, campaign, trial)
    return [_read(journal, number) for number in journal.numbers()]


def last(store: TrialStore, campaign: str, trial: str) -> Decision | None:
    """Return the decision that counts; None if there is none.

    Raises:
        StoreError: it is damaged.
    """
    journal = _journal(store, campaign, trial)
    numbers = journal.numbers()
    return _read(journal, numbers[-1]) if numbers else None


def counts(store: TrialStore, campaign: str) -> dict[str, int]:
    """Return the number of each trial's last decision; trials without one are left out."""
    folder = store.folder / FOLDER / safe_name(campaign)
    if not folder.is_dir():
        return {}
    # not how many there are: damaged ones may have been moved away
    found = {path.name: max(Journal(path).numbers(), default=0) for path in folder.iterdir()}
    return {name: count for name, count in found.items() if count}


def _journal(store: TrialStore, campaign: str, trial: str) -> Journal:
    return Journal(store.folder / FOLDER / safe_name(campaign) / safe_name(trial))


def _read(journal: Journal, number: int) -> Decision:
    path = journal.path(number)
    try:
        data = read_json(path)
        if data["format"] > _FORMAT:
            raise StoreError(f"{path}: was written by a newer version of SlipLab: update it")
        if data["verdict"] not in get_args(Verdict):
            raise ValueError(f"verdict = {data['verdict']!r}")
        texts = {name: str(data[name]) for name in ("who", "when", "why", "host", "label")}
        old, new = ReviewedOnsets.parse(data["old"]), ReviewedOnsets.parse(data["new"])
        if data["verdict"] == "adjust" and (problem := new.problem()) is not None:
            raise ValueError(problem)
    except StoreError:
        raise
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise StoreError(
            f"{path}: is not a decision ({type(error).__name__}: {error}); restore it from a copy, "
            "or move it away and decide again"
        ) from None
    return Decision(number=number, verdict=data["verdict"], old=old, new=new, **texts)
