"""The report on recordings that show one of several classes each: its numbers and its sections."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np

from sliplab.analysis.campaigns import Collected, agreeing
from sliplab.analysis.networks import model_file
from sliplab.analysis.networks.models import ModelOnDisk
from sliplab.analysis.networks.training import Fitted
from sliplab.analysis.report import pages
from sliplab.analysis.report.cover import Answer, Cover
from sliplab.analysis.report.figures import intervals
from sliplab.analysis.report.page import Content, Figure, Number, Table, percent
from sliplab.analysis.report.sources import VERSION
from sliplab.analysis.report.summary import package_versions, protocol_hashes
from sliplab.analysis.report.windows import (
    METHODS,
    factor_figure,
    points_words,
    share_data,
    share_words,
    training_figure,
    warned_words,
    work_section,
)
from sliplab.plugins.classes import plot
from sliplab.plugins.classes.baselines import class_methods
from sliplab.plugins.classes.document import (
    ClassSeeds,
    ClassSummary,
    DataOrigin,
    JudgedClasses,
    LengthShare,
)
from sliplab.plugins.classes.evaluation import SPLITS, class_evaluation_of
from sliplab.storage.schema.evaluation import Share
from sliplab.storage.streams import Json
from sliplab.storage.trials.derived import make_key
from sliplab.storage.trials.store import TrialStore

_HERE = Path(__file__).parent
SHOWN = 40
"""Rows of long tables and figures."""
PAIRS = 12
"""Confusions that are listed."""
_ALMOST = 0.95
"""Share of the last accuracy that counts as almost all of it."""


def class_report_key(store: TrialStore, campaigns: list[Collected]) -> str:
    """Return the key of all inputs of the report.

    Raises:
        StoreError: there is no evaluation of this version yet.
    """
    evaluation = class_evaluation_of(store)
    collected = [
        [
            item.name,
            item.planned.collection_hash,
            item.planned.analysis_hash,
            _title(item),
            [recording.checksum for _, recording in item.trials],
        ]
        for item in campaigns
    ]
    # commands in the page name the store's folder
    place = str(store.folder.resolve())
    inputs = [
        evaluation.key,
        collected,
        class_methods(campaigns, len(evaluation.scores.classes)).fresh_keys(store),
        place,
    ]
    return make_key("report, classes", VERSION, inputs, None)


def _title(item: Collected) -> str:
    return "" if item.recorded is None else item.recorded.adapter.title


def class_summary(store: TrialStore, campaigns: list[Collected]) -> ClassSummary:
    """Make the summary.

    Raises:
        StoreError: there is no evaluation of this version yet.
    """
    evaluation = class_evaluation_of(store)
    methods = class_methods(campaigns, len(evaluation.scores.classes))
    return ClassSummary(
        simulated=store.simulated,
        classes=JudgedClasses.model_validate(
            {
                **evaluation.scores.to_json(),
                "trained_baselines": methods.results(store),
            }
        ),
        data={item.name: _origin(item) for item in campaigns},
        reviewed=evaluation.reviewed,
        versions=package_versions(),
        protocols=protocol_hashes(campaigns),
        seeds=ClassSeeds(
            network=agreeing(campaigns)[0].settings.training.seeds, chosen=evaluation.seed
        ),
    )


def class_numbers(store: TrialStore) -> Json:
    """Return the numbers of the evaluation under the report's keys, without a report.

    Raises:
        StoreError: there is no evaluation of this version yet.
    """
    return {
        "simulated": store.simulated,
        "classes": class_evaluation_of(store).scores.to_json(),
    }


def _origin(item: Collected) -> DataOrigin:
    records = [recording.record for _, recording in item.trials]
    unknown = Counter(
        what for record in records if record.imported for what in record.imported.unknown
    )
    about = {} if item.recorded is None else dict(item.recorded.adapter.about)
    return DataOrigin(
        title=_title(item),
        about=about,
        trials=len(records),
        seconds=sum(record.recorded_s for record in records),
        unknown=dict(unknown),
    )


def class_cover(summary: ClassSummary) -> Cover:
    """Return the first screen."""
    scores = summary.classes
    return Cover(_HERE / "page.html", _answer(summary), (), _headline(scores))


def _answer(summary: ClassSummary) -> Answer:
    """Compare the network with guessing and with other methods."""
    scores = summary.classes
    rows = [intervals.ShareInterval("network, windows", *_share(scores.by_length[-1]))]
    if _several(scores):
        rows.append(intervals.ShareInterval("network, recordings", *_share(scores.trials.argmax)))
    rows += [
        intervals.ShareInterval(METHODS[name], row.argmax, None, None)
        for name, row in {**scores.beside, **scores.trained_baselines}.items()
    ]
    svg = intervals.shares(
        {"test recordings": rows},
        "argmax accuracy (%)",
        simulated=summary.simulated,
        line=(_chance(scores), "guessing"),
    )
    return Answer(
        (
            f"{_argmax_words(scores)} of test windows and {share_words(scores.trials.argmax)} of "
            f"test recordings have the right one of {len(scores.classes)} classes.",
        ),
        Figure(svg, name="answer", data=share_data(rows, "argmax accuracy")),
        "Accuracy on the test recordings, a tie shared among its classes; bars are 95 % intervals "
        "over recordings.",
    )


def _share(row: Share) -> tuple[float | None, float | None, float | None]:
    return row.share, row.low, row.high


def _headline(scores: JudgedClasses) -> list[Number]:
    """Return the numbers below the first screen."""
    methods = {**scores.beside, **scores.trained_baselines}
    known = {name: row for name, row in methods.items() if row.argmax is not None}
    found = [
        Number("classes", str(len(scores.classes)), f"guessing gives {percent(_chance(scores))}"),
        Number(
            "recordings",
            str(sum(getattr(scores.recordings, split) for split in SPLITS)),
            f"{scores.recordings.test} of them to test",
        ),
        Number(
            "window accuracy",
            percent(scores.accuracy.argmax),
            f"argmax; strict {percent(scores.accuracy.strict)}, n = {scores.accuracy.n}",
        ),
    ]
    if _several(scores):
        whole = scores.trials.argmax
        found.append(Number("recording accuracy", percent(whole.share), f"argmax, n = {whole.n}"))
    if known:
        best = max(known, key=lambda name: known[name].argmax or 0.0)
        found.append(Number("best other method", percent(known[best].argmax), METHODS[best]))
    if scores.work is not None:
        operations = scores.work.synaptic_operations["all"]
        found.append(
            Number(
                "synaptic operations",
                f"{operations:,.0f}",
                f"a window; {percent(scores.work.share)} of dense multiply-adds",
            )
        )
    return found


def _chance(scores: JudgedClasses) -> float:
    return 1 / len(scores.classes)


def _several(scores: JudgedClasses) -> bool:
    """Return True where recordings have several windows."""
    return scores.accuracy.n != scores.trials.argmax.n


@dataclass(frozen=True)
class ClassDataSection(Content):
    """Origin of the recordings, and their parts.

    Attributes:
        one_each: each recording shows one class.
        campaigns: name, origin, and description.
        missing: classes without training windows.
    """

    template: ClassVar[Path] = _HERE / "data.html"
    classes: int
    one_each: bool
    campaigns: Sequence[tuple[str, DataOrigin, Table]]
    parts: Table
    missing: Sequence[str]
    unknown: Table


def _data_section(campaigns: Sequence[Collected], summary: ClassSummary) -> ClassDataSection:
    scores = summary.classes
    shown = [
        (name, origin, Table(["about", ""], [[key, text] for key, text in origin.about.items()]))
        for name, origin in summary.data.items()
    ]
    unknown = [
        [name, what, f"{count} of {origin.trials}"]
        for name, origin in summary.data.items()
        for what, count in origin.unknown.items()
    ]
    parts = [
        [split, *(str(getattr(of, split)) for of in (scores.recordings, scores.windows))]
        for split in SPLITS
    ]
    kinds = [item.recorded.recorded for item in campaigns if item.recorded is not None]
    return ClassDataSection(
        len(scores.classes),
        all(len(trial.classes) < 2 for found in kinds for trial in found),
        shown,
        Table(["part", "recordings", "windows"], parts),
        [row.name for row in scores.by_class if not row.windows.train],
        Table(["campaign", "what is not known", "recordings"], unknown),
    )


@dataclass(frozen=True)
class ClassNetworkSection(Content):
    """Accuracy on windows of test recordings, compared with other methods.

    Attributes:
        several: recordings have several windows.
        strong: stronger methods were trained.
    """

    template: ClassVar[Path] = _HERE / "network.html"
    length_ms: int
    scores: JudgedClasses
    chance: float
    several: bool
    strong: bool
    warnings: Sequence[str]
    methods: Table
    training: Figure
    each_seed: Table
    argmax: str
    strict: str
    whole_argmax: str
    whole_strict: str


def _network_section(summary: ClassSummary, fitted: Fitted) -> ClassNetworkSection:
    scores = summary.classes
    accuracy, trials = scores.accuracy, scores.trials
    methods = [
        [METHODS[name], percent(found.argmax), "", points_words(found.network_ahead)]
        for name, found in {**scores.beside, **scores.trained_baselines}.items()
    ]
    seeds = [
        [
            f"{row.seed}{' (used)' if row.chosen else ''}",
            *(percent(value) for value in (row.validation_strict, row.argmax, row.strict)),
        ]
        for row in scores.seeds.each
    ]
    return ClassNetworkSection(
        fitted.windows.length_ms,
        scores,
        _chance(scores),
        _several(scores),
        bool(scores.trained_baselines),
        fitted.warnings,
        Table(
            ["method", "argmax", "strict", "network ahead by (points)"],
            [["spiking network", percent(accuracy.argmax), percent(accuracy.strict), ""], *methods],
        ),
        training_figure(
            [vars(record) for record in fitted.history],
            fitted.chosen_epoch,
            simulated=summary.simulated,
        ),
        Table(["seed", "validation, strict", "test, argmax", "test, strict"], seeds),
        _argmax_words(scores),
        warned_words(scores.interval),
        share_words(trials.argmax),
        share_words(trials.strict),
    )


def _argmax_words(scores: JudgedClasses) -> str:
    """Return argmax accuracy of windows with the interval that whole windows have."""
    return share_words(scores.by_length[-1])


@dataclass(frozen=True)
class ConfusionSection(Content):
    """The confusion matrix, and the scores of each class.

    Attributes:
        left_out: classes that the figure of recall leaves out.
    """

    template: ClassVar[Path] = _HERE / "confusion.html"
    confusion: Figure
    pairs: Table
    recall: Figure
    left_out: int
    classes: Table


def _confusion_section(summary: ClassSummary) -> ConfusionSection:
    scores, simulated = summary.classes, summary.simulated
    matrix = np.asarray(scores.confusion)
    called = [*scores.classes, "undecided"]
    pairs = sorted(
        ((-int(matrix[i, j]), i, j) for i, j in np.argwhere(matrix).tolist() if i != j),
    )[:PAIRS]
    worst = sorted(
        (row for row in scores.by_class if row.recall.share is not None),
        key=lambda row: row.recall.share or 0.0,
    )
    rows = [
        intervals.ShareInterval(row.name, row.recall.share, row.recall.low, row.recall.high)
        for row in worst[:SHOWN]
    ]
    strict = scores.accuracy.strict
    line = None if strict is None else (strict, "all test windows")
    return ConfusionSection(
        Figure(
            plot.confusion_map(matrix, scores.classes, simulated=simulated),
            name="confusion",
            data={
                "true class": list(scores.classes),
                **{
                    f"called {name} (windows)": matrix[:, k].tolist()
                    for k, name in enumerate(called)
                },
            },
        ),
        Table(
            ["true class", "called", "windows", "of the class"],
            [
                [called[i], called[j], str(-n), percent(-n / int(matrix[i].sum()))]
                for n, i, j in pairs
            ],
        ),
        Figure(
            intervals.shares(
                {"the worst first": rows}, "recall (%)", simulated=simulated, line=line
            ),
            name="recall-by-class",
            data=share_data(rows, "recall"),
        ),
        len(worst) - len(rows),
        Table(
            ["class", "recall", "precision", *(f"{split} (windows)" for split in SPLITS)],
            [
                [
                    row.name,
                    share_words(row.recall),
                    percent(row.precision),
                    *(str(getattr(row.windows, split)) for split in SPLITS),
                ]
                for row in scores.by_class
            ],
        ),
    )


@dataclass(frozen=True)
class LengthSection(Content):
    """Accuracy where only the beginning of each window is seen."""

    template: ClassVar[Path] = _HERE / "length.html"
    figure: Figure
    early: str


def _length_section(summary: ClassSummary) -> LengthSection | None:
    scores = summary.classes
    rows = scores.by_length
    if len(rows) < 2:
        return None
    chance = _chance(scores)
    data: dict[str, Sequence[object]] = {
        "seen (ms)": [row.ms for row in rows],
        "accuracy, argmax (share)": [row.share for row in rows],
        "95 % interval, low (share)": [row.low for row in rows],
        "95 % interval, high (share)": [row.high for row in rows],
        "windows": [row.n for row in rows],
    }
    svg = plot.accuracy_by_length(rows, chance, simulated=summary.simulated)
    return LengthSection(Figure(svg, name="accuracy-by-length", data=data), _early_words(rows))


def _early_words(rows: Sequence[LengthShare]) -> str:
    """Return after how much of a window almost all of its accuracy is reached."""
    last = rows[-1].share
    if not last:
        return ""
    first = next(row for row in rows if (row.share or 0.0) >= _ALMOST * last)
    return f"{percent(_ALMOST, 0)} of the accuracy on whole windows is reached after {first.ms} ms."


@dataclass(frozen=True)
class ErrorSection(Content):
    """Accuracy by condition, and recordings that were not classified rightly."""

    template: ClassVar[Path] = _HERE / "where.html"
    factors: Figure | None
    wrong: Table
    all_wrong: int
    recordings: int


def _error_section(summary: ClassSummary) -> ErrorSection:
    scores = summary.classes
    by_factor: Mapping[str, Mapping[str, Share]] = {
        factor: levels
        for factor, levels in scores.by_factor.items()
        # a factor that is the class itself is listed under the classes already
        if 2 <= len(levels) <= SHOWN and not levels.keys() <= set(scores.classes)
    }
    rows = [
        [
            row.trial,
            row.true,
            row.called or "undecided",
            f"{row.right} of {row.windows}",
            ", ".join(f"{name} {level}" for name, level in row.condition.items()),
        ]
        for row in scores.wrong[:SHOWN]
    ]
    columns = ["recording", "true class", "called", "windows right", "condition"]
    if not any(row[-1] for row in rows):
        rows, columns = [row[:-1] for row in rows], columns[:-1]
    return ErrorSection(
        factor_figure(by_factor, scores.accuracy, simulated=summary.simulated)
        if by_factor
        else None,
        Table(columns, rows),
        len(scores.wrong),
        scores.trials.argmax.n,
    )


@dataclass(frozen=True)
class ClassMadeSection(Content):
    """Settings, versions, hashes, and the commands that make the results again."""

    template: ClassVar[Path] = _HERE / "made.html"
    folded: ClassVar[bool] = True
    seeds: ClassSeeds
    settings: Table
    commands: Table
    tables: Sequence[Table]


def _made_section(
    store: TrialStore, campaigns: Sequence[Collected], summary: ClassSummary, fitted: Fitted
) -> ClassMadeSection:
    place = store.folder.resolve()
    chosen = campaigns[0].settings
    stated = {
        "windows": fitted.windows,
        "samples": chosen.samples,
        "network": fitted.network,
        "training": fitted.training,
    }
    settings = [
        [
            f"analysis.{part}.{key}",
            ", ".join(map(str, value)) if isinstance(value, list) else str(value),
        ]
        for part, found in stated.items()
        for key, value in found.model_dump(mode="json").items()
        if key != "seeds"
    ]
    commands = [
        [
            f"import {item.name}",
            f"sliplab import --adapter {item.campaign.protocol_file.resolve()} "
            f"DATA --store NEW_STORE --name {item.name}",
        ]
        for item in campaigns
    ]
    commands += [
        [step, f"sliplab {step} {place}"] for step in ("label", "train", "evaluate", "report")
    ]
    commands.append(["other methods", f"sliplab evaluate {place} --baselines"])
    hashes = [
        [name, value.collection[:16], value.analysis[:16]]
        for name, value in summary.protocols.items()
    ]
    versions = [[name, value] for name, value in summary.versions.items()]
    return ClassMadeSection(
        summary.seeds,
        Table(["setting", "value"], settings),
        Table(["step", "command"], commands, commands=(1,)),
        [
            Table(["adapter", "hash of the data", "hash of split and analysis"], hashes),
            Table(["package", "version"], versions),
        ],
    )


def class_sections(
    store: TrialStore, campaigns: list[Collected], summary: ClassSummary, model: ModelOnDisk
) -> list[Content]:
    """Make all sections, in order."""
    fitted = model_file.load(model.path)
    sections = [
        _data_section(campaigns, summary),
        _network_section(summary, fitted),
        _confusion_section(summary),
        _length_section(summary),
        _error_section(summary),
        work_section(summary.classes),
        _made_section(store, campaigns, summary, fitted),
    ]
    return [section for section in sections if section is not None]


def class_page(store: TrialStore, campaigns: list[Collected], model: ModelOnDisk) -> pages.Page:
    """Return the page about recordings of classes.

    Args:
        model: the evaluated network.

    Raises:
        StoreError: there is no evaluation of this version yet.
    """
    summary = class_summary(store, campaigns)
    sections = class_sections(store, campaigns, summary, model)
    return pages.make_page(campaigns, summary.to_json(), class_cover(summary), sections)
