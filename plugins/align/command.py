"""`sliplab align`: two clocks by events that both saw."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sliplab.flows.cli.common import DATA, JsonOption, finish
from sliplab.flows.running import console, exit_codes
from sliplab.protocols.errors import InputError
from sliplab.protocols.shown import plural

if TYPE_CHECKING:
    from sliplab.plugins.align.align import Alignment
    from sliplab.plugins.align.taps import TapAlignment

app = typer.Typer()
_WRITTEN = ("written", "times", "unknown", "beyond_events")


@app.command(
    "align",
    rich_help_panel=DATA,
    epilog="Example: sliplab align camera.csv robot.csv --map grasps.csv --out on-robot.csv",
)
def align_(
    a: Annotated[Path, typer.Argument(metavar="A.csv", help="Event times on clock A.")],
    b: Annotated[
        str, typer.Argument(metavar="B.csv", help="The same events on clock B; or `harp`.")
    ],
    offset: Annotated[
        float | None,
        typer.Option(
            "--offset",
            min=-1e12,
            max=1e12,
            help="B less A at A's first event, s; for regular pulses, taps.",
        ),
    ] = None,
    within: Annotated[
        float | None,
        typer.Option(
            "--within", min=0, max=1e9, help="By how much --offset may be wrong, s; default: 0.1."
        ),
    ] = None,
    drift: Annotated[
        float,
        typer.Option(
            "--max-drift-ppm", min=0, max=1e5, help="Largest difference of the clocks' rates."
        ),
    ] = 500.0,
    unit: Annotated[
        str | None,
        typer.Option(
            "--unit", help="Of all files: s, ms, us or ns; default: the column's (time_ms), or s."
        ),
    ] = None,
    harp: Annotated[
        bool,
        typer.Option("--harp", help="Edges (time, state) of a Harp clock's 1 kbaud output."),
    ] = False,
    taps: Annotated[
        bool,
        typer.Option("--taps", help="Signals (time, values) that show the same sharp taps."),
    ] = False,
    times: Annotated[
        Path | None, typer.Option("--map", help="CSV of times on A to map; default: A's events.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="CSV of the mapped times to write, in ns.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Fit the map between two clocks by events that both saw, with intervals, or refuse.

    Events are paired by ids (column id), by --offset, or by their pattern: random intervals or a
    code. Missing and spurious events, drift and jumps are found.
    """
    from sliplab.plugins.align.align import WITHIN_S, AlignmentRefused, align
    from sliplab.plugins.align.events import events_from
    from sliplab.plugins.align.taps import align_taps
    from sliplab.protocols.adapter_parts import TIME_UNITS
    from sliplab.storage.trials.catalogue import refuse_store_file

    if unit is not None and unit not in TIME_UNITS:
        raise InputError("--unit", "", unit, "must be one of s, ms, us, ns")
    if within is not None and offset is None:
        raise InputError("--within", "", within, "needs --offset, which it bounds")
    if taps and out is not None and times is None:
        raise InputError("--out", "", str(out), "needs --map, the times to map")
    if times is not None and out is None:
        raise InputError("--map", "", str(times), "needs --out, the file to write")
    if taps and harp:
        raise InputError("--taps", "", True, "goes without --harp")
    if taps and b == "harp":
        raise InputError("B.csv", "", b, "must be a file with a signal: --taps finds taps in it")
    if out is not None and not out.parent.is_dir():
        raise InputError("--out", "", str(out), "its folder does not exist")
    if out is not None:
        refuse_store_file(out, "--out")
    for given in (a, b, times):
        if out is not None and given is not None and Path(out).resolve() == Path(given).resolve():
            raise InputError("--out", "", str(out), "is read, too; name another file")
    if out is not None and out.exists():
        raise InputError("--out", "", str(out), "exists already and is not overwritten")
    limits: dict[str, Any] = {
        "offset_s": offset,
        "within_s": WITHIN_S if within is None else within,
        "max_drift_ppm": drift,
    }
    first = None if taps else events_from(a, "a", unit, harp=harp)
    second = b if taps or b == "harp" else events_from(b, "b", unit, harp=harp)
    try:
        found: Alignment | TapAlignment
        if first is None:
            found = align_taps(a, b, unit=unit, **limits)
        else:
            found = align(first, second, **limits)
    except AlignmentRefused as refusal:
        if as_json:
            console.print_json({"refused": refusal.reason, "message": str(refusal)})
        console.say(f"refused: {refusal.reason}: {refusal}")
        raise typer.Exit(exit_codes.FAILED) from None
    result = found.to_json()
    if first is not None:
        column = second if isinstance(second, str) else second.column
        result = {"columns": {"a": first.column, "b": column}, **result}
    if out is not None:
        listed = first if times is None else events_from(times, "times", unit)
        assert listed is not None  # with --taps times are given
        asked = listed.ns
        mapped = found.map(asked)
        mapped.write(asked, out)
        if far := int(mapped.far.sum()):
            console.say(
                f"warning: {plural(far, 'time')} of {len(asked)}, such as "
                f"{asked[mapped.far][0] / 1e9:g} s, so far from the events that nothing is "
                "known: wrong unit or origin?"
            )
        beyond = int((mapped.known & ~mapped.within).sum())
        result |= {"written": str(out), "times": asked.size}
        result |= {"unknown": int((~mapped.known).sum()), "beyond_events": beyond}
    finish(result if as_json else _pairs(result), f"{a} to {b}", as_json)


def _doubt(part: dict[str, Any]) -> str:
    """Return why an interval is wider than the scatter of the events says."""
    if 2 * part["doubt_ns"] < part["half_ns"]:
        return ""
    doubt = f"; ± {part['doubt_ns'] / 1e3:.1f} us of it"
    if part["unit_ns"] < part["doubt_ns"]:
        return f"{doubt}: its clock may have jumped"
    return f"{doubt}: all stamps of A or of B are multiples of {part['unit_ns'] / 1e9:g} s"


def _pairs(result: dict[str, Any]) -> dict[str, Any]:
    written = {key: result[key] for key in _WRITTEN if key in result}
    if "taps" in result:
        least, most = result["drift_ppm"]
        return {
            "taps": result["taps"],
            "offset": f"B = A + {result['offset_ns'] / 1e9:.9f} s ± {result['half_ns'] / 1e3:.1f} "
            f"us at A = {result['first_ns'] / 1e9:.3f} s",
            "rate": f"{least:+.1f} to {most:+.1f} ppm",
            **written,
        }
    pairs = sum(part["events"] for part in result["stretches"])
    shown: dict[str, Any] = {
        "paired by": result["paired_by"],
        "columns": " and ".join(result["columns"].values()),
        "events": f"{result['events_a']} and {result['events_b']}; {pairs} in pairs",
    }
    for number, part in enumerate(result["stretches"], 1):
        seconds = (part["last_ns"] - part["first_ns"]) / 1e9
        shown[f"stretch {number}"] = (
            f"{part['events']} pairs in {seconds:.1f} s: B = A + {part['offset_ns'] / 1e9:.9f} s "
            f"± {part['half_ns'] / 1e3:.1f} us (95 %) at A = {part['middle_ns'] / 1e9:.3f} s, rate "
            f"{part['rate_ppm']:+.3f} ppm, scatter {part['scatter_ns'] / 1e3:.1f} us{_doubt(part)}"
        )
    for number, jump in enumerate(result["jumps"], 1):
        shown[f"jump {number}"] = (
            f"{jump['size_ns'] / 1e9:+.6f} s between A = {jump['after_ns'] / 1e9:.3f} and "
            f"{jump['before_ns'] / 1e9:.3f} s"
        )
    return shown | written
