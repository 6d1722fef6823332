"""The public interface of `import sliplab`: stores, trials as arrays, and what the commands do.

A trial's arrays share one time line: int64 nanoseconds of the trial's sync box. Raw device times
stay in the store (`storage.trials.recording.Recording`), for those who need them. What a command
does, its function or method does with the same arguments, errors and defaults, and returns what the
command prints with ``--json``; a failed check is in the result, not an exception.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sliplab.flows.notebook.arguments import checked, checked_methods
from sliplab.flows.notebook.html import pairs_html, table_html
from sliplab.flows.notebook.plan import PlanView
from sliplab.flows.notebook.trial import (
    F64,
    I64,
    Events,
    Onsets,
    Poses,
    Scalars,
    Trial,
    WindowCounts,
)
from sliplab.protocols import InputError, load_plan
from sliplab.storage.errors import StoreError
from sliplab.storage.files import read_json
from sliplab.storage.streams import EventChunk, Json
from sliplab.storage.trials.store import STORE, TrialStore

if TYPE_CHECKING:
    import pandas as pd

    from sliplab.analysis.networks.training import Fitted
    from sliplab.analysis.report.page import Figure
    from sliplab.analysis.windows.sparse import SparseWindows
    from sliplab.flows.log import LogEntry
    from sliplab.flows.notebook.datasets import EventDataset
    from sliplab.flows.notebook.torch_windows import TorchWindows
    from sliplab.flows.planning.preflight import Checks
    from sliplab.flows.status import StoreStatus
    from sliplab.flows.steps import StepResult
    from sliplab.flows.verify import Verification
    from sliplab.protocols.windows import Windows

__all__ = [
    "F64",
    "I64",
    "Events",
    "Model",
    "Onsets",
    "Poses",
    "Scalars",
    "Store",
    "Trial",
    "WindowCounts",
    "check",
    "collect",
    "export",
    "import_data",
    "load_model",
    "open_store",
    "plan",
    "verify",
]


@checked_methods
class Store:
    """A store of trials: its catalogue, its trials, and the analysis steps.

    Each step runs only what is missing or stale, and returns what it did: ``done`` and ``fresh``.
    `campaigns` names those that a step works on; all of them by default.
    """

    def __init__(self, store: TrialStore) -> None:
        self._store = store

    def __repr__(self) -> str:
        return f"<Store {self.folder}: {', '.join(self.campaigns) or 'no campaign'}>"

    @property
    def folder(self) -> Path:
        """The store's folder; of a URL, the folder that mirrors it."""
        return self._store.folder

    @property
    def campaigns(self) -> list[str]:
        """Names of the campaigns."""
        return [campaign.name for campaign in self._store.campaigns()]

    def trials(self, where: str | None = None) -> pd.DataFrame:
        """The committed trials as a table: conditions, counts and quality, units in the headers.

        Args:
            where: only rows for which this holds, such as ``depth_mm > 2.5``.

        Raises:
            InputError: `where` cannot be answered.
            StoreError: a trial is damaged.
        """
        from sliplab.storage.trials.catalogue import catalogue, query

        table = catalogue(self._store)
        return table if where is None else query(table, where)

    def trial(self, trial_id: str, campaign: str | None = None) -> Trial:
        """One trial.

        Args:
            campaign: needed where several campaigns have a trial of this id.

        Raises:
            NoTrial: it does not exist, or more than one; a StoreError and an InputError.
        """
        found = self._store.holder(trial_id, campaign)
        return Trial(self._store, found.name, found.recording(trial_id))

    def __iter__(self) -> Iterator[Trial]:
        """All committed trials, by campaign and id."""
        for item in self._store.campaigns():
            for recording in item.recordings():
                yield Trial(self._store, item.name, recording)

    def sync(self, campaigns: Sequence[str] | None = None) -> StepResult:
        """Fit every trial's clocks again."""
        return self._run("sync", campaigns)

    def label(self, campaigns: Sequence[str] | None = None) -> StepResult:
        """Find the onsets of every trial."""
        return self._run("label", campaigns)

    def train(self, campaigns: Sequence[str] | None = None) -> StepResult:
        """Train the network on the labelled kinematic trials."""
        return self._run("train", campaigns)

    def evaluate(
        self,
        campaigns: Sequence[str] | None = None,
        *,
        predictions: pd.DataFrame | str | Path | None = None,
        model: str | Path | None = None,
        engine: str | None = None,
        margin: float | None = None,
        smoothing: int | None = None,
        reviewed: bool = False,
        baselines: bool = False,
        checks: bool = False,
        dask: str | None = None,
        promise: float | None = None,
    ) -> dict[str, Any]:
        """Judge the network on test trials; or a model file, or any model by its predictions.

        Args:
            predictions: a row for each window that `windows` lists for ``test``, as a table or its
                file; docs/models.md describes its columns. The table of `Model.predict` has the
                number of the model's output neurons, by which the margin counts, in its ``attrs``.
            model: a model file.
            engine, margin, smoothing, reviewed, baselines, checks, dask, promise: see ``sliplab
                evaluate``.

        Returns:
            what ``sliplab evaluate --json`` prints.

        Raises:
            InputError: an argument, or predictions that do not fit, with all their faults.
        """
        from sliplab.flows.evaluations import run_evaluation
        from sliplab.flows.running import console, stopping

        if isinstance(predictions, str):
            predictions = Path(predictions)
        names = None if campaigns is None else list(campaigns)
        with stopping.signals():
            found = run_evaluation(
                self.folder,
                names,
                margin=margin,
                smoothing=smoothing,
                reviewed=reviewed,
                baselines=baselines,
                checks=checks,
                model=None if model is None else Path(model),
                engine=engine,
                predictions=predictions,
                dask=dask,
                promise=promise,
            )
        as_printed: Json = json.loads(json.dumps(found, default=console.plain))
        return as_printed

    def windows(
        self,
        split: str | None = None,
        campaigns: Sequence[str] | None = None,
        *,
        reviewed: bool = False,
    ) -> pd.DataFrame:
        """The windows by which models are trained and judged, by trial and time.

        Args:
            split: ``train``, ``validation`` or ``test``; all of them by default.
            reviewed: apply the decisions made in a review; for an evaluation that does.

        Returns:
            a row for each window: ``campaign``, ``trial``, ``split``; ``start_ns`` and ``end_ns``
            on the trial's time line; ``run``: slip is detected in it; ``label``: its class
            (``no_slip``, ``incipient``, ``gross``) where it is a sample, else None.

        Raises:
            InputError: there is no such part of the split.
            StoreError: a trial has no label yet, there are no slides with events, or the campaigns
                pose another problem than slip.
        """
        from sliplab.analysis.campaigns import collected
        from sliplab.analysis.labels.reviewed import StoreLabels
        from sliplab.analysis.problem import need_slip
        from sliplab.analysis.windows.window_table import SPLITS, window_table
        from sliplab.protocols.shown import one_of

        if split is not None and split not in SPLITS:
            raise InputError("split", "", split, one_of(split, SPLITS))
        found = collected(self._store, None if campaigns is None else list(campaigns))
        labels = StoreLabels(self._store, reviewed)
        need_slip(labels, found)
        return window_table(labels, found, SPLITS if split is None else (split,))

    def torch_dataset(
        self, split: str = "train", *, windows: pd.DataFrame | None = None
    ) -> TorchWindows:
        """Event counts of windows and their classes, for PyTorch's ``DataLoader``.

        Args:
            split: whose labelled windows are taken.
            windows: take these rows of `windows` instead; the class is -1 where ``label`` is None.

        Raises:
            ModuleNotFoundError: the extra ``learn`` is not installed.
            InputError, StoreError: as `windows`.
        """
        from sliplab.flows.notebook.torch_windows import TorchWindows

        table = self._windows(split, windows)
        return TorchWindows(self._counts(table), table)

    def tonic_dataset(
        self,
        split: str = "train",
        *,
        windows: pd.DataFrame | None = None,
        transform: Callable[[Any], Any] | None = None,
        target_transform: Callable[[Any], Any] | None = None,
    ) -> EventDataset:
        """Events of windows and their classes, as tonic's transforms take them.

        Args:
            split, windows: as `torch_dataset`.
            transform, target_transform: applied to each item's events and to its class.

        Raises:
            InputError, StoreError: as `windows`.
        """
        from sliplab.flows.notebook.datasets import EventDataset

        table, length_ns = self._windows(split, windows), self._settings().length_ms * 1_000_000
        return EventDataset(self._store, table, length_ns, transform, target_transform)

    def _windows(self, split: str, windows: pd.DataFrame | None) -> pd.DataFrame:
        from sliplab.flows.notebook.datasets import labelled

        return labelled(self.windows(split)) if windows is None else windows

    def _settings(self) -> Windows:
        from sliplab.analysis.campaigns import collected, training_campaigns

        return training_campaigns(collected(self._store))[0].settings.windows

    def _counts(self, windows: pd.DataFrame, shape: Windows | None = None) -> SparseWindows:
        from sliplab.flows.notebook.datasets import event_counts

        return event_counts(self._store, windows, shape or self._settings())

    def verify(self, *, quarantine: bool = False) -> Verification:
        """Check every checksum, count and clock of the store; see `sliplab.verify`."""
        return verify(self.folder, quarantine=quarantine)

    def export(self, form: str, output: str | Path, part: str = "", **options: Any) -> Json:
        """Write trials or the store in a form of other programs; see `sliplab.export`."""
        return export(self.folder, form, output, part, **options)

    def report(
        self, campaigns: Sequence[str] | None = None, *, against: str | Path | None = None
    ) -> Path:
        """Write the report; returns its page.

        Args:
            against: another store or its ``summary.json``; the page returned compares both.

        Raises:
            InputError: there is no such report.
        """
        from sliplab.analysis.report.against import load_report
        from sliplab.flows import report

        if against is not None:
            load_report(Path(against))  # wrong input fails before anything is made
        self._run("report", campaigns)
        if against is not None:
            return report.against(self._store, Path(against))[1]
        return self.folder / "report" / "index.html"

    def summary(self) -> dict[str, Any]:
        """The figures of the last report (docs/summary.md lists them).

        Raises:
            StoreError: there is no report yet.
        """
        return read_json(self._reported("summary.json"))

    def scores(self) -> pd.DataFrame:
        """The figures of the last report and its trials' results, a row each (docs/summary.md).

        Before a first report those of the evaluation.

        Raises:
            StoreError: there is neither yet, or it is of an older version.
            ModuleNotFoundError: the extra ``parquet`` is not installed.
        """
        import pandas as pd

        from sliplab.protocols.later import need

        need("pyarrow")
        evaluated = self.folder / "derived" / "evaluation" / "scores.parquet"
        reported = self.folder / "report" / "scores.parquet"
        if evaluated.exists() and not reported.exists():
            return pd.read_parquet(evaluated)
        return pd.read_parquet(self._reported("scores.parquet"))

    def status(self) -> StoreStatus:
        """Who collects, how far each campaign is, and when it is likely to end.

        Raises:
            StoreError: the store is damaged.
        """
        from sliplab.flows.status import StatusReader

        return StatusReader(self._store).read()

    def log(
        self,
        text: str = "",
        *,
        skin: str | None = None,
        context: Mapping[str, str] | None = None,
        campaigns: Sequence[str] | None = None,
        who: str = "",
    ) -> list[LogEntry]:
        """What people and programs did to the store, oldest first; damaged files are left out.

        With arguments, an entry is added first. A skin or other context is stored with every trial
        from then on; `status` lists what a new skin asks for.

        Args:
            text: a note.
            skin: serial number of a skin that was mounted.
            context: other values by name: ``{"temperature": "24 degC"}``.
            campaigns: those that `skin` and `context` are about; all that have begun by default.
            who: empty for the user that is logged in.

        Raises:
            ValueError: an argument is wrong. InputError: a campaign's protocol plans the value.
        """
        from sliplab.flows.log import add_note, log_entries

        values = {**(context or {}), **({} if skin is None else {"skin": skin})}
        if text or values:
            add_note(self._store, text, who=who, context=values, campaigns=campaigns)
        return log_entries(self._store)

    def note(self, text: str, *, who: str = "") -> LogEntry:
        """Add a note to the log.

        Args:
            who: empty for the user that is logged in.

        Raises:
            InputError: the text is empty or too long.
        """
        from sliplab.flows.log import add_note

        return add_note(self._store, text, who=who)

    def models(self) -> list[Path]:
        """Files of the networks that were trained here: ``seed0.pt``, and so on, come first.

        Then those to compare with, which `analysis.also` names.
        """

        def order(path: Path) -> tuple[bool, int, str]:
            return not path.name.startswith("seed"), len(path.name), path.name

        return sorted((self.folder / "models").glob("*.pt"), key=order)

    def plot(self, campaign: str | None = None) -> Figure:
        """Event rate, tightest gate and failed attempts over a campaign, as in the report.

        Args:
            campaign: the first one by default.

        Raises:
            InputError: there is no such campaign. StoreError: there is none.
            ModuleNotFoundError: the extra ``report`` is not installed.
        """
        from sliplab.analysis.campaigns import collected
        from sliplab.analysis.report.campaign import campaign_figure

        item = collected(self._store, None if campaign is None else [campaign])[0]
        stream = "frames" if item.missing_stream == "events" else "events"
        return campaign_figure(item, stream, bool(item.info["simulated"]))

    def _repr_html_(self) -> str:
        rows = [
            (item.name, len(item.committed()), "yes" if item.info["simulated"] else "no")
            for item in self._store.campaigns()
        ]
        return table_html(f"Store {self.folder}", ("campaign", "trials", "simulated"), rows)

    def _reported(self, name: str) -> Path:
        path = self.folder / "report" / name
        if not path.exists():
            raise StoreError(f"{path}: does not exist; run `Store.report` first")
        return path

    def _run(self, step: str, campaigns: Sequence[str] | None) -> StepResult:
        from sliplab.flows.running import stopping
        from sliplab.flows.steps import run_step

        with stopping.signals():
            return run_step(self.folder, None if campaigns is None else list(campaigns), step)


@checked_methods
class Model:
    """A trained network, run on events by the event-driven kernels."""

    def __init__(self, fitted: Fitted, simulated: bool = False, name: str = "") -> None:
        self.fitted, self.simulated, self.name = fitted, simulated, name

    def __repr__(self) -> str:
        simulated = ", simulated" if self.simulated else ""
        name, seed = self.name and f" {self.name}", self.fitted.seed
        return f"<Model{name} of {', '.join(self.classes)}; seed {seed}{simulated}>"

    def _repr_html_(self) -> str:
        chosen, windows = self.fitted.chosen, self.fitted.windows
        pairs = {
            "window": f"{windows.length_ms} ms in {windows.steps} steps",
            "cells": f"{windows.channels} x {windows.cells} x {windows.cells}",
            "epoch": f"{chosen.epoch} of {len(self.fitted.history)}",
            "validation accuracy, strict": f"{chosen.val_strict:.1%}",
            "warnings": "; ".join(self.fitted.warnings) or "none",
        }
        return pairs_html(repr(self), pairs)

    def plot(self) -> Figure:
        """Loss and accuracy over the epochs of its training, as in the report.

        Raises:
            ModuleNotFoundError: the extra ``report`` is not installed.
        """
        from dataclasses import asdict

        from sliplab.analysis.report.windows import training_figure

        history = [asdict(record) for record in self.fitted.history]
        return training_figure(history, self.fitted.chosen_epoch, simulated=self.simulated)

    def predict(self, store: Store, split: str = "test") -> pd.DataFrame:
        """Output spikes in a store's windows, as `Store.evaluate` takes predictions.

        Raises:
            InputError: the network tells other classes than those of slip.
            StoreError: see `Store.windows`.
        """
        from sliplab.analysis.evaluation.predictions import COLUMNS, OUTPUTS
        from sliplab.analysis.networks import training

        self.fitted.check_slip("model", "a prediction of slip")
        windows = store.windows(split)
        # the network may have windows of another length than the store
        starts = windows.drop(columns="end_ns")
        counts = training.predict_counts(self.fitted, store._counts(starts, self.fitted.windows))
        columns = dict(zip(COLUMNS["spikes"], counts.T, strict=True))
        table = windows[["campaign", "trial", "start_ns"]].assign(**columns)
        table.attrs[OUTPUTS] = self.fitted.network.outputs_per_class
        return table

    @property
    def classes(self) -> tuple[str, ...]:
        """Names of the classes, in the order of the counts."""
        from sliplab.analysis.metrics.classification import CLASSES

        if self.fitted.classes == CLASSES:
            return ("no slip", "incipient slip", "gross slip")
        return self.fitted.classes

    def counts(self, trial: Trial) -> WindowCounts:
        """Output spikes in consecutive windows of a trial, as the evaluation counts them.

        Raises:
            StoreError: the trial is damaged, or has no events.
        """
        from sliplab.analysis.networks import training
        from sliplab.analysis.windows import dataset

        windows, end_ns = dataset.trial_windows(trial.recording, self.fitted.windows)
        return WindowCounts(training.predict_counts(self.fitted, windows), end_ns)

    def counts_of(
        self, events: Events, start_ns: I64, size_px: tuple[int, int] = (640, 480)
    ) -> I64:
        """Output spikes in windows of any events.

        Args:
            events: of any event camera, in time order.
            start_ns: start of each window, int64 nanoseconds, shape (n,).
            size_px: columns and rows of the camera.

        Returns:
            spikes of each class, int64, shape (n, classes).

        Raises:
            InputError: events are not in time order or lie outside of the camera, or the network's
                crop is larger than it.
        """
        from sliplab.analysis.networks import training
        from sliplab.analysis.windows.windows import list_events

        chunk = EventChunk(events.x, events.y, events.p, events.t_ns // 1000)
        starts_us = np.asarray(start_ns) // 1000
        if starts_us.ndim != 1:
            text = f"must be an array of shape (n,), not {starts_us.shape}"
            raise InputError("start_ns", "", None, text)
        try:
            windows = list_events(chunk, starts_us, self.fitted.windows, *size_px)
        except ValueError as error:
            raise InputError("events", "", None, str(error)) from None
        return training.predict_counts(self.fitted, windows)


@checked
def open_store(place: str | Path) -> Store:
    """Open a store.

    Args:
        place: its folder, or the URL of a pushed one (``s3://lab/one``).

    Raises:
        StoreError: it does not exist, it is damaged, or a newer version wrote it.
    """
    from sliplab.storage.remote import mirror
    from sliplab.storage.remote.objects import is_url

    if is_url(str(place)):
        return Store(mirror.open_mirror(str(place))[0])
    return Store(mirror.open_store(Path(place)))


@checked
def load_model(path: str | Path) -> Model:
    """Load a network that `Store.train` or ``sliplab train`` made.

    Raises:
        InputError: the file cannot be read, is not a model, or is damaged.
        ModuleNotFoundError: the extra ``learn`` is not installed.
    """
    from sliplab.flows.detecting.request import load_model as load

    place = Path(path)
    made_in = place.parent.parent  # of STORE/models/NAME.pt
    stored = (made_in / STORE).is_file() and TrialStore.open(made_in).simulated
    return Model(load(place), stored, place.name)


@checked
def plan(protocol: str | Path, enable: Iterable[str] = ()) -> PlanView:
    """Expand a protocol to its trials, in the order in which they are taken.

    Args:
        protocol: a file, or the name of a protocol that ships with SlipLab (``pilot``).
        enable: optional levels to switch on, as ``factor=level``.

    Raises:
        InputError: the protocol is wrong; the message names file, key, value and what is right.
    """
    found = load_plan(Path(protocol), tuple(enable))
    return PlanView(found.protocol, found.file, found.enabled, found.trials)


@checked
def check(
    protocol: str | Path, rig: str | Path, store: str | Path, *, enable: Iterable[str] = ()
) -> Checks:
    """Check everything that can be checked before anything moves, as ``sliplab check`` does.

    Args:
        protocol, rig, store, enable: as `collect`.

    Returns:
        ``passed``, and ``checks``: each with its name, whether it passed, and its finding.

    Raises:
        InputError: protocol or rig file cannot be used at all.
    """
    from sliplab.flows.planning import preflight

    found = preflight.check(Path(protocol), Path(rig), Path(store), tuple(enable))
    return preflight.checks_json(found)


@checked
def verify(place: str | Path, *, quarantine: bool = False) -> Verification:
    """Check every checksum, count and clock of a store, as ``sliplab verify`` does.

    Args:
        place: its folder, or the URL of a pushed one.
        quarantine: move damaged trials to quarantine, to be retaken.

    Returns:
        ``ok``, ``problems`` and so on; damage is in the result, not an exception.

    Raises:
        InputError: there is no store, or `quarantine` was given with a URL.
    """
    from sliplab.flows.verify import verify as run

    return run(str(place), quarantine)


@checked
def import_data(
    path: str | Path,
    store: str | Path,
    *,
    kind: str | None = None,
    name: str | None = None,
    adapter: str | Path | None = None,
    dry_run: bool = False,
    simulated: bool = False,
    salvage: bool = False,
) -> Json:
    """Import recordings of other programs, as ``sliplab import`` does.

    Args:
        path: a file, or a folder of files; with an adapter also a ``.zip``.
        store: the store's folder; made if missing.
        kind: name of the format; by default the content decides.
        name: the new campaign's; by default the adapter's.
        adapter: of a data set with labels and factors (docs/adapters.md).
        dry_run: with an adapter: return what would be imported.
        simulated: mark the trials as simulated.
        salvage: import the undamaged beginning of a damaged file.

    Returns:
        ids in ``imported`` and ``there``, faults in ``failed`` and ``warnings``, and so on.

    Raises:
        InputError: an argument, or data that cannot be right.
        ModuleNotFoundError: an extra is not installed; the message says which.
    """
    from sliplab.flows.imports import import_data as run

    return run(
        Path(path),
        Path(store),
        kind=kind,
        name=name,
        adapter=None if adapter is None else Path(adapter),
        dry_run=dry_run,
        simulated=simulated,
        salvage=salvage,
    )


@checked
def export(
    place: str | Path, form: str, output: str | Path, part: str = "", **options: Any
) -> Json:
    """Write trials, a store or a network in a form of other programs, as ``sliplab export`` does.

    Args:
        place: a store's folder or URL, or a model's file.
        form: its name, such as ``aedat4``, ``dsec``, ``labels`` or ``croissant``.
        output: folder to write, or file for labels or samples.
        part: a campaign or a trial of the store, where the form is of one.
        options: of the form: ``title``, ``licence``, ``stream``, ``store``, ``windows``;
            ``campaign`` and ``creator``, one or several.

    Returns:
        what was written.

    Raises:
        InputError: the form, an option, or a part that is missing or too much.
        StoreError: the store does not have what the form needs.
        ModuleNotFoundError: an extra is not installed; the message says which.
    """
    from sliplab.flows import exports

    given = {
        name: [value] if name in exports.SEVERAL and isinstance(value, str) else value
        for name, value in options.items()
        if value is not None
    }
    request = exports.ExportRequest(str(place), part, form, Path(output), given)
    return dict(exports.export(request).result)


@checked
def collect(
    protocol: str | Path,
    rig: str | Path,
    store: str | Path,
    *,
    trials: int | None = None,
    campaign: str | None = None,
    enable: Iterable[str] = (),
    operator: str = "",
    temperature: float | None = None,
    humidity: float | None = None,
    note: str = "",
    no_stopping: bool = False,
) -> Store:
    """Take the trials of a protocol that a store lacks, on a rig.

    Args:
        protocol: a file, or the name of a protocol that ships with SlipLab.
        rig: a rig file, or the name of a rig that ships with SlipLab (``rehearsal``).
        store: the store's folder; made if missing.
        trials: take this many at most.
        campaign: name of the campaign; the protocol's by default.
        enable: optional levels to switch on, as ``factor=level``.
        operator, note: stored with the session.
        temperature, humidity: of the room, degrees Celsius and percent, stored as well.
        no_stopping: the protocol's claims do not end the campaign.

    Raises:
        InputError: protocol or rig is wrong, or the rig cannot take the protocol.
        StoreError: the store cannot be used.
        sliplab.CampaignStopped: collection cannot continue; the message says why.
        ModuleNotFoundError: an extra is not installed; the message says which.
    """
    from sliplab.flows.planning.parameters import CollectOptions, made
    from sliplab.flows.planning.run_request import make_request
    from sliplab.flows.running import stopping
    from sliplab.flows.steps import prepare_store

    options = made(
        CollectOptions,
        enable=list(enable),
        trials=trials,
        campaign=campaign,
        operator=operator,
        temperature_c=temperature,
        humidity_percent=humidity,
        note=note,
        no_stopping=no_stopping,
    )
    run_request = make_request(Path(protocol), Path(rig), Path(store), **options.arguments())
    with stopping.signals():
        prepare_store(run_request.store)
        from sliplab.flows.collect import collect as take

        take(run_request)
    return open_store(run_request.store)
