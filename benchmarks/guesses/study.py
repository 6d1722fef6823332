"""`python -m benchmarks.guesses STORE`: a study's figures with each assumed parameter changed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from benchmarks.guesses.document import SensitivityResults
from benchmarks.guesses.plot import ChangePanel, FigureChange, lowered_and_raised
from benchmarks.guesses.results import FIGURES, UNITS, changes, figure_cells, figures
from benchmarks.scene_parameters import AS_IT_IS, NAMES
from sliplab.analysis.report.page import Figure, Table, number, percent
from sliplab.analysis.study import Finding, Study
from sliplab.flows.cli.common import CampaignOption, StoreArgument, opened_campaigns

GUESSES = tuple(NAMES)
"""Assumed parameters that are varied by default."""
DRAWN = ("strict", "incipient_ms", "gravity_lead_ms", "disturbance_lead_ms")
Side = Mapping[str, Mapping[str, FigureChange]]
"""Changes by figure and parameter."""


def measure(
    store: StoreArgument,
    guess: Annotated[
        list[str] | None,
        typer.Option("--guess", help="Only this assumed parameter of the scene. Repeatable."),
    ] = None,
    trials: Annotated[
        int, typer.Option("--trials", min=2, max=1_000_000, help="Test trials per campaign.")
    ] = 20,
    campaign: CampaignOption = None,
) -> Finding[SensitivityResults]:
    """Evaluate some test trials again with each assumed scene parameter 20 % lower and higher."""
    opened, campaigns = opened_campaigns(store, campaign)
    from benchmarks.guesses.run import measure_guesses  # imports Prefect

    found = measure_guesses(opened, campaigns, tuple(guess or GUESSES), trials)
    return Finding(SensitivityResults.load(Path(found.file)), Path(found.file).parent)


def shown(found: SensitivityResults) -> Iterator[Table | str]:
    """Yield the figures at each setting."""
    columns = ["setting", *(f"{text} ({UNITS[name]})" for name, text in FIGURES.items())]
    rows = [
        [
            name.removeprefix("scene.").removeprefix("event_camera."),
            *figure_cells(figures(setting)),
        ]
        for name, setting in found.settings.items()
    ]
    yield Table(columns, rows, "guesses, simulated")


def view(found: SensitivityResults) -> dict[str, Any]:
    """Return how figures change with each parameter."""
    settings = dict(found.settings)
    base = settings.pop(AS_IT_IS)
    unchanged = figures(base)
    lower: dict[str, dict[str, FigureChange]] = {key: {} for key in FIGURES}
    higher: dict[str, dict[str, FigureChange]] = {key: {} for key in FIGURES}
    names: dict[str, None] = {}
    for setting in settings.values():
        parameter = setting.parameter or ""
        name = NAMES.get(parameter, parameter.split(".")[-1])
        names[name] = None
        values, spans = figures(setting), changes(base, setting)
        side = lower if setting.factor < 1 else higher
        for key in FIGURES:
            side[key][name] = _changed(key, unchanged[key], values[key], spans[key])
    share = 100 * found.change
    panels = [
        ChangePanel(
            f"{FIGURES[key]}\n({_change_unit(key)})",
            lower[key],
            higher[key],
            f"as it is: {_value(key, unchanged[key])}",
        )
        for key in DRAWN
        if unchanged[key] is not None
    ]
    svg = lowered_and_raised(list(names), panels, simulated=True, percent=share)
    rows = [
        [
            name,
            *(
                " / ".join(
                    _at(key, unchanged[key], side[key].get(name)) for side in (lower, higher)
                )
                for key in FIGURES
            ),
        ]
        for name in names
    ]
    first = [AS_IT_IS, *(_value(key, unchanged[key], unit=False) for key in FIGURES)]
    return {
        "percent_changed": share,
        "trials": len(base.trials),
        "figures": Figure(svg, name="guesses", data=_data(list(names), lower, higher)),
        "settings": Table(
            ("guess", *(f"{text} ({UNITS[key]})" for key, text in FIGURES.items())), [first, *rows]
        ),
    }


def _scale(key: str) -> float:
    return 100.0 if key == "strict" else 1.0


def _change_unit(key: str) -> str:
    return "points" if key == "strict" else UNITS[key]


def _changed(
    key: str, base: float | None, value: float | None, span: tuple[float, float] | None
) -> FigureChange:
    scale = _scale(key)
    change = None if base is None or value is None else scale * (value - base)
    return FigureChange(change, None if span is None else (scale * span[0], scale * span[1]))


def _at(key: str, base: float | None, found: FigureChange | None) -> str:
    """Return a changed figure as text."""
    if found is None or found.change is None or base is None:
        return _value(key, None, unit=False)
    return _value(key, base + found.change / _scale(key), unit=False)


def _value(key: str, value: float | None, *, unit: bool = True) -> str:
    if key == "strict":
        return percent(value) if unit else number(None if value is None else 100 * value)
    return number(value, 3 if UNITS[key] == "mm" else 0, UNITS[key] if unit else "")


def _data(names: Sequence[str], lower: Side, higher: Side) -> dict[str, list[object]]:
    """Return the plotted data, a row a parameter and side."""
    data: dict[str, list[object]] = {"guess": [], "factor": []}
    for side, word in ((lower, "less"), (higher, "more")):
        for name in names:
            data["guess"].append(name)
            data["factor"].append(word)
            for key in FIGURES:
                found = side[key].get(name, FigureChange(None, None))
                unit = _change_unit(key)
                low, high = found.span or (None, None)
                for heading, value in (
                    (f"change of {FIGURES[key]} ({unit})", found.change),
                    (f"{FIGURES[key]}: 95 % interval, low ({unit})", low),
                    (f"{FIGURES[key]}: 95 % interval, high ({unit})", high),
                ):
                    data.setdefault(heading, []).append(value)
    return data


STUDY = Study(
    name="guesses",
    title="Figures of a study with each assumed parameter changed, by SlipLab",
    measure=measure,
    result=SensitivityResults,
    page=Path(__file__).with_name("page.html"),
    view=view,
    shown=shown,
    example="python -m benchmarks.guesses my-study",
)
