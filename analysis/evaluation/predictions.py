"""Predictions of any model on the test windows: a table, checked and judged as our networks are.

A row is a window of `analysis.windows.window_table`, and has ``trial`` (with ``campaign``, where
several have such a trial), ``start_ns`` and one of

- ``class``: name or number of the class;
- ``no_slip``, ``incipient``, ``gross``: probabilities that add up to 1, read to a millionth;
- ``no_slip_spikes``, ``incipient_spikes``, ``gross_spikes``: whole numbers.

Other columns are ignored. The protocol's margin is in spikes; in the others the margin is a share,
by default 0: any lead decides.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import pandas as pd

from sliplab.analysis.campaigns import Collected, training_campaigns
from sliplab.analysis.evaluation.networks import (
    Judgement,
    OtherNetwork,
    counts_step,
    data_key,
    file_judgement,
)
from sliplab.analysis.labels.reviewed import StoreLabels
from sliplab.analysis.metrics.classification import CLASSES
from sliplab.analysis.trial_work import KeepTrials
from sliplab.analysis.windows.dataset import TrialId
from sliplab.analysis.windows.window_table import LabelledWindows, trial_windows, whole_ns
from sliplab.protocols.detection import Detection
from sliplab.protocols.errors import InputError
from sliplab.protocols.later import need
from sliplab.protocols.shown import plural
from sliplab.storage.trials.derived import Arrays, Derived, make_key

I64 = npt.NDArray[np.int64]
Kind = Literal["class", "probability", "spikes"]
COLUMNS: dict[Kind, tuple[str, ...]] = {
    "class": ("class",),
    "probability": CLASSES,
    "spikes": tuple(f"{name}_spikes" for name in CLASSES),
}
"""Columns by what they hold."""
OUTPUTS = "outputs_per_class"
"""Attribute of a table: output neurons of a class, by which the protocol's margin counts."""
MOST_SPIKES = 1_000_000
"""Spikes of a class in a window that a table may state."""
ROUNDING = 0.02
"""By which three probabilities may miss 1, as ones with two digits do."""
_SCALE: dict[Kind, int] = {"class": 1, "probability": 1_000_000, "spikes": 1}
_SHOWN = 3
"""Places that a message names of each fault."""


@dataclass(frozen=True)
class PredictionJudgement(Judgement):
    """Predictions that fit the store's test windows.

    Attributes:
        outputs: of each trial, as `Judgement.count` keeps them for a network.
        scale: of the outputs against the unit of the rules' margin.
    """

    outputs: dict[TrialId, tuple[str, Arrays]] = field(default_factory=dict)
    scale: int = 1

    @property
    def applied(self) -> dict[str, Detection]:
        """The rules in the unit of the outputs."""
        return {
            name: rule.model_copy(update={"margin": rule.margin * self.scale})
            for name, rule in self.rules.items()
        }

    def count(self, keep: KeepTrials, threads: int | None = None) -> None:
        """Store the outputs, which another program made."""
        step = counts_step(self.network)
        for trial, (key, arrays) in self.outputs.items():
            Derived.of(self.store, step, trial.campaign).write(trial.trial, key, {}, arrays)


def read_predictions(path: Path) -> pd.DataFrame:
    """Return the table of a ``.csv`` or ``.parquet`` file.

    Raises:
        InputError: it cannot be read, or is neither.
        ModuleNotFoundError: a Parquet file, and the extra ``parquet`` is not installed.
    """
    try:
        if path.suffix.lower() == ".csv":
            return pd.read_csv(path, dtype={"campaign": str, "trial": str, "class": str})
        if path.suffix.lower() == ".parquet":
            need("pyarrow")
            return pd.read_parquet(path)
    except OSError as error:
        reason = error.strerror or str(error)
        raise InputError(path, "", None, f"cannot be read: {reason}") from None
    except ValueError as error:
        raise InputError(path, "", None, f"is no table: {error}") from None
    raise InputError(path, "", None, "must be a table of predictions, .csv or .parquet")


def prediction_judgement(
    labels: StoreLabels,
    campaigns: list[Collected],
    source: Path | pd.DataFrame,
    margin: float | None = None,
    smoothing: int | None = None,
) -> PredictionJudgement:
    """Return predictions as something to judge, after all checks.

    Args:
        source: the table, or its file.
        margin, smoothing: instead of the protocols' own; see this module.

    Raises:
        InputError: the table; all its faults at once.
        StoreError: a trial has no label yet.
    """
    data_key(labels, campaigns)  # every test trial has a label
    path = source if isinstance(source, Path) else None
    where = "--predictions" if path is None else str(path)
    given = read_predictions(source) if isinstance(source, Path) else source
    kind, table, faults = _checked(given, where)
    if kind != "spikes":
        margin = 0.0 if margin is None else margin
        if margin > 1:
            faults.append(InputError("--margin", "", margin, "must be a fraction from 0 to 1"))
    known = list(trial_windows(labels, campaigns, "test"))
    found = _outputs(table, known, where, faults)
    outputs = {}
    for it in known:
        starts, values = it.starts_ns, found[it.trial]
        run, samples = (np.searchsorted(starts, some) for some in (it.run_ns, it.sample_ns))
        arrays: Arrays = {"counts": values[run], "end_ns": it.run_ns + it.length_ns}
        if len(it.sample_ns):
            arrays |= {"sample_counts": values[samples], "y": it.y}
        key = make_key("predictions", 1, [it.recording.checksum, it.key], values.tolist())
        outputs[it.trial] = key, arrays
    settings = training_campaigns(campaigns)[0].settings
    per_class = given.attrs.get(OUTPUTS, settings.network.outputs_per_class)
    network = OtherNetwork(
        "predictions" if path is None else f"predictions-{path.stem}",
        "predictions" if path is None else path.name,
        "".join(key for key, _ in outputs.values()).encode(),
        None,
        settings.windows,
        per_class if _is_count(per_class) else settings.network.outputs_per_class,
        "predictions",
    )
    judgement = file_judgement(labels, campaigns, network, margin, smoothing)
    return PredictionJudgement(**vars(judgement), outputs=outputs, scale=_SCALE[kind])


def _is_count(value: object) -> bool:
    return isinstance(value, int | float) and 0 < value < MOST_SPIKES


def _checked(table: pd.DataFrame, where: str) -> tuple[Kind, pd.DataFrame, list[InputError]]:
    """Return what the table holds, and it with whole outputs in the columns 0, 1 and 2.

    Rows without a time are left out. The last value are the faults of cells that are no values.

    Raises:
        InputError: a column is missing.
    """
    kinds = [kind for kind, names in COLUMNS.items() if set(names) <= set(table.columns)]
    faults = [
        InputError(where, name, None, "is missing")
        for name in ("trial", "start_ns")
        if name not in table.columns
    ]
    if len(kinds) != 1:
        ways = " or ".join(", ".join(names) for names in COLUMNS.values())
        there = "there are several of these" if kinds else f"there are {', '.join(table.columns)}"
        faults.append(InputError(where, "", None, f"must have the columns {ways}; {there}"))
    if faults:
        raise InputError.joined(faults)
    (kind,) = kinds
    names = COLUMNS[kind]
    starts, whole = whole_ns(table["start_ns"])
    result = table[[name for name in ("campaign", "trial") if name in table.columns]].astype(str)
    if kind == "class":
        number = {name: k for k, name in enumerate(CLASSES)}
        number |= {str(k): k for k in number.values()}
        of_class = table["class"].astype(str).map(number)
        good = of_class.notna().to_numpy()
        values = np.eye(len(CLASSES), dtype=np.int64)[of_class.fillna(0).astype(int)]
        right = f"must be one of {', '.join(CLASSES)}"
    else:
        cells = table[list(names)].apply(pd.to_numeric, errors="coerce").to_numpy(np.float64)
        most = 1 if kind == "probability" else MOST_SPIKES
        good = ((cells >= 0) & (cells <= most)).all(axis=1)  # NaN is neither
        cells = np.where(good[:, None], cells, 0)
        right = "must be from 0 to 1, and add up to 1"
        if kind == "probability":
            good &= np.abs(cells.sum(axis=1) - 1) <= ROUNDING
        if kind == "spikes":
            good &= (cells % 1 == 0).all(axis=1)
            right = f"must be whole numbers from 0 to {MOST_SPIKES:,}"
        values = np.rint(cells * _SCALE[kind]).astype(np.int64)
    for key, fits, words in (
        ("start_ns", whole, "must be whole nanoseconds"),
        (", ".join(names), good, right),
    ):
        if not fits.all():
            rows = np.flatnonzero(~fits)
            faults.append(InputError(where, key, None, f"{words}; {_rows(rows)}"))
    result["start_ns"] = starts
    result[list(range(len(CLASSES)))] = values
    return kind, result[whole], faults


def _outputs(
    table: pd.DataFrame, known: list[LabelledWindows], where: str, faults: list[InputError]
) -> dict[TrialId, I64]:
    """Return the outputs (n, 3) of each trial's windows, in the order of time.

    Args:
        faults: that were found already.

    Raises:
        InputError: with all that does not fit.
    """
    if "campaign" not in table.columns:
        holders = pd.Series([it.trial.campaign for it in known], [it.trial.trial for it in known])
        twice = sorted(set(holders.index[holders.index.duplicated()]) & set(table["trial"]))
        if twice:
            text = f"is needed: several campaigns have {_listed(twice)}"
            raise InputError.joined([*faults, InputError(where, "campaign", None, text)])
        table = table.assign(campaign=table["trial"].map(holders))
    rows = {
        TrialId(*map(str, key)): part
        for key, part in table.groupby(["campaign", "trial"], dropna=False)
    }
    unknown = [f"{of.trial}" for of in rows if of not in {it.trial for it in known}]
    if unknown:
        text = f"{_listed(unknown)}: no labelled test trial of the store"
        faults.append(InputError(where, "trial", None, text))
    found: dict[TrialId, I64] = {}
    empty = table.iloc[:0]
    missing, double, strange = [], [], []
    for it in known:
        part = rows.get(it.trial, empty)
        given = part["start_ns"].to_numpy(np.int64)
        once, place, count = np.unique(given, return_index=True, return_counts=True)
        starts = it.starts_ns
        missing += list(_places(it.trial, np.setdiff1d(starts, once)))
        double += list(_places(it.trial, once[count > 1]))
        strange += list(_places(it.trial, np.setdiff1d(once, starts)))
        found[it.trial] = part[list(range(len(CLASSES)))].to_numpy(np.int64)[place]
    for places, words in (
        (missing, "missing"),
        (double, "more than once"),
        (strange, "unknown, `Store.windows` lists the right ones"),
    ):
        if places:
            text = f"{words}: {plural(len(places), 'window')}: {_listed(places)}"
            faults.append(InputError(where, "start_ns", None, text))
    if faults:
        raise InputError.joined(faults)
    return found


def _places(trial: TrialId, starts: I64) -> Iterator[str]:
    return (f"{start} of {trial.trial}" for start in starts.tolist())


def _rows(rows: npt.NDArray[Any]) -> str:
    return f"not so in {plural(len(rows), 'row')}: {_listed([str(row) for row in rows.tolist()])}"


def _listed(names: list[str]) -> str:
    more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return ", ".join(names[:_SHOWN]) + more
