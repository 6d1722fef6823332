"""The report's words on collecting: what is there, how good it is over time, and wear."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.stats import theilslopes

from sliplab.analysis.campaigns import Collected
from sliplab.analysis.quality import hold_rate
from sliplab.analysis.report.figures import campaign as figures
from sliplab.analysis.report.page import Figure, Section, Table, number
from sliplab.flows.reporting import results
from sliplab.protocols import Trial
from sliplab.protocols.factors import Level
from sliplab.storage.schema.label import LABELS, TrialLabel
from sliplab.storage.schema.trial import Gate
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import Store

Json = dict[str, Any]

_COLUMNS = (
    "campaign", "experiment", "planned", "committed", "planned (min)", "taken (min)",
    "planned (MB)", "taken (MB)",
)  # fmt: skip
_FEWEST = 3
"""Reference trials from which a slope can be told."""
WEAR = (
    ("hold_events_per_s", "events in the hold\n(1/s)"),
    ("first_slip_ms", "motion to first slip\n(ms)"),
)
"""What is compared of reference trials, and its axis."""


def collected(campaigns: list[Collected], summary: Json, simulated: bool) -> Section:
    """What there is of what was planned."""
    pictures = [figure for item in campaigns if (figure := _grid(item, simulated)) is not None]
    rows = []
    for item in campaigns:
        known = summary["planned"][item.name]
        rows.append(
            [
                item.name,
                item.experiment,
                str(len(item.plan)),
                str(len(item.trials)),
                number(known["seconds"] / 60, 2),
                number(known["seconds_collected"] / 60, 2),
                number(known["bytes"] / 1e6, 1),
                number(known["bytes_collected"] / 1e6, 1),
            ]
        )
    quality = summary["quality"]
    return Section(
        "What was collected",
        [
            f"{quality['committed']} of {quality['planned']} planned trials are committed; "
            f"{quality['retaken']} attempts failed a quality gate and were taken again or set "
            f"aside, {quality['quarantined']} attempts stand in quarantine"
            + (
                f", {quality['interrupted']} more were broken off by a stop."
                if quality["interrupted"]
                else "."
            ),
            f"Kept of the outside camera: {results.source_text(summary)}.",
        ],
        pictures,
        [Table(_COLUMNS, rows, "Minutes are of the trials' own clocks, people's work left out.")],
    )


def _grid(item: Collected, simulated: bool) -> Figure | None:
    """Trials by the first two factors; None where there are fewer."""
    factors = item.plan.protocol.collection.factors
    names = list(factors)[:2]
    if len(names) < 2:
        return None
    levels = [item.plan.enabled[name] for name in names]
    shape = (len(levels[0]), len(levels[1]))
    counts, planned = np.zeros(shape, np.int64), np.zeros(shape, np.int64)

    def cell(condition: tuple[tuple[str, Level], ...]) -> tuple[int, int]:
        there = dict(condition)
        return levels[0].index(there[names[0]]), levels[1].index(there[names[1]])

    for trial in item.plan:
        if trial.role == "measured":
            planned[cell(trial.condition)] += 1
    for trial, _ in item.trials:
        if trial.role == "measured":
            counts[cell(trial.condition)] += 1
    axes = [f"{name} ({factors[name].unit})" if factors[name].unit else name for name in names]
    return Figure(
        figures.collected_grid(
            levels[0], levels[1], counts, planned, axes[0], axes[1], simulated=simulated
        ),
        f"Campaign {item.name}: trials committed of trials planned, by {names[0]} and "
        f"{names[1]}; the other factors and repetitions are counted together.",
        f"collected-{item.name}",
        {
            axes[0]: [str(level) for level in levels[0] for _ in levels[1]],
            axes[1]: [str(level) for _ in levels[0] for level in levels[1]],
            "committed (trials)": counts.ravel().tolist(),
            "planned (trials)": planned.ravel().tolist(),
        },
    )


def quality(store: Store, campaigns: list[Collected], simulated: bool) -> Section:
    """Event rate, gates and retakes over each campaign, and its reference trials."""
    pictures, tables, said = [], [], []
    for item in campaigns:
        if item.trials:
            pictures.append(_over_campaign(item, simulated))
            tables += _gates(item)
    for item in campaigns:
        rows = reference_rows(store, item)
        if rows:
            pictures.append(_references(item, rows, simulated))
            said += [f"Campaign {item.name}: {text}" for text in _wear(rows)]
    if not said:
        said = [
            "Wear: no campaign takes reference trials. `collection.references: {every: 48, "
            "condition: {...}}` in a protocol takes one condition again every so many trials, and "
            "this section then compares them."
        ]
    return Section(
        "Quality and retakes over the campaigns, and wear",
        [
            "Every trial is held against the protocol's gates before it is kept; what fails one "
            "is set aside with its cause and taken again.",
            *said,
        ],
        pictures,
        tables,
    )


def _over_campaign(item: Collected, simulated: bool) -> Figure:
    numbers = [trial.index + 1 for trial, _ in item.trials]
    records = [recording.record for _, recording in item.trials]
    rates = [record.counts.events / record.recorded_s for record in records]
    nearest = [_nearest(record.quality.gates) for record in records]
    places = {trial.id: trial.index + 1 for trial in item.plan}
    failed = Counter(
        places[known["trial"]] for known in item.campaign.quarantined() if known["trial"] in places
    )
    again = dict(sorted(failed.items()))
    return Figure(
        figures.over_campaign(
            numbers, rates, [share for share, _ in nearest], again, simulated=simulated
        ),
        f"Campaign {item.name}, trial by trial. Top: events a second; a drift or a step would be "
        "the skin, the light or the lens, scatter is the conditions'. Middle: the gate that came "
        "nearest to its limit. Bottom: attempts that stand in quarantine.",
        f"quality-{item.name}",
        {
            "trial": [trial.id for trial, _ in item.trials],
            "place in the plan": numbers,
            "events (1/s)": rates,
            "tightest gate": [name for _, name in nearest],
            "tightest gate (share of its limit)": [share for share, _ in nearest],
            "failed attempts": [again.get(place, 0) for place in numbers],
        },
    )


def _nearest(gates: Mapping[str, Gate]) -> tuple[float, str]:
    """The largest share of its limit that any gate used, and which; a limit of 0 uses nothing."""
    shares = [
        (gate.value / gate.limit, name)
        for name, gate in gates.items()
        if gate.limit and gate.value is not None and not isinstance(gate.value, str)
    ]
    return max(shares, default=(0.0, ""))


def _gates(item: Collected) -> list[Table]:
    """The worst committed trial of every gate, and why attempts are in quarantine."""
    worst: dict[str, tuple[float, float, str]] = {}
    for trial, recording in item.trials:
        for name, gate in recording.record.quality.gates.items():
            value, limit = gate.value, gate.limit
            if value is None or isinstance(value, str) or limit is None:
                continue
            if name not in worst or value > worst[name][0]:
                worst[name] = (value, limit, trial.id)
    rows = [[name, f"{limit:g}", f"{value:.3g}", of] for name, (value, limit, of) in worst.items()]
    caption = f"Campaign {item.name}: the committed trial that came nearest to each gate."
    found = [Table(("gate", "limit", "worst", "trial"), rows, caption)]
    causes = Counter(str(known["cause"]) for known in item.campaign.quarantined())
    if causes:
        listed = [[str(count), cause] for cause, count in causes.most_common()]
        found.append(Table(("attempts", "cause"), listed, f"Campaign {item.name}: quarantine."))
    return found


def reference_rows(store: Store, item: Collected) -> list[Json]:
    """What each committed reference trial measured, in the plan's order; see docs/summary.md."""
    labels = Derived.of(store, LABELS, item.name)
    return [
        {"trial": trial.id, "place": trial.index + 1, **_measured(labels, trial, recording)}
        for trial, recording in item.trials
        if trial.role == "reference"
    ]


def _measured(labels: Derived, trial: Trial, recording: Recording) -> Json:
    known = labels.key(trial.id) is not None
    onset = labels.load(trial.id, TrialLabel).incipient_ns if known else None
    begin = recording.step(recording.motion_phase)[0]
    return {
        "hold_events_per_s": hold_rate(recording),
        "first_slip_ms": None if onset is None else (onset - begin) / 1e6,
    }


def wear(rows: Sequence[Json]) -> dict[str, Json]:
    """Change of each figure over 100 trials, in percent of its median, robust, with 95 %.

    The slope of Theil and Sen: one odd trial does not move it. None with fewer than three trials.
    """
    found = {}
    for name, _ in WEAR:
        there = [(row["place"], row[name]) for row in rows if row[name] is not None]
        middle = float(np.median([value for _, value in there])) if there else 0.0
        slope: list[float | None] = [None, None, None]
        if len(there) >= _FEWEST and middle:
            fit = theilslopes([value for _, value in there], [place for place, _ in there], 0.95)
            slope = [1e4 * float(value) / middle for value in (fit[0], fit[2], fit[3])]
        found[name] = {
            "n": len(there), "percent_per_100_trials": slope[0], "low": slope[1], "high": slope[2]
        }  # fmt: skip
    return found


def _wear(rows: Sequence[Json]) -> list[str]:
    words = {
        "hold_events_per_s": "event rate in the hold",
        "first_slip_ms": "time to the first slip",
    }
    texts = []
    for name, found in wear(rows).items():
        if found["percent_per_100_trials"] is None:
            texts.append(f"{words[name]}: {found['n']} reference trials, too few for a trend.")
            continue
        sure = not found["low"] <= 0 <= found["high"]
        texts.append(
            f"{words[name]} changes by {found['percent_per_100_trials']:+.2f} % in 100 trials "
            f"(95 %: {found['low']:+.2f} to {found['high']:+.2f}, {found['n']} reference trials): "
            + ("more than chance." if sure else "no wear that these trials can tell.")
        )
    return texts


def _references(item: Collected, rows: list[Json], simulated: bool) -> Figure:
    places = [row["place"] for row in rows]
    return Figure(
        figures.references(
            places,
            {label: [row[name] for row in rows] for name, label in WEAR},
            simulated=simulated,
        ),
        f"Campaign {item.name}: one condition, taken again and again. Dotted: the first of them. A "
        "worn skin would show as a slope.",
        f"references-{item.name}",
        {
            "trial": [row["trial"] for row in rows],
            "place in the plan": places,
            "events in the hold (1/s)": [row["hold_events_per_s"] for row in rows],
            "motion to first slip (ms)": [row["first_slip_ms"] for row in rows],
        },
    )
