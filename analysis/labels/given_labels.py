"""Labels that came with an imported recording, as later steps read them."""

from __future__ import annotations

from sliplab.storage.schema.label import ClassSpan, OnsetDoubts, OnsetIntervals, TrialLabel
from sliplab.storage.trials.recording import Recording

UNKNOWN = "the data set gives no such onset"


def given_label(recording: Recording) -> TrialLabel:
    """Return the label that a trial came with: its onsets, or the classes of its parts.

    Onsets get an interval where the data set states their uncertainty. A trial without a label
    gets one without onsets, whose doubts say so.

    Raises:
        ValueError: the trial was collected here, or imported without an adapter.
    """
    origin = recording.record.imported
    if origin is None or origin.span_ns is None:
        raise ValueError(
            "labelling.rule = given: the trial came without labels; use the rule paper or "
            "change_point"
        )
    end_ns = recording.motion_ns[1]
    given = origin.given
    if given is not None and given.spans:
        spans = tuple(
            ClassSpan(start_ns=span.start_ns, end_ns=span.end_ns, name=span.name)
            for span in given.spans
        )
        return TrialLabel(
            rule="given",
            source="given",
            incipient_ns=None,
            gross_ns=None,
            end_ns=end_ns,
            spans=spans,
        )
    incipient, gross = (None, None) if given is None else (given.incipient_ns, given.gross_ns)
    gross = None if incipient is None else gross  # without the first slip nothing is made of it
    label = TrialLabel(
        rule="given",
        source="given",
        incipient_ns=incipient,
        gross_ns=gross,
        end_ns=end_ns,
        doubts=OnsetDoubts(
            incipient=UNKNOWN if incipient is None else None,
            gross=UNKNOWN if gross is None else None,
        ),
    )
    if given is None or given.uncertainty_ns is None:
        return label
    error = round(given.uncertainty_ns)

    def around(onset: int | None) -> tuple[int, int] | None:
        return None if onset is None else (onset - error, onset + error)

    intervals = OnsetIntervals(incipient_ns=around(incipient), gross_ns=around(gross))
    return label.model_copy(update={"intervals": intervals})
