"""The report's words on what other programs measured: other skins, and speed against error."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from sliplab.analysis.report.figures.intervals import Share, shares
from sliplab.analysis.report.page import Figure, Link, Section, Table, percent
from sliplab.flows.reporting import label_tables
from sliplab.flows.reporting.report_extras import FILES, command, odd_shape
from sliplab.flows.reporting.search_section import search
from sliplab.flows.searching import tradeoff_page
from sliplab.protocols.quantity import level_order
from sliplab.storage.trials.store import Store

Json = dict[str, Any]


def skins(store: Store, found: Json | None, summary: Json, simulated: bool) -> Section:
    """The network on skins and levels that it never saw."""
    title = "Other skins, and levels left out"
    if found is None:
        return Section(
            title,
            ["Not measured in this store. It takes half an hour or more; all levels take hours:"],
            commands=[(command(store, "generalisation"), "makes it.")],
        )
    groups: dict[str, list[Share]] = {}
    rows = []
    results = _checked(found, "generalisation", "results")
    for name, row in sorted(results.items(), key=lambda each: each[0].startswith("skin ")):
        if "left out" in row:
            rows.append([name, row["left out"], "", "", "", ""])
            continue
        group = "other skins" if name.startswith("skin ") else f"without a {name.split()[0]}"
        groups.setdefault(group, []).append(Share(name, row["share"], row["low"], row["high"]))
        span = "–"
        if row["low"] is not None:
            span = f"{percent(row['low'])} to {percent(row['high'])}"
        rows.append([name, str(row["trials"]), str(row["n"]), percent(row["share"]), span,
                     percent(row.get("seen"))])  # fmt: skip
    strict = summary["kinematic"]["accuracy"]["strict"]
    pictures = []
    if groups:
        drawn = [item for of in groups.values() for item in of]
        line = None if strict is None else (strict, "this network, its own skin")
        pictures = [
            Figure(
                shares(groups, "windows called rightly (%)", simulated=simulated, line=line),
                "Strict accuracy with 95 % intervals over trials: of the network on skins that "
                "differ by the scatter of their making, and of networks trained without one level "
                "and tested on it. A row left of the dashed line is what was not learned.",
                "skins",
                _share_data(drawn),
            )
        ]
    columns = ("left out, or skin", "trials", "windows", "right", "95 %", "levels that were seen")
    return Section(
        title,
        ["Made by `sliplab generalise`; the report does not check its age."],
        pictures,
        [Table(columns, rows, "Strict accuracy on windows.")],
    )


def in_order(rows: Mapping[str, Json]) -> list[tuple[str, Json]]:
    """A factor's levels by their number, words after numbers."""
    return sorted(rows.items(), key=lambda item: level_order(item[0]))


def factors(by_factor: Mapping[str, Mapping[str, Json]], strict: float | None,
            simulated: bool) -> Figure:  # fmt: skip
    """Accuracy by each factor's levels."""
    groups = {
        factor: [
            Share(level, row["share"], row["low"], row["high"]) for level, row in in_order(rows)
        ]
        for factor, rows in by_factor.items()
    }
    named = [
        replace(item, name=f"{factor} {item.name}") for factor, of in groups.items() for item in of
    ]
    return Figure(
        shares(
            groups, "windows called rightly (%)", simulated=simulated,
            line=None if strict is None else (strict, "all test windows"),
        ),
        "Strict accuracy by each factor's levels, 95 % intervals over trials. Levels whose "
        "interval lies off the dashed line are easier or harder than the rest.",
        "accuracy-by-factor",
        _share_data(named),
    )  # fmt: skip


def _share_data(rows: Sequence[Share]) -> dict[str, Sequence[object]]:
    return {
        "name": [row.name for row in rows],
        "strict accuracy (share)": [row.value for row in rows],
        "95 % interval, low (share)": [row.low for row in rows],
        "95 % interval, high (share)": [row.high for row in rows],
    }


def tradeoff(store: Store, found: Mapping[str, Json]) -> Section:
    """Speed against error of scene, labels and detector, as far as they were measured."""
    said: list[str] = []
    tables: list[Table] = []
    pictures, commands = [], []
    titles = {"scene": "the scene", "labels": "the labels", "labels_truth": "the labels",
              "detector": "the detector"}  # fmt: skip
    for name in titles:
        if name not in found:
            commands.append((command(store, name), f"measures {titles[name]}; not done here."))
    if "scene" in found:
        pictures.append(_scene(found["scene"], said, tables))
    for name in ("labels", "labels_truth"):
        if name in found:
            try:
                made = label_tables.speed if name == "labels" else label_tables.truth
                tables.append(made(_checked(found[name], name, "figures")))
            except (KeyError, TypeError, ValueError) as error:
                raise odd_shape(name, error) from None
    if "detector" in found:
        try:
            picture, table = search(found["detector"], bool(found["detector"]["simulated"]))
        except (KeyError, TypeError, AttributeError) as error:
            raise odd_shape("detector", error) from None
        pictures.append(picture)
        tables.append(table)
    pages = {"scene": "the scene's", "detector": "the detector's"}
    links = []
    for name, subject in pages.items():
        file = (store.folder / FILES[name]).with_suffix(".html")
        if name in found and file.exists():
            address = os.path.relpath(file, store.folder / "report")
            links.append(Link(address.replace(os.sep, "/"), f"The whole of {subject} search"))
    return Section("Speed against error", said, pictures, tables, links, commands)


def _scene(numbers: Json, said: list[str], tables: list[Table]) -> Figure:
    try:
        section = tradeoff_page.make_sections(numbers)[0]
        rows = numbers["variants"]
        errors = list(rows[0]["error"])
    except (KeyError, IndexError, TypeError) as error:
        raise odd_shape("scene", error) from None
    said.append(f"The scene of {numbers['protocol']} (simulated). {section.text[0]}")
    tables += section.tables
    data: dict[str, list[object]] = {
        "family": [row["family"] for row in rows],
        "variant": [row["name"] for row in rows],
        "wall time of a trial (s)": [row["wall_s"] for row in rows],
    }
    for key in errors:
        data[_unit(key)] = [row["error"].get(key) for row in rows]
    return replace(section.figures[0], name="tradeoff-scene", data=data)


def _unit(key: str) -> str:
    """A heading with its unit from a key that ends with it."""
    for ending, unit in (("_ms", "ms"), ("_us", "µs")):
        if key.endswith(ending):
            return f"{key.removesuffix(ending).replace('_', ' ')} ({unit})"
    return f"{key.replace('_', ' ')} (share)"


def _checked(found: Json, name: str, key: str) -> Json:
    inner = found.get(key)
    if not isinstance(inner, dict):
        raise odd_shape(name, KeyError(key))
    return inner
