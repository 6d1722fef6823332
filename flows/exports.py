"""What `sliplab export` writes: forms by their names; plug-ins add further ones.

A form is of a store, of trials (a campaign or one trial), or of a trained network.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from sliplab.flows.running import console
from sliplab.flows.steps import located
from sliplab.protocols.errors import InputError
from sliplab.protocols.plugin import plugins
from sliplab.protocols.plugins import PluginError, import_foreign
from sliplab.protocols.shown import one_of
from sliplab.storage.errors import StoreError, disk_error, disk_full

if TYPE_CHECKING:
    from sliplab.storage.trials.store import Campaign, TrialStore


@dataclass(frozen=True)
class ExportRequest:
    """What is exported, and where to.

    Attributes:
        place: a store's folder, or a model's file.
        part: a campaign or a trial of the store; empty: all of it.
        form: name of the form. output: folder or file to write.
        options: those that were given, by name.
    """

    place: str
    part: str
    form: str
    output: Path
    options: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class ExportResult:
    """What was written: a title and pairs for people, and JSON for programs."""

    title: str
    result: Mapping[str, Any]
    pairs: Mapping[str, object] | None = None


@dataclass(frozen=True)
class Export:
    """A form, which `protocols.plugin.Plugin.exports` names.

    Attributes:
        of: what it is of. options: names of the options that it takes.
        possible: False for one that is refused, with its reason.
    """

    of: Literal["store", "trials", "model"]
    write: Callable[[ExportRequest], ExportResult]
    options: frozenset[str] = frozenset()
    possible: bool = True


SEVERAL = frozenset({"campaign", "creator"})
"""Options with several values."""
TITLES = {
    "store": "a store",
    "trials": "a campaign or a trial of a store",
    "model": "a trained network",
}


def export_names() -> list[str]:
    """Return the names of all forms."""
    from sliplab.storage.formats.known import export_formats

    return [*export_formats(), "labels", "samples", *plugins().declared("exports")]


def fitting_forms(place: str) -> str:
    """Return the forms of a store, or those of a model where `place` is a file, for a message."""
    by_kind: dict[str, list[str]] = {}
    for name in export_names():
        with suppress(PluginError):  # of a plug-in that cannot be used
            form = known_export(name)
            if form.possible:
                by_kind.setdefault(form.of, []).append(name)
    models, stores, trials = (
        ", ".join(by_kind.get(kind, [])) for kind in ("model", "store", "trials")
    )
    if Path(place).is_file():
        return f"a trained network has the forms {models}"
    return f"a store has the forms {stores}; a campaign or a trial of it, as PART, {trials}"


def known_export(name: str) -> Export:
    """Return a form.

    Raises:
        InputError: there is none of this name.
        PluginError: its plug-in cannot be imported.
    """
    from sliplab.storage.formats.known import format_names, known_format

    if name == "labels":
        return Export("trials", _labels, frozenset({"campaign"}))
    if name == "samples":
        return Export("trials", _samples, frozenset({"campaign", "stream"}))
    if name in format_names() and known_format(name).export is not None:
        return Export("trials", _trials, frozenset({"campaign", "stream"}))
    places = plugins().declared("exports")
    if name not in places:
        raise InputError("--as", "", name, one_of(name, export_names()))
    found: Export = import_foreign(places[name])
    return found


def check_export(request: ExportRequest) -> Export:
    """Return the export of a valid request.

    Raises:
        InputError: an option that the form does not take, or a part that is missing or too much.
    """
    form = known_export(request.form)
    for name in request.options:
        if name not in form.options:
            holders = [each for each in export_names() if name in known_export(each).options]
            it_is = f"it is of {', '.join(holders)}" if holders else "no form has it"
            text = f"does not belong to --as {request.form}; {it_is}"
            raise InputError(f"--{name}", "", None, text)
    place, taken = Path(request.place), f"--as {request.form} is of {TITLES[form.of]}"
    if place.exists() and place.is_dir() == (form.of == "model"):
        there = "a folder" if place.is_dir() else "a file"
        raise InputError("WHAT", "", request.place, f"is {there}, and {taken}")
    if form.of == "trials" and not request.part:
        raise InputError("PART", "", None, f"is needed: {taken}")
    if form.of != "trials" and request.part:
        raise InputError("PART", "", request.part, f"is too much: {taken}")
    return form


def export(request: ExportRequest) -> ExportResult:
    """Write what a request asks for.

    Raises:
        InputError: see `check_export`; or the output belongs to a store.
        StoreError: the store does not have what the form needs.
    """
    from sliplab.storage.formats.foreign import EXPORT_MANIFEST
    from sliplab.storage.trials.catalogue import refuse_store_file

    form = check_export(request)
    # publications refuse what exists; a model's folder may be next to the model, in its store
    again = form.of != "trials" or (request.output / EXPORT_MANIFEST).is_file()
    refuse_store_file(request.output, "--output", again=again)
    if form.of != "model":
        request = replace(request, place=str(located(request.place)))
    try:
        return form.write(request)
    except OSError as error:
        if form.of == "model" or not disk_full(error):
            raise
        # of the store nothing was written: there is nothing to resume
        raise disk_error(request.output, error, "export again") or error from None


def _chosen(request: ExportRequest) -> tuple[TrialStore, Campaign, list[str]]:
    """Return a store, a campaign of it, and the requested trials."""
    from sliplab.storage.remote.mirror import open_store

    folder, part = Path(request.place), request.part
    opened = open_store(folder)
    campaigns = {campaign.name: campaign for campaign in opened.campaigns()}
    there = ", ".join(campaigns) or "none"
    wanted = request.options.get("campaign") or [*campaigns]
    if unknown := [each for each in wanted if each not in campaigns]:
        text = f"is no campaign of {folder}; campaigns: {there}"
        raise InputError("--campaign", "", unknown[0], text)
    if part in campaigns:
        return opened, campaigns[part], sorted(campaigns[part].committed())
    holders = [each for each in opened.holders(part) if each.name in wanted]
    if len(holders) != 1:
        text = (
            f"is in the campaigns {', '.join(each.name for each in holders)} of {folder}; "
            "choose one by --campaign"
            if holders
            else f"is no campaign or committed trial of {folder}; campaigns: "
            f"{there}; `sliplab trials {folder}` lists the trials"
        )
        raise InputError("PART", "", part, text)
    return opened, holders[0], [part]


def _labels(request: ExportRequest) -> ExportResult:
    """Write the labels of trials as a table."""
    from sliplab.storage.formats.export_trials import label_table
    from sliplab.storage.trials.catalogue import check_table_path, write_table

    check_table_path(request.output)
    opened, campaign, names = _chosen(request)
    table = label_table(opened, campaign.name, names)
    if not len(table):
        raise StoreError(
            f"{opened.folder}: {request.part} has no labels; run: sliplab label {opened.folder}"
        )
    write_table(table, request.output)
    return ExportResult(
        f"labels of {request.part}", {"labels": len(table), "output": str(request.output)}
    )


def _samples(request: ExportRequest) -> ExportResult:
    """Write the samples of one stream of trials as a table."""
    from sliplab.storage.formats.export_trials import sample_table
    from sliplab.storage.trials.catalogue import check_table_path, write_table

    check_table_path(request.output)
    _, campaign, names = _chosen(request)
    stream = request.options.get("stream", "force")
    table = sample_table((campaign.recording(name) for name in names), stream)
    write_table(table, request.output)
    found = {"samples": len(table), "output": str(request.output)}
    return ExportResult(f"samples of {stream} of {request.part}", found)


def _trials(request: ExportRequest) -> ExportResult:
    """Write trials in a format of other programs."""
    from sliplab.storage.formats.export_trials import export_trials
    from sliplab.storage.trials.registration import copy_registrations
    from sliplab.storage.trials.store import REGISTRATIONS

    _, campaign, names = _chosen(request)
    stream = request.options.get("stream", "events")
    recordings = [campaign.recording(name) for name in names]
    for recording in recordings:
        if stream not in recording.streams("events") and stream != "events":
            there = ", ".join(recording.streams("events")) or "none"
            text = f"trial {recording.trial_id} has the streams of events: {there}"
            raise InputError("--stream", "", stream, text)
    with console.bar("export (trials)", len(names)) as bar:
        result = export_trials(
            recordings,
            request.output,
            request.form,
            campaign.name,
            lambda trial: bar.advance(1, trial),
            stream,
        )
    copy_registrations(campaign, request.output / REGISTRATIONS / campaign.name)
    pairs = {key: value for key, value in result.items() if key != "files"}
    return ExportResult(f"exported to {request.output}", result, pairs)
