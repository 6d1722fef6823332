"""The report's words on the scene's guesses: what the study's figures owe to each."""

from __future__ import annotations

from typing import Any

from sliplab.analysis.report.figures.intervals import Changed, ChangePanel, lowered_and_raised
from sliplab.analysis.report.page import Figure, Section, Table, number, percent
from sliplab.analysis.sweeps.sensitivity import AS_IT_IS, FIGURES, NAMES, UNITS, changes, figures
from sliplab.flows.reporting.report_extras import command, odd_shape
from sliplab.storage.trials.store import Store

Json = dict[str, Any]

TITLE = "What the guesses of the scene decide"
_DRAWN = ("strict", "incipient_ms", "gravity_lead_ms", "disturbance_lead_ms")


def section(store: Store, found: Json | None) -> Section:
    """Each guess 20 % down and up on some of the test trials; how to measure it where it is not.

    Raises:
        StoreError: the file is of another shape.
    """
    if found is None:
        return Section(
            TITLE,
            ["Not measured in this store. It takes some minutes:"],
            commands=[(command(store, "guesses"), "makes it.")],
        )
    try:
        return _made(found)
    except (KeyError, TypeError, AttributeError, IndexError) as error:
        raise odd_shape("guesses", error) from None


def _made(found: Json) -> Section:
    settings: dict[str, Json] = dict(found["settings"])
    base = settings.pop(AS_IT_IS)
    unchanged = figures(base)
    sides: dict[str, dict[str, dict[str, Changed]]] = {"lower": {}, "higher": {}}
    rows: dict[str, None] = {}
    for setting in settings.values():
        name = _short(setting["parameter"])
        rows[name] = None
        figures_of, spans = figures(setting), changes(base, setting)
        side = sides["lower" if setting["factor"] < 1 else "higher"]
        for key in FIGURES:
            side.setdefault(key, {})[name] = _changed(
                key, unchanged[key], figures_of[key], spans[key]
            )
    trials = len(base["trials"])
    share = 100 * found["change"]
    panels = [
        ChangePanel(
            _label(key), sides["lower"].get(key, {}), sides["higher"].get(key, {}),
            f"as it is: {_value(key, unchanged[key])}",
        )
        for key in _DRAWN
        if unchanged[key] is not None
    ]  # fmt: skip
    names = list(rows)
    picture = Figure(
        lowered_and_raised(names, panels, simulated=True, percent=share),
        f"Change of each figure when one guess is {share:.0f} % lower or higher, 95 % intervals "
        "over the same trials. An interval that leaves zero out is a figure that the guess "
        "decides; the network was trained on the scene as it is, and is not trained again.",
        "guesses",
        _data(names, sides),
    )
    table = Table(
        ("guess", *(f"{text} ({UNITS[key]})"
                    for key, text in FIGURES.items())),
        [[AS_IT_IS, *(_value(key, unchanged[key], unit=False) for key in FIGURES)],
         *([name, *(_both(key, name, unchanged[key], sides) for key in FIGURES)]
           for name in names)],
        f"{share:.0f} % less / {share:.0f} % more of each: means, medians of latencies.",
    )  # fmt: skip
    return Section(
        TITLE,
        [
            "No number of the scene was changed after its freeze, and none is known of a real "
            f"skin. These are its guesses, each {share:.0f} % down and up: {trials} test trials "
            "spread over their conditions were taken again with the same seeds, labelled anew and "
            "judged by this network and these detection settings. The rig finds depth zero by "
            "touching, which it tells by events: what changes these moves every depth, too."
        ],
        [picture],
        [table],
    )


def _short(name: str) -> str:
    return NAMES.get(name, name.split(".")[-1])


def _scale(key: str) -> float:
    return 100.0 if key == "strict" else 1.0


def _changed(
    key: str, base: float | None, value: float | None, span: tuple[float, float] | None
) -> Changed:
    scale = _scale(key)
    change = None if base is None or value is None else scale * (value - base)
    return Changed(change, None if span is None else (scale * span[0], scale * span[1]))


def _change_unit(key: str) -> str:
    return "points" if key == "strict" else UNITS[key]


def _label(key: str) -> str:
    return f"{FIGURES[key]}\n({_change_unit(key)})"


def _value(key: str, value: float | None, *, unit: bool = True) -> str:
    if key == "strict":
        return percent(value) if unit else number(None if value is None else 100 * value)
    return number(value, 3 if UNITS[key] == "mm" else 0, UNITS[key] if unit else "")


def _both(key: str, name: str, base: float | None, sides: dict[str, Any]) -> str:
    """The figure with less and with more of the guess."""
    shown = []
    for side in ("lower", "higher"):
        found = sides[side].get(key, {}).get(name)
        known = found is not None and found.change is not None and base is not None
        value = base + found.change / _scale(key) if known else None
        shown.append(_value(key, value, unit=False))
    return " / ".join(shown)


def _data(names: list[str], sides: dict[str, Any]) -> dict[str, list[object]]:
    """What is drawn, a row a guess and side."""
    data: dict[str, list[object]] = {"guess": [], "factor": []}
    for side, word in (("lower", "less"), ("higher", "more")):
        for name in names:
            data["guess"].append(name)
            data["factor"].append(word)
            for key in FIGURES:
                found = sides[side].get(key, {}).get(name)
                unit = _change_unit(key)
                low, high = (None, None) if found is None or found.span is None else found.span
                for heading, value in (
                    (f"change of {FIGURES[key]} ({unit})", None if found is None else found.change),
                    (f"{FIGURES[key]}: 95 % interval, low ({unit})", low),
                    (f"{FIGURES[key]}: 95 % interval, high ({unit})", high),
                ):
                    data.setdefault(heading, []).append(value)
    return data
