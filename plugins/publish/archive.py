"""Tables of the slip archive: every onset with the interval that it lies in, and every stream.

One convention for recordings of any sensor. An onset is a time on the trial's time line with the
ends of its 95 % interval; what is not known is missing. The interval is the label's own. Where the
rule states none, it is a period of the stream that the onset was seen in, to either side: that of
frames, or of forces for the rule of force. To it comes the uncertainty of that stream's clock.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pandas as pd

from sliplab.plugins.publish.publication import Publication
from sliplab.protocols.errors import InputError
from sliplab.storage.schema.label import KINDS, LABELS, ChangePoints, Kind, TrialLabel
from sliplab.storage.streams import FRAMES_KIND, Json
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.recording import Recording

ONSETS, STREAMS = "onsets", "streams"
"""Names of the tables; their files end in ``.parquet``."""
ONSET_COLUMNS = {
    "campaign": "one protocol run on one rig, or one recorded folder",
    "trial": "id, unique within its campaign",
    "onset": "incipient: the first part of the contact slips; gross: all of it, or its centre",
    "t_ns": "onset, ns on the trial's time line; missing: none is known",
    "low_ns": "lower end of its 95 % interval, ns; missing: no interval is known",
    "high_ns": "upper end of its 95 % interval, ns",
    "interval": "what the interval is of: label, or period of the stream and its clock",
    "rule": "what gave the onset: paper, change_point, force, or given by hand or with the data",
    "source": "what was measured: video, tracks, events, or given",
    "doubt": "why the onset is in doubt; missing where it is not",
    "simulated": "true if a simulated rig made the trial",
}
STREAM_COLUMNS = {
    "campaign": ONSET_COLUMNS["campaign"],
    "trial": ONSET_COLUMNS["trial"],
    "stream": "name of the stream",
    "kind": "events, frames, wrench, scalar, or another kind",
    "unit": "of scalar readings; missing for the others",
    "columns_px": "columns of the picture; missing where there is none",
    "rows_px": "rows of the picture",
    "clock_uncertainty_us": "uncertainty (95 %) of the stream's times on the time line, us",
}


def onset_table(publication: Publication) -> pd.DataFrame:
    """Return one row per onset, two per labelled trial.

    Raises:
        InputError: no trial has a label.
        StoreError: a trial or a label is damaged.
    """
    rows = [row for one in _labelled(publication) for row in _onsets(*one)]
    if not rows:
        raise InputError(
            "--as", "", "archive", "needs onsets: run `sliplab label` or `sliplab review` first"
        )
    return pd.DataFrame(rows, columns=list(ONSET_COLUMNS)).convert_dtypes()


def stream_table(publication: Publication) -> pd.DataFrame:
    """Return one row a stream of each trial. Raises StoreError where a trial is damaged."""
    rows = []
    for campaign, recording in publication.recordings:
        for name in recording.streams():
            about = recording.record.streams.get(name)
            size = _size_px(recording, name)
            rows.append(
                {
                    "campaign": campaign.name,
                    "trial": recording.folder.name,
                    "stream": name,
                    "kind": name if about is None else about.kind,
                    "unit": None if about is None else about.unit,
                    "columns_px": None if size is None else size[0],
                    "rows_px": None if size is None else size[1],
                    "clock_uncertainty_us": _uncertainty_ns(recording, name) / 1e3,
                }
            )
    return pd.DataFrame(rows, columns=list(STREAM_COLUMNS)).convert_dtypes()


def _labelled(publication: Publication) -> Iterator[tuple[str, Recording, TrialLabel]]:
    for campaign, recording in publication.recordings:
        stored = Derived.of(publication.store, LABELS, campaign.name)
        try:
            yield campaign.name, recording, stored.load(recording.folder.name, TrialLabel)
        except FileNotFoundError:
            continue


def _onsets(campaign: str, recording: Recording, label: TrialLabel) -> Iterator[Json]:
    if label.spans and all(label.at_ns(kind) is None for kind in KINDS):
        return  # came with classes: nothing is known of its onsets
    for kind in KINDS:
        at_ns = label.at_ns(kind)
        low_ns, high_ns, what = None, None, None
        if at_ns is not None:
            low_ns, high_ns, what = _interval(recording, label, kind, at_ns)
        yield {
            "campaign": campaign,
            "trial": recording.folder.name,
            "onset": kind,
            "t_ns": at_ns,
            "low_ns": low_ns,
            "high_ns": high_ns,
            "interval": what,
            "rule": label.rule,
            "source": label.source,
            "doubt": label.doubts.of(kind),
            "simulated": recording.simulated,
        }


def _interval(
    recording: Recording, label: TrialLabel, kind: Kind, at_ns: int
) -> tuple[int | None, int | None, str | None]:
    """Return the ends of an onset's interval, and what it is of; None where none is known."""
    if label.intervals is not None and label.rule in ("paper", "given"):
        own = label.intervals.incipient_ns if kind == "incipient" else label.intervals.gross_ns
        return (None, None, None) if own is None else (*own, "label")
    if label.rule == "change_point" and isinstance(label.change_point, ChangePoints):
        found = label.change_point
        where = [k for k, slip_ns in enumerate(found.per_marker_ns) if slip_ns == at_ns]
        if where and found.low_ns and found.low_ns[where[0]] >= 0:
            return found.low_ns[where[0]], found.high_ns[where[0]], "label"
    stream = "force" if label.rule == "force" else FRAMES_KIND
    if label.rule == "given" or stream not in recording.streams():
        return None, None, None
    times_ns = recording.frame_times() if stream == FRAMES_KIND else recording.samples(stream)["t"]
    within_ns = round(float(np.median(np.diff(times_ns))) + _uncertainty_ns(recording, stream))
    return at_ns - within_ns, at_ns + within_ns, "period and clock"


def _uncertainty_ns(recording: Recording, stream: str) -> float:
    known = recording.clocks.devices().get(stream)
    if known is None or known.uncertainty_ns is None:
        return np.nan
    return float(known.uncertainty_ns)


def _size_px(recording: Recording, stream: str) -> tuple[int, int] | None:
    about = recording.record.streams.get(stream)
    if about is not None:
        return about.size_px
    geometry = recording.record.geometry
    return geometry.event_px if stream == "events" else geometry.frame_px
