"""A reviewer's verdict, checked against what is there now, and kept."""

from __future__ import annotations

from sliplab.flows.reviewing.review_list import TrialList
from sliplab.flows.reviewing.review_trial import Shown
from sliplab.storage.trials import review
from sliplab.storage.trials.review import Decision, Onsets, Verdict


class LabelChanged(ValueError):
    """The label is not the one that was looked at."""


def keep(
    trials: TrialList, shown: Shown, verdict: Verdict, lines: Onsets, who: str, why: str
) -> Decision:
    """Keep what was decided on the trial and label that are shown.

    Args:
        lines: where the onset lines are; they count for ``adjust`` only.

    Raises:
        LabelChanged: the label on the disk is another one by now, or out of date.
        Overtaken: somebody decided meanwhile.
        ValueError: onsets that cannot be, or a rejection without a reason.
        OSError: it cannot be written.
    """
    now = trials.renew(shown.row)
    if now.label != "fresh" or now.key != shown.label_key:
        raise LabelChanged("the label has changed meanwhile: look at it again")
    new = {"adjust": lines, "reject": Onsets()}.get(verdict, shown.onsets)
    for kind, time in vars(new).items():
        if time is not None and not shown.span_s[0] <= time / 1e9 <= shown.span_s[1]:
            name = kind.removesuffix("_ns")
            raise ValueError(f"the {name} onset lies outside the recording")
    return review.decide(
        trials.store, *shown.row.name, verdict, label=shown.label_key, old=shown.onsets, new=new,
        seen=shown.row.decisions, who=who.strip(), why=why,
    )  # fmt: skip
