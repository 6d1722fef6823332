"""The command line. Heavy libraries load inside the commands that use them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from flows import console
from flows.cli_calibrate import calibrate_app, teach_app
from flows.cli_control import register as register_control
from flows.cli_rigs import rigs
from protocols.errors import InputError

app = typer.Typer(
    name="sliplab",
    help="Run tactile slip experiments: plan, collect, sync, label, train, evaluate, report.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

app.command()(rigs)
register_control(app)
app.add_typer(teach_app, name="teach")
app.add_typer(calibrate_app, name="calibrate")

ProtocolArgument = Annotated[Path, typer.Argument(help="A protocol file (YAML).")]
StoreArgument = Annotated[Path, typer.Argument(help="A store's folder.")]
RigOption = Annotated[
    Path, typer.Option("--rig", help="A rig file (YAML), or the name of one that ships: mock.")
]
StoreOption = Annotated[Path, typer.Option("--store", help="The store's folder; made if missing.")]
JsonOption = Annotated[
    bool, typer.Option("--json", help="One JSON object on standard output, the rest on error.")
]
EnableOption = Annotated[
    list[str] | None, typer.Option("--enable", help="Switch an optional level on: factor=level.")
]
CampaignOption = Annotated[
    list[str] | None, typer.Option("--campaign", help="Only this campaign; may be given again.")
]


FULL = ("kinematic", "gravity", "disturbance")
PILOT = ("pilot", "pilot_gravity")
SHOWN = (
    "campaign", "trial", "recorded_s", "events", "frames", "frame_source", "attempt", "simulated"
)  # fmt: skip
"""Columns of the catalogue that fit a terminal."""


def package_file(package: str, name: str) -> Path:
    """A file that ships with a package."""
    module = __import__(package)
    return Path(module.__path__[0]) / name


@app.command()
def plan(
    protocol: ProtocolArgument,
    rig: Annotated[
        Path | None, typer.Option("--rig", help="A rig file or name, for bytes.")
    ] = None,
    enable: EnableOption = None,
    as_json: JsonOption = False,
) -> None:
    """Print the trials in the order they will be taken, with hours and (given a rig) bytes."""
    from flows import plan_view
    from protocols.plan import load_plan

    found = load_plan(protocol, enable or ())
    needed, scene = None, None
    if rig is not None:
        from flows.estimate import plan_bytes
        from flows.plan_scene import scene_of
        from rigs.rig_file import check_plan, load_rig_file

        rig_file, _ = load_rig_file(rig)
        check_plan(rig_file, found, str(rig))
        needed = round(plan_bytes(rig_file, found))
        scene = scene_of(rig_file, found)
    if as_json:
        console.print_json(plan_view.as_json(found, needed, scene))
    else:
        plan_view.show(found, needed, scene)


@app.command()
def check(
    protocol: ProtocolArgument,
    rig: RigOption,
    store: StoreOption,
    enable: EnableOption = None,
    as_json: JsonOption = False,
) -> None:
    """Look at everything that can be known before anything moves."""
    from flows import preflight

    found = preflight.check(protocol, rig, store, tuple(enable or ()))
    if as_json:
        console.print_json(preflight.as_json(found))
    else:
        rows = [["ok" if item.passed else "FAILED", item.name, item.finding] for item in found]
        console.print_table(f"check {protocol} on {rig}", ["", "what", "found"], rows)
    if not all(item.passed for item in found):
        raise typer.Exit(console.FAILED)


@app.command()
def collect(
    protocol: ProtocolArgument,
    rig: RigOption,
    store: StoreOption,
    enable: EnableOption = None,
    trials: Annotated[
        int | None, typer.Option("--trials", min=1, help="Take so many of the missing, no more.")
    ] = None,
    campaign: Annotated[
        str | None, typer.Option("--campaign", help="Its name; the protocol's by default.")
    ] = None,
    operator: Annotated[str, typer.Option("--operator", help="Who stands at the rig.")] = "",
    temperature: Annotated[
        float | None, typer.Option("--temperature", help="Of the room, degrees Celsius.")
    ] = None,
    humidity: Annotated[
        float | None, typer.Option("--humidity", min=0, max=100, help="Relative, percent.")
    ] = None,
    note: Annotated[str, typer.Option("--note", help="Anything worth keeping.")] = "",
    as_json: JsonOption = False,
) -> None:
    """Take the trials that the store lacks. Ctrl-C stops the arm; run it again to go on."""
    from flows.orders import Bench, check_disk, make_order

    order = make_order(
        protocol,
        rig,
        store,
        enable=tuple(enable or ()),
        campaign=campaign,
        bench=Bench(operator, temperature, humidity, note),
        most=trials,
    )
    for warning in order.plan.warnings():
        console.say(f"note: {warning}")
    check_disk([order])
    _prepare(store)
    from flows.collect import collect as run

    result = run(order)
    if not result["taken"]:
        console.say("nothing to do: the store holds every trial that can be taken")
    if not as_json:
        from flows.aside_view import show_aside

        show_aside(result["causes"])
        result = {key: value for key, value in result.items() if key != "causes"}
    _finish(result, f"collected into {store}", as_json)
    if result["missing"] > result["left_out"]:
        raise typer.Exit(console.FAILED)


@app.command()
def sync(
    store: StoreArgument, campaign: CampaignOption = None, as_json: JsonOption = False
) -> None:
    """Fit the clocks of every trial again and write report/sync.html about them."""
    result = _run_step(store, campaign, "sync")
    if as_json:
        console.print_json(result)
        return
    from flows.sync import COLUMNS, tables

    for title, rows in tables(result):
        console.print_table(title, COLUMNS, rows)
    console.results.print(
        "Median and worst: uncertainty of events against the device, both clocks together; "
        "of events that of their own clock."
    )
    simulated = " (simulated)" if result["simulated"] else ""
    console.results.print(f"Page{simulated}: {Path(result['page']).resolve()}", soft_wrap=True)


@app.command()
def label(
    store: StoreArgument, campaign: CampaignOption = None, as_json: JsonOption = False
) -> None:
    """Find the true onsets of every trial from its video, or from the tracks in its place."""
    _step(store, campaign, as_json, "label")


@app.command()
def train(
    store: StoreArgument, campaign: CampaignOption = None, as_json: JsonOption = False
) -> None:
    """Train the spiking network on the labelled kinematic trials."""
    _step(store, campaign, as_json, "train")


@app.command()
def evaluate(
    store: StoreArgument,
    campaign: CampaignOption = None,
    margin: Annotated[
        float | None, typer.Option("--margin", min=0, help="Spikes a winner must lead by.")
    ] = None,
    smoothing: Annotated[
        int | None, typer.Option("--smoothing", min=1, help="Windows to average over.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Score the network on trials it has never seen."""
    _step(store, campaign, as_json, "evaluate", margin=margin, smoothing=smoothing)


@app.command()
def report(
    store: StoreArgument, campaign: CampaignOption = None, as_json: JsonOption = False
) -> None:
    """Write report/index.html and report/summary.json."""
    _step(store, campaign, as_json, "report")
    console.say(f"report: {store / 'report' / 'index.html'}")


@app.command()
def study(
    folder: Annotated[Path, typer.Argument(help="The study's store; made if missing.")],
    rig: RigOption,
    pilot: Annotated[bool, typer.Option("--pilot", help="The small protocols.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Run the whole chain: collect, sync, label, train, evaluate, report."""
    names = PILOT if pilot else FULL
    protocols = [package_file("protocols", f"{name}.yaml") for name in names]
    _chain(folder, protocols, rig, as_json)


@app.command()
def demo(
    folder: Annotated[Path, typer.Argument(help="Where its store goes.")] = Path("sliplab-demo"),
    rig: RigOption = Path("rehearsal"),
    as_json: JsonOption = False,
) -> None:
    """Run the pilot study on the simulated rig and say where the report is."""
    protocols = [package_file("protocols", f"{name}.yaml") for name in PILOT]
    if rig == Path("rehearsal"):
        console.say(
            "The demo's outside camera hands over simulated tracks of the markers, no video; "
            "`sliplab demo --rig mock` draws, stores and tracks the video, which takes longer."
        )
    _chain(folder, protocols, rig, as_json)


@app.command()
def trials(
    store: StoreArgument,
    where: Annotated[
        str | None, typer.Option("--where", help="Only rows for which this holds.")
    ] = None,
    output: Annotated[
        Path | None, typer.Option("--output", help="Write a .csv or .json file instead.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """The catalogue of committed trials as a table, and what was set aside, with causes."""
    from flows.aside_view import all_aside, show_aside
    from storage.catalogue import catalogue, query
    from storage.store import Store

    unreadable: list[str] = []
    table = catalogue(Store.open(store), unreadable)
    aside = all_aside(Store.open(store), unreadable)
    for problem in unreadable:
        console.say(f"left out: {problem}")
    if where is not None:
        try:
            table = query(table, where)
        except ValueError as error:
            raise InputError("--where", "", where, str(error)) from None
    if output is not None:
        from storage.files import write_text

        kinds: dict[str, Callable[[], str]] = {
            ".csv": lambda: table.to_csv(index=False),
            ".json": lambda: table.to_json(orient="records"),
        }
        if output.suffix not in kinds:
            raise InputError("--output", "", str(output), "must end in .csv or .json")
        write_text(output, kinds[output.suffix]())
        console.say(f"{len(table)} trials: {output}")
    if as_json:
        import json

        console.print_json(
            {
                "count": len(table),
                "trials": json.loads(table.to_json(orient="records")),
                "set_aside": aside,
                "unreadable": unreadable,
            }
        )
    elif output is None:
        shown = [name for name in SHOWN if name in table.columns]
        rows = [list(row) for row in table[shown].itertuples(index=False)]
        console.print_table(f"trials of {store}", shown, rows, limit=40)
        show_aside(aside)
        console.say(f"{len(table)} trials; --json and --output have all {table.shape[1]} columns")


@app.command()
def verify(
    store: StoreArgument,
    quarantine: Annotated[
        bool,
        typer.Option("--quarantine", help="Set damaged trials aside, to be taken again."),
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Check every checksum, count and clock of a store; changes nothing unless told to."""
    from storage.store import Store
    from storage.verify import set_aside, trial_folders
    from storage.verify import verify as look

    opened = Store.open(store)
    total = sum(len(trial_folders(campaign)) for campaign in opened.campaigns())
    with console.bar("verify (trials)", total) as bar:
        problems = look(opened, lambda name: bar.advance(1, name))
    moved: list[str] = []
    if quarantine and any(item.trial for item in problems):
        from flows.stretch import owned

        with owned(opened):
            moved = set_aside(opened, problems)
        console.say(f"{len(moved)} damaged trials are in quarantine; `sliplab collect` takes them")
    if as_json:
        damaged = len({(item.campaign, item.trial) for item in problems if item.trial})
        console.print_json(
            {
                "trials": total,
                "whole": total - damaged,
                "damaged": damaged,
                "format": opened.format,
                "ok": not problems,
                "problems": [vars(item) for item in problems],
                "quarantined": moved,
            }
        )
    elif problems:
        rows = [[item.path, item.what] for item in problems]
        console.print_table(f"{len(problems)} problems", ["where", "what is wrong"], rows)
    else:
        console.results.print(f"{total} trials, all as they were committed")
    if problems:
        raise typer.Exit(console.FAILED)


@app.command()
def migrate(store: StoreArgument, as_json: JsonOption = False) -> None:
    """Bring a store of an older version to this one's format; copies of what changes are kept.

    `collect` does the same before it begins.
    """
    from storage.errors import disk_explained
    from storage.lock import exclusive
    from storage.migrate import kept
    from storage.migrate import migrate as bring
    from storage.store import Store

    opened = Store.open(store)
    with (
        disk_explained(opened.folder),
        exclusive(opened.folder / ".lock", f"the store {opened.folder}"),
    ):
        passed = bring(opened)
    copies = [str(kept(opened, number)) for number in passed]
    if as_json:
        console.print_json({"format": opened.format, "from": passed, "copies": copies})
    elif passed:
        console.results.print(f"format {passed[0]} to {opened.format}; copies: {copies}")
    else:
        console.results.print(f"nothing to do: format {opened.format} is the newest")


@app.command()
def tradeoff(
    scene: Annotated[
        Path, typer.Option("--scene", help="The protocol whose scene is simulated (YAML).")
    ],
    rig: RigOption = Path("mock"),
    out: Annotated[
        Path, typer.Option("--out", help="Folder for page and numbers; made if missing.")
    ] = Path("sliplab-tradeoff"),
    trials: Annotated[int, typer.Option("--trials", min=1, help="Trials to simulate.")] = 4,
    sensitivity: Annotated[
        bool, typer.Option("--sensitivity", help="Also what each guessed number changes.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Measure what simulating a protocol's scene costs, and how far off cheaper ways are."""
    from flows import tradeoff as steps
    from flows.tradeoff_page import choice_pairs, short_table

    result = steps.tradeoff(scene, rig, out, trials, sensitivity)
    if as_json:
        console.print_json(result)
        return
    title = f"Cost and error of the scene of {result['protocol']} (simulated)"
    console.print_table(title, *short_table(result))
    console.print_pairs("The level that the protocol needs", choice_pairs(result))
    console.results.print(f"Page (simulated): {(out / steps.PAGE).resolve()}", soft_wrap=True)


def _prepare(folder: Path) -> None:
    """Make the store and point Prefect at it; everything that imports Prefect comes after."""
    from flows.orchestration import prepare
    from storage.store import Store

    prepare(Store.create(folder).folder)


def _step(folder: Path, names: list[str] | None, as_json: bool, step: str, **options: Any) -> None:
    """Run one analysis step on a store and print what it did."""
    _finish(_run_step(folder, names, step, **options), f"{step} {folder}", as_json)


def _run_step(folder: Path, names: list[str] | None, step: str, **options: Any) -> dict[str, Any]:
    """Run one analysis step on a store."""
    from importlib import import_module

    from storage.store import Store

    store = Store.open(folder)
    _prepare(folder)
    from flows.campaigns import collected

    result: dict[str, Any] = getattr(import_module(f"flows.{step}"), step)(
        store, collected(store, names), **options
    )
    if not result["done"]:
        console.say(f"{step}: nothing to do, all {result['fresh']} results are fresh")
    return result


def _chain(folder: Path, protocols: list[Path], rig: Path, as_json: bool) -> None:
    """Run the whole chain and print what came out."""
    from flows.orders import check_disk, make_order

    orders = [make_order(protocol, rig, folder) for protocol in protocols]
    check_disk(orders)
    _prepare(folder)
    from flows.report import read_summary
    from flows.study import study as run
    from storage.store import Store

    outcome = run(orders)
    summary = read_summary(Store.open(folder))
    page = folder / "report" / "index.html"
    if as_json:
        console.print_json(
            {
                "report": str(page),
                "collected": outcome.collected,
                "steps": outcome.steps,
                "summary": summary,
            }
        )
        return
    from flows.sections import headline

    simulated = " (simulated)" if summary["simulated"] else ""
    rows = [[item.name, item.value, item.note] for item in headline(summary)]
    for name, value in summary["kinematic"]["baselines"].items():
        shown = "-" if value is None else f"{100 * value:.1f} %"
        rows.append([f"baseline: {name.replace('_', ' ')}", shown, "argmax, same windows"])
    argmax = summary["kinematic"]["accuracy"]["argmax"]
    rows.append(["network", "-" if argmax is None else f"{100 * argmax:.1f} %", "argmax"])
    console.print_table(f"Results{simulated}", ["figure", "value", "note"], rows)
    console.results.print(f"Report{simulated}: {page.resolve()}", soft_wrap=True)


def _finish(result: dict[str, Any], title: str, as_json: bool) -> None:
    if as_json:
        console.print_json(result)
        return
    shown = {
        key: ", ".join(map(str, value)) or "none" if isinstance(value, list) else value
        for key, value in result.items()
    }
    console.print_pairs(title, shown)
