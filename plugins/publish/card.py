"""The data card of a publication, `README.md`: what is in it, how it was made, its limits."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import pyarrow as pa

from sliplab.plugins.publish.publication import Publication
from sliplab.protocols.shown import plural
from sliplab.storage.streams import Column
from sliplab.storage.trials.hdf5_writer import COLUMNS, STREAMS, TIMING, TRACKS
from sliplab.storage.trials.store import IMPORTED

_TABLES = """\
```python
import mlcroissant

data = mlcroissant.Dataset("croissant.json")
for record in data.records("trials"):
    print(record["trials/trial"], record["trials/path"])
```
"""
_LOADS = {
    "croissant": """
Events, poses and clocks are in `data.h5` of each trial's folder (HDF5; unless `sliplab record`
wrote it, with the filters of the package `hdf5plugin`), the maps of its clocks in `record.json`.
The folder is also a store of SlipLab: `sliplab.open_store(".")`.
""",
    "mcap": """
Each trial is an MCAP file of ROS 2 messages, which Foxglove opens; in Python with the packages
`mcap` and `mcap-ros2-support`:

```python
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

with open(path, "rb") as file:
    reader = make_reader(file, decoder_factories=[DecoderFactory()])
    for _, channel, message, decoded in reader.iter_decoded_messages(topics=["/arm/pose"]):
        print(message.log_time, decoded.pose.position.x)
```

`sliplab import campaigns/NAME --store STORE --name NAME` makes a store of them again.
""",
}
_LOADS["archive"] = _LOADS["croissant"]
_LOADS["lerobot"] = (
    _LOADS["croissant"]
    + """
Each trial is also an episode of a LeRobot v3 data set (`data`, `meta`), a row for each 1/100 s:

```python
from lerobot.datasets.lerobot_dataset import LeRobotDataset

episodes = LeRobotDataset("name", root=".")
```
"""
)
_FEATURES = (
    (
        "timestamp",
        "s after the start of the episode, which is `start_ns` of `meta/episodes` on the time line",
    ),
    (
        "observation.state",
        "tool centre point, mm and rotation vector in degrees, interpolated at "
        "the end of the row; no action is given, since none was recorded",
    ),
    ("observation.NAME", "force, N, and torque, N m, of a sensor, interpolated likewise"),
    (
        "observation.images.events",
        "events of the row: red counts brighter, green darker ones, at "
        "most 255; times within the row are in `data.h5` alone",
    ),
    ("observation.images.frames", "the last frame before the end of the row"),
    ("slip", "0 before slip, 1 from its first onset, 2 from its second, -1 without a label"),
)
_LIMITS = (
    "Labels follow from the rule that they name; they are measurements with doubts, not a truth.",
    "An onset that is missing is unknown or in doubt, or the slip did not happen; the label's "
    "document in `derived/labels` says which.",
    "Review decisions of people, operators and host names are not published.",
    "Trials that failed a gate, and interrupted ones, are left out.",
)
_SIMULATED_LIMITS = (
    "The physics of simulated trials is a model with assumed parameters; nothing here shows how a "
    "real skin slips.",
    "The truth in a simulated trial's record is for reports of errors; training on it would be "
    "training on the answer.",
)
_IMPORTED_LIMITS = (
    "Imported trials have no protocol, and clocks of unknown relation; `imported.unknown` in their "
    "record lists what else is not known.",
)


def data_card(
    publication: Publication, tables: Mapping[str, pa.Table], form: str, contents: str = ""
) -> str:
    """Return the card as Markdown; of simulated data, its first line says so.

    Args:
        form: name of the form of its files.
        contents: a section about what is in them.
    """
    about = publication.about
    simulated = sum(recording.simulated for _, recording in publication.recordings)
    part = (
        "."
        if simulated == publication.count
        else f" in part: {simulated} of {plural(publication.count, 'trial')}."
    )
    first = [f"Simulated data{part}", ""] if simulated else []
    licence = (
        f"{about.licence}"
        if about.licence
        else ("None was given: nobody but the authors may use these data until they choose one.")
    )
    if about.licence_url:
        licence = f"[{about.licence}]({about.licence_url})"
    sections = [
        [f"# {about.title}", "", publication.description, ""],
        ["## Licence", "", licence, ""],
        ["## Citation", "", publication.citation, ""],
        ["## Load", "", _TABLES + _LOADS.get(form, "")],
        ["## How it was made", "", *_made(publication), ""],
        ["## Splits", "", *_splits(publication), ""],
        ["## Clocks", "", *_clocks(publication), ""],
        *(
            [f"## `{name}.parquet`", "", *_columns_of(table), ""]
            for name, table in sorted(tables.items(), reverse=True)
        ),
        *([[contents, ""]] if contents else []),
        *(
            [["## Features", "", *_rows(("feature", "meaning"), _FEATURES), ""]]
            if form == "lerobot"
            else []
        ),
        ["## Columns of `data.h5`", "", *_hdf5(), ""],
        ["## Known limits", "", *(f"- {text}" for text in _limits(publication)), ""],
        ["## Checksums", "", "`sha256sum -c checksums.sha256` checks every file.", ""],
    ]
    return "\n".join([*first, *(line for section in sections for line in section)])


def _made(publication: Publication) -> list[str]:
    rows = []
    for campaign in publication.campaigns:
        info = campaign.info
        origin = "simulated" if info["simulated"] else "a real rig"
        rows.append(
            [
                campaign.name,
                str(len(campaign.committed())),
                "imported" if IMPORTED in info else info.get("protocol", ""),
                info.get("collection_hash", ""),
                info.get("rig", ""),
                info.get("rig_hash", ""),
                f"{origin}, scene level {info['scene_level']}"
                if info.get("scene_level")
                else origin,
            ]
        )
    header = ("campaign", "trials", "protocol", "hash of its collection", "rig", "hash", "by")
    versions = [
        f"{name} {', '.join(found)}" for name, found in sorted(publication.versions.items())
    ]
    return [
        *_rows(header, rows),
        "",
        "Protocol and rig of a campaign are in its folder: `protocol.yaml`, `rig.yaml`.",
        "",
        f"Software: {'; '.join(versions) or 'unknown'}.",
    ]


def _splits(publication: Publication) -> list[str]:
    counts = Counter(
        (campaign.name, publication.split(campaign.name, recording.folder.name))
        for campaign, recording in publication.recordings
    )
    rows = [
        [campaign.name, *(str(counts[campaign.name, part]) for part in publication.parts)]
        for campaign in publication.campaigns
    ]
    text = "By trial, a function of its condition alone, fixed by the protocol (`analysis.split`)."
    return [text, "", *_rows(("campaign", *publication.parts), rows)]


def _clocks(publication: Publication) -> list[str]:
    found: dict[tuple[str, str, str], list[float | None]] = {}
    lines: set[str] = set()
    for campaign, recording in publication.recordings:
        lines.add(str(recording.clocks.reference))
        for device, clock in recording.clocks.devices().items():
            grade = f"{clock.grade}{f' ({clock.kind})' if clock.kind else ''}"
            found.setdefault((campaign.name, device, grade), []).append(clock.uncertainty_ns)
    rows = []
    for key, every in sorted(found.items()):
        known = [value / 1000 for value in every if value is not None]
        spread = [f"{np.median(known):.3g}", f"{max(known):.3g}"] if known else ["unknown"] * 2
        rows.append([*key, str(len(every)), *spread])
    header = ("campaign", "device", "timed by", "trials", "uncertainty, median, us", "largest, us")
    return [
        f"Every trial has one time line, in integer ns; its clock: {', '.join(sorted(lines))}. "
        "Raw times are in each device's own clock; `clocks` in `record.json` has the maps onto the "
        "time line: a line with `device_ns`, `reference_ns` and `drift` (parts in 10^18) for each "
        "piece.",
        "",
        *_rows(header, rows),
    ]


def _columns_of(table: pa.Table) -> list[str]:
    rows = [
        [f"`{field.name}`", str(field.type), field.metadata[b"description"].decode()]
        for field in table.schema
    ]
    return _rows(("column", "type", "meaning and unit"), rows)


def _hdf5() -> list[str]:
    rows = [
        [f"`{name}`", _type(column), column.unit]
        for name, column in {**COLUMNS, **TRACKS, **TIMING}.items()
    ]
    rows += [
        [
            f"`streams/NAME/{part}`, kind `{name}`",
            _type(column),
            column.unit,
        ]
        for name, kind in STREAMS.items()
        for part, column in kind.columns.items()
    ]
    text = "A trial has the first fifteen columns, and of the others those that its rig recorded."
    return [text, "", *_rows(("column", "type", "unit"), rows)]


def _type(column: Column) -> str:
    return " x ".join([column.dtype, *("n" if size < 0 else str(size) for size in column.shape)])


def _limits(publication: Publication) -> Iterable[str]:
    yield from _LIMITS
    if publication.simulated:
        yield from _SIMULATED_LIMITS
    if any(IMPORTED in campaign.info for campaign in publication.campaigns):
        yield from _IMPORTED_LIMITS
    torn = [
        f"`{campaign.name}/{recording.trial_id}`"
        for campaign, recording in publication.recordings
        if recording.record.lost is not None
    ]
    if torn:
        yield (
            "These trials were salvaged from damaged files and are not whole; `imported.lost` in "
            f"their record says what is missing: {', '.join(torn)}."
        )


def _rows(header: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    lines = [header, ["---"] * len(header), *rows]
    return [f"| {' | '.join(cell.replace('|', '&#124;') for cell in line)} |" for line in lines]
