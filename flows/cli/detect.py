"""`sliplab detect`: the detector live on a rig's event stream."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sliplab.flows.cli.common import ANALYSE, EnableOption, JsonOption, PromiseOption, RigOption
from sliplab.flows.cli.model_options import model_options
from sliplab.flows.planning.parameters import RuleOptions
from sliplab.flows.running import console, exit_codes
from sliplab.protocols.errors import InputError
from sliplab.protocols.shown import one_of

if TYPE_CHECKING:
    from sliplab.flows.detect import DetectSummary
    from sliplab.flows.detecting.sink import Times
    from sliplab.flows.store_detectors import Chosen

app = typer.Typer()


@app.command(
    rich_help_panel=ANALYSE,
    epilog="Example: sliplab detect --rig mock --model my-store/models/seed0.pt --protocol pilot",
)
@model_options
def detect(
    rig: RigOption,
    model: Annotated[
        Path | None,
        typer.Option(
            "--model",
            help="A trained network, models/seed0.pt, a store with one, or a .json of `sliplab "
            "calibrate detector`.",
        ),
    ] = None,
    detector: Annotated[
        str,
        typer.Option(
            "--detector",
            help="Of a store: network or paper (with the rule), or a compared one, such as 'hmm "
            "counts', at the level that validation trials set; or any of `sliplab bench`.",
        ),
    ] = "network",
    level: Annotated[
        float | None,
        typer.Option(
            "--level",
            min=-1e9,
            max=1e9,
            help="Evidence above which a detector of `sliplab bench` says slip; default: set by "
            "the store's validation trials.",
        ),
    ] = None,
    promise: PromiseOption = None,
    protocol: Annotated[
        Path | None,
        typer.Option("--protocol", help="Run a trial of this protocol; default: only listen."),
    ] = None,
    trial: Annotated[
        str | None,
        typer.Option("--trial", help="Condition of the trial: depth=2.4mm,direction=0deg."),
    ] = None,
    enable: EnableOption = None,
    reflex: Annotated[
        str | None,
        typer.Option(
            "--reflex",
            help="Reaction to incipient slip: stop, press:MM or grip:MM. Needs --protocol.",
        ),
    ] = None,
    hold: Annotated[
        float,
        typer.Option("--hold", min=0, max=60, help="Keep still and observe after a reflex, s."),
    ] = 1.0,
    seconds: Annotated[
        float | None,
        typer.Option(
            "--seconds", min=0.1, max=1_000_000, help="Listen this long; default: until Ctrl-C."
        ),
    ] = None,
    stride: Annotated[
        float | None,
        typer.Option(
            "--stride",
            min=0,
            max=1000,
            help="Time between windows, ms; default: the window length.",
        ),
    ] = None,
    rule: RuleOptions = RuleOptions(),
    poll: Annotated[
        float, typer.Option("--poll", min=1, max=200, help="Polling period of the streams, ms.")
    ] = 5.0,
    out: Annotated[
        Path | None, typer.Option("--out", help="Write decisions as JSON lines while it runs.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Detect slip live on a rig's event stream. Ctrl-C stops the arm at once."""
    from sliplab.flows.detect import detect as run
    from sliplab.flows.detecting.request import make_detect_request

    chosen = _chosen(model, detector, level, stride, rule, promise)
    order = make_detect_request(
        rig,
        chosen.model,
        protocol=protocol,
        trial=trial,
        enable=tuple(enable or ()),
        reflex=reflex,
        hold_s=hold,
        seconds=seconds,
        stride_ms=stride if chosen.stride_ms is None else chosen.stride_ms,
        **rule.model_dump(),
        poll_s=poll / 1000,
        detector=chosen.detector,
        promise=promise,
        set_by=chosen.set_by,
    )
    result = run(order, out)
    if as_json:
        console.print_json(result)
    else:
        simulated = " (simulated)" if result["simulated"] else ""
        console.print_pairs(f"detect on {result['rig']}{simulated}", _shown(result))
    if result["interrupted"]:
        raise typer.Exit(exit_codes.INTERRUPTED)


def _chosen(
    model: Path | None,
    detector: str,
    level: float | None,
    stride: float | None,
    rule: RuleOptions,
    promise: float | None,
) -> Chosen:
    """Return a network with the rule, a detector of a store, or one by its name.

    Raises:
        InputError: there is no such detector, or it has no such option.
        StoreError: a network of the store is missing or stale.
    """
    if model is not None and model.suffix == ".json":
        if detector != "network":
            right = f"cannot be given with {model}, which is a detector"
            raise InputError("--detector", "", detector, right)
        model, detector = None, str(model)
    store = model if model is not None and model.is_dir() else None
    if store is not None:
        from sliplab.flows.steps import prepare_store
        from sliplab.storage.remote.mirror import open_store

        open_store(store)
        prepare_store(store)  # before anything imports Prefect
    from sliplab.analysis.detectors.registry import is_known, known
    from sliplab.flows.store_detectors import Chosen, detectors_of

    if detector == "network" and model is None:
        right = "is needed: a trained network, or a store; or name a --detector with a --level"
        raise InputError("--model", "", None, right)
    if store is None and not is_known(detector):
        if detector != "network":
            right = f"{one_of(detector, known())}; one of a store needs the store as --model"
            raise InputError("--detector", "", detector, right)
        found = Chosen(model)
    else:
        found = detectors_of(store, [detector], level, promise)[detector]
    if level is not None and found.model is not None:
        right = f"is of detectors of `sliplab bench`; '{detector}' has its own"
        raise InputError("--level", "", level, right)
    if found.detector is not None:
        given = (("--stride", stride), ("--margin", rule.margin), ("--smoothing", rule.smoothing))
        for name, value in given:
            if value is not None:
                right = f"is of the rule; '{detector}' has the stride and level of its validation"
                raise InputError(name, "", value, right)
    return found


def _shown(result: DetectSummary) -> dict[str, str | None]:
    """Format the summary in a few lines."""
    latency, compute, losses = result["latency_ms"], result["compute_ms"], result["losses"]
    clock = "virtual" if result["virtual_time"] else "real"
    found: dict[str, str | None] = {
        "windows": f"{result['windows']} ({result['quiet_windows']} without events)",
        "states": ", ".join(f"{name} {count}" for name, count in result["states"].items()),
        f"last event to decision, ms ({clock} time)": _spread(latency),
        "read to decision, ms": _spread(compute),
        "lost": f"{losses['late']} events late, {losses['gaps']} gaps",
    }
    for name, onset in result["onsets"].items():
        where = "" if onset is None or not onset["phase"] else f" ({onset['phase']})"
        found[f"first {name}"] = None if onset is None else f"{onset['trial_s']:.3f} s{where}"
    if result["promise"] is not None:
        found["promise"] = result["promise"]["says"]
    if result["reflex"] is not None:
        reflex = result["reflex"]
        done = f"{reflex['kind']}: not called for"
        if reflex["done"]:
            done = (
                f"{reflex['kind']} in the {reflex['phase']}, arm at rest after "
                f"{reflex['stop_ms']:.1f} ms, depth {reflex['depth_mm']:.2f} mm"
            )
            parts = reflex["reaction_ms"]
            found[f"reaction, ms ({clock} time, network real)"] = (
                f"{parts['total']:.1f}: window {parts['window']:.0f}, sensor "
                f"{parts['sensor']:.1f}, network {parts['network']:.1f}, command "
                f"{parts['command']:.1f}, actuator {parts['actuator']:.1f}"
            )
        found["reflex"] = done
    return found


def _spread(times: Times) -> str | None:
    if not times["n"]:
        return None
    return f"median {times['median']:.2f}, 99 % {times['p99']:.2f}, most {times['max']:.2f}"
