"""Sensitivity of the study's figures to assumed scene parameters, in the report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from sliplab.analysis.report.figures.intervals import Changed, ChangePanel, lowered_and_raised
from sliplab.analysis.report.page import Content, Figure, Table, number, percent
from sliplab.analysis.report.plugin_sections import ReportData, ReportSection
from sliplab.analysis.report.programs import CommandResult
from sliplab.plugins.studies.document import SensitivityResults
from sliplab.plugins.studies.guesses.results import FIGURES, UNITS, changes, figures
from sliplab.plugins.studies.parameters import AS_IT_IS, NAMES
from sliplab.storage.streams import Json

RESULT = CommandResult("derived/guesses/results.json", "sliplab guesses {store}")
DRAWN = ("strict", "incipient_ms", "gravity_lead_ms", "disturbance_lead_ms")
Side = Mapping[str, Mapping[str, Changed]]
"""Changes by figure and parameter."""


@dataclass(frozen=True)
class SensitivitySection(Content):
    """Each assumed parameter lowered and raised on some of the test trials.

    Attributes:
        command: that measures it.
        percent: by how much; trials: on how many.
    """

    template: ClassVar[Path] = Path(__file__).with_name("section.html")
    command: str
    percent: float = 0.0
    trials: int = 0
    figure: Figure | None = None
    table: Table | None = None


def sensitivity_section(found: Json | None, command: str) -> SensitivitySection:
    """Show how figures change with each parameter.

    Args:
        found: results of `sliplab guesses`; None if there are none.

    Raises:
        StoreError: they are of another shape.
    """
    if found is None:
        return SensitivitySection(command)
    results = RESULT.parse(SensitivityResults, found)
    with RESULT.shape_checked():
        return _made(results, command)


def _made(found: SensitivityResults, command: str) -> SensitivitySection:
    settings = dict(found.settings)
    base = settings.pop(AS_IT_IS)
    unchanged = figures(base)
    lower: dict[str, dict[str, Changed]] = {key: {} for key in FIGURES}
    higher: dict[str, dict[str, Changed]] = {key: {} for key in FIGURES}
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
    return SensitivitySection(
        command,
        share,
        len(base.trials),
        Figure(svg, name="guesses", data=_data(list(names), lower, higher)),
        Table(
            ("guess", *(f"{text} ({UNITS[key]})" for key, text in FIGURES.items())), [first, *rows]
        ),
    )


def _scale(key: str) -> float:
    return 100.0 if key == "strict" else 1.0


def _change_unit(key: str) -> str:
    return "points" if key == "strict" else UNITS[key]


def _changed(
    key: str, base: float | None, value: float | None, span: tuple[float, float] | None
) -> Changed:
    scale = _scale(key)
    change = None if base is None or value is None else scale * (value - base)
    return Changed(change, None if span is None else (scale * span[0], scale * span[1]))


def _at(key: str, base: float | None, found: Changed | None) -> str:
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
                found = side[key].get(name, Changed(None, None))
                unit = _change_unit(key)
                low, high = found.span or (None, None)
                for heading, value in (
                    (f"change of {FIGURES[key]} ({unit})", found.change),
                    (f"{FIGURES[key]}: 95 % interval, low ({unit})", low),
                    (f"{FIGURES[key]}: 95 % interval, high ({unit})", high),
                ):
                    data.setdefault(heading, []).append(value)
    return data


def _make(data: ReportData) -> SensitivitySection | None:
    if data.collected is None or not data.simulated:
        return None
    return sensitivity_section(RESULT.read(data.store), RESULT.command(data.store))


SECTION = ReportSection(_make, RESULT.key, last=True)
"""Assumed parameters in the report."""
