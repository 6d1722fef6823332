"""Tables of a publication, trials and labels, as Parquet with the meaning of every column."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from sliplab.plugins.publish.archive import (
    ONSET_COLUMNS,
    ONSETS,
    STREAM_COLUMNS,
    STREAMS,
    onset_table,
    stream_table,
)
from sliplab.plugins.publish.publication import Publication, TrialPath
from sliplab.protocols.plan import condition_columns
from sliplab.storage.formats.export_trials import label_table
from sliplab.storage.trials.catalogue import catalogue

TRIALS, LABELLED = "trials", "labels"
"""Names of the tables; their files end in ``.parquet``."""
_TRIAL_COLUMNS = {
    "campaign": "one protocol run on one rig",
    "trial": "id, unique within its campaign",
    "path": "folder of the trial's files, or its file, in this data set",
    "split": "part of the split: train, validation or test; none where no protocol splits",
    "experiment": "kind of the protocol",
    "role": "measured, or what else the trial is for",
    "repetition": "number of the repetition of its condition",
    "block": "number of the block in which it was taken",
    "attempt": "number of the attempt, from 0",
    "simulated": "true if a simulated rig made it",
    "recorded_s": "length of the recording, s",
    "events": "number of events",
    "frames": "number of frames of the first frame camera",
    "frame_source": "what was stored of the frames: video, tracks (places of markers) or none",
    "sync_uncertainty_us": "uncertainty of event times on the trial's time line, us",
    "passed": "true if all gates of the protocol were passed",
}
_LABEL_COLUMNS = {
    "campaign": _TRIAL_COLUMNS["campaign"],
    "trial": "id of the labelled trial",
    "incipient_ns": "first slip of any marker, ns on the trial's time line; missing: none known",
    "gross_ns": "slip of the centre marker, ns on the trial's time line; missing: none known",
    "first_marker": "index of the marker that slipped first",
    "end_ns": "end of the slip, ns on the trial's time line",
    "rule": "rule that gave the onsets",
    "reference": "end of the hold from which displacements count",
    "markers_lost": "marker-frames without a measurement",
    "plate_lost": "frames in which the plate's marker was not seen",
    "camera_moved_px": "largest shift of the camera, px",
    "source": "what was measured: video or tracks",
    "key": "hash of what made the label: trial, clocks, settings and version",
    "doubts.incipient": "why the first onset is in doubt; missing where it is not",
    "doubts.gross": "why the second onset is in doubt; missing where it is not",
}
_BY_RULE = {
    "paper": "by the paper's rule",
    "change_point": "by change points of the tracks",
    "force": "by the force along the plate",
    "references": "by the paper's rule from that end of the hold",
}


def write_tables(
    publication: Publication, folder: Path, path: TrialPath, *, archive: bool = False
) -> dict[str, pa.Table]:
    """Write ``trials.parquet`` and, where there are labels, ``labels.parquet``.

    Args:
        path: gives the path of a trial in the publication.
        archive: also write the slip archive's tables of onsets and streams.

    Returns:
        The tables by name; each field's metadata has its ``description``.

    Raises:
        InputError: an archive has no onsets.
        StoreError: a trial is damaged.
    """
    tables = {TRIALS: _trials(publication, path)}
    parts = [
        label_table(publication.store, campaign.name, sorted(campaign.committed()))
        for campaign in publication.campaigns
    ]
    labels = pd.concat([part for part in parts if len(part)] or [pd.DataFrame()])
    if len(labels):
        meanings = {name: _label_text(name) for name in labels.columns}
        tables[LABELLED] = _table(labels, meanings)
    if archive:
        tables[ONSETS] = _table(onset_table(publication), ONSET_COLUMNS)
        tables[STREAMS] = _table(stream_table(publication), STREAM_COLUMNS)
    for name, table in tables.items():
        pq.write_table(table, folder / f"{name}.parquet", compression="zstd")
    return tables


def _trials(publication: Publication, path: TrialPath) -> pa.Table:
    names = [campaign.name for campaign in publication.campaigns]
    rows = catalogue(publication.store)
    rows = rows[rows["campaign"].isin(names)].dropna(axis=1, how="all").reset_index(drop=True)
    keys = list(zip(rows["campaign"], rows["trial"], strict=True))
    rows.insert(2, "path", [path(*key) for key in keys])
    rows.insert(3, "split", [publication.split(*key) for key in keys])
    factors: dict[str, str] = {}
    units: dict[str, str] = {}
    for _, recording in publication.recordings:
        units |= {name: about.unit or "" for name, about in recording.record.streams.items()}
        for factor, level in recording.described.items():
            (column,) = condition_columns({factor: level})
            unit = level.partition(" ")[2]
            what = "level of the factor" if factor in recording.record.condition else "context:"
            factors[column] = f"{what} {factor}{f', {unit}' if unit else ''}"
    meanings = {name: _TRIAL_COLUMNS.get(name) or factors.get(name) for name in rows.columns}
    return _table(rows, {name: text or _figure(name, units) for name, text in meanings.items()})


def _figure(name: str, units: Mapping[str, str]) -> str:
    """Describe a column of a named stream: `NAME_events`, `force_normal_peak_n`.

    Args:
        units: of the streams that have one, by name; empty for the others.
    """
    # names may have underscores: the longest one that fits is meant
    stream = max((known for known in units if name.startswith(f"{known}_")), key=len, default="")
    stream = stream or name.partition("_")[0]
    figure = name.removeprefix(f"{stream}_")
    if name.endswith(("_events", "_frames")):
        return f"number of {name.rpartition('_')[2]} of the camera {name.rpartition('_')[0]}"
    unit = ", N" if figure.endswith("_n") else ""
    if units.get(stream):
        unit = f", {units[stream]}"
    return f"{figure.removesuffix('_n').replace('_', ' ')} of the stream {stream}{unit}"


def _label_text(name: str) -> str:
    rule, _, rest = name.partition(".")
    if name in _LABEL_COLUMNS or rule not in _BY_RULE:
        return _LABEL_COLUMNS.get(name, name.replace(".", ": ").replace("_", " "))
    if rule == "references":
        end, _, rest = rest.partition(".")
        rule_text = f"{_BY_RULE[rule]}, {end}"
    else:
        rule_text = _BY_RULE[rule]
    return f"{_LABEL_COLUMNS.get(rest, rest)}; {rule_text}"


def _table(rows: pd.DataFrame, meanings: dict[str, str]) -> pa.Table:
    table = pa.Table.from_pandas(rows, preserve_index=False).replace_schema_metadata()
    for at, name in enumerate(table.column_names):
        column = table.column(at)
        kind = pa.string() if pa.types.is_null(column.type) else column.type
        kind = pa.string() if pa.types.is_large_string(kind) else kind
        field = pa.field(name, kind, metadata={"description": meanings[name]})
        table = table.set_column(at, field, column.cast(kind))
    return table
