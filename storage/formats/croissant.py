"""A publication as a Croissant data set: its files as they are, tables, and JSON-LD about them.

Croissant 1.0 (mlcommons.org/croissant/1.0) describes files and the record sets in them. Tables are
Parquet; events, poses and videos stay in the files of the store, which Croissant lists by pattern.
The folder is an RO-Crate and a store as well.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow as pa

from sliplab.storage.files import inside, sha256, write_json_aside
from sliplab.storage.formats.data_card import data_card
from sliplab.storage.formats.publication import SPLITS, Publication, staged
from sliplab.storage.formats.published_tables import (
    LABELLED,
    TRIALS,
    trial_folder,
    write_tables,
)
from sliplab.storage.formats.ro_crate import ro_crate
from sliplab.storage.schema.label import LABELS
from sliplab.storage.streams import Json
from sliplab.storage.trials.checksums import CHECKSUMS, PROVENANCE
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import INFO, PROTOCOL, RIG, STORE, SYNC, Campaign

CROISSANT, RO_CRATE, CARD, SUMS = (
    "croissant.json", "ro-crate-metadata.json", "README.md", "checksums.sha256"
)  # fmt: skip
VERSION = "1.0.0"
"""Version of a publication; a corrected one is published anew."""
PERSONAL = ("operator", "host")
"""Keys of a trial's provenance that are not published."""
_CONTEXT: Json = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "citeAs": "cr:citeAs",
    "column": "cr:column",
    "conformsTo": "dct:conformsTo",
    "cr": "http://mlcommons.org/croissant/",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "dct": "http://purl.org/dc/terms/",
    "examples": {"@id": "cr:examples", "@type": "@json"},
    **{
        name: f"cr:{name}"
        for name in (
            "equivalentProperty", "extract", "field", "fileProperty", "fileObject", "fileSet",
            "format", "includes", "isLiveDataset", "jsonPath", "key", "md5", "parentField", "path",
            "recordSet", "references", "regex", "repeated", "replace", "samplingRate",
        )
    },
    "sc": "https://schema.org/",
    "separator": "cr:separator",
    "source": "cr:source",
    "subField": "cr:subField",
    "transform": "cr:transform",
}  # fmt: skip
_FILE_SETS = (
    ("recordings", "*.h5", "application/x-hdf5", "events, poses, pulses, frame times"),
    ("videos", "*.mkv", "video/x-matroska", "frames, FFV1 in Matroska, lossless, grey levels"),
    ("records", "record.json", "application/json", "condition, clocks, gates, phases"),
)  # fmt: skip


def publish_croissant(
    publication: Publication, output: Path, on_trial: Callable[[str], None] = lambda name: None
) -> Json:
    """Write a publication into the new folder `output`.

    Returns:
        ``trials``, ``labels``, ``files`` and ``bytes`` written, and ``simulated``.

    Raises:
        InputError: `output` exists, or a trial is damaged.
    """
    with staged(output) as folder:
        shutil.copyfile(publication.store.folder / STORE, folder / STORE)
        for campaign in publication.campaigns:
            _copy_campaign(campaign, folder)
        for campaign, recording in publication.recordings:
            on_trial(recording.folder.name)
            _copy_trial(publication, campaign, recording, folder)
        tables = write_tables(publication, folder)
        (folder / CARD).write_text(data_card(publication, tables), "utf-8")
        write_json_aside(folder / CROISSANT, _croissant(publication, tables, folder))
        files = sorted(path for path in folder.rglob("*") if path.is_file())
        sums = {path.relative_to(folder).as_posix(): sha256(path) for path in files}
        sizes = {path.relative_to(folder).as_posix(): path.stat().st_size for path in files}
        write_json_aside(folder / RO_CRATE, ro_crate(publication, sums, sizes))
        sums[RO_CRATE] = sha256(folder / RO_CRATE)
        lines = "".join(f"{digest}  {name}\n" for name, digest in sorted(sums.items()))
        (folder / SUMS).write_text(lines, "utf-8")
    return {
        "trials": publication.count,
        "labels": len(tables[LABELLED]) if LABELLED in tables else 0,
        "files": len(sums) + 1,
        "bytes": sum(sizes.values()),
        "simulated": publication.simulated,
    }


def _copy_campaign(campaign: Campaign, folder: Path) -> None:
    target = folder / "campaigns" / campaign.name
    target.mkdir(parents=True)
    for name in (INFO, PROTOCOL, RIG, CHECKSUMS):
        if (campaign.folder / name).is_file():
            shutil.copyfile(campaign.folder / name, target / name)


def _copy_trial(
    publication: Publication, campaign: Campaign, recording: Recording, folder: Path
) -> None:
    """Copy a trial's files, its label and its refitted clocks."""
    trial = recording.folder.name
    target = folder / trial_folder(campaign.name, trial)
    target.mkdir(parents=True)
    for name, path in publication.files(campaign, recording).items():
        shutil.copyfile(path, target / name)
    shutil.copyfile(recording.folder / CHECKSUMS, target / CHECKSUMS)
    made = campaign.provenance(recording).to_json()
    kept = {key: value for key, value in made.items() if key not in PERSONAL}
    write_json_aside(target / PROVENANCE, kept)
    for step in (LABELS, SYNC):
        derived = Derived.of(publication.store, step, campaign.name)
        result = derived.folder / f"{trial}.json"
        if not result.is_file() or (step == SYNC and not recording.refitted):
            continue
        copied = folder / "derived" / step / campaign.name
        copied.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(inside(result, publication.store.folder), copied / result.name)
        arrays = derived.arrays_path(trial)
        if step == LABELS and arrays.is_file():
            shutil.copyfile(inside(arrays, publication.store.folder), copied / arrays.name)


def _croissant(publication: Publication, tables: dict[str, pa.Table], folder: Path) -> Json:
    about = publication.about
    described: Json = {
        "@context": _CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": "http://mlcommons.org/croissant/1.0",
        "name": about.title,
        "description": publication.description,
        "version": VERSION,
        "datePublished": about.date,
        "keywords": ["tactile sensing", "slip", "event camera", "robotics"],
        "isLiveDataset": False,
        "creator": [{"@type": "sc:Person", "name": name} for name in about.creators],
        "license": about.licence_url or about.licence,
        "citeAs": publication.citation,
        "distribution": [_table_file(name, folder) for name in tables] + _file_sets(folder),
        "recordSet": [
            _splits(publication.parts),
            *(_record_set(name, table) for name, table in tables.items()),
        ],
    }
    return {key: value for key, value in described.items() if value not in (None, [])}


def _table_file(name: str, folder: Path) -> Json:
    path = folder / f"{name}.parquet"
    return {
        "@type": "cr:FileObject",
        "@id": path.name,
        "name": path.name,
        "description": f"the table of {name}",
        "contentUrl": path.name,
        "contentSize": f"{path.stat().st_size} B",
        "encodingFormat": "application/x-parquet",
        "sha256": sha256(path),
    }


def _file_sets(folder: Path) -> list[Json]:
    return [
        {
            "@type": "cr:FileSet",
            "@id": name,
            "name": name,
            "description": text,
            "encodingFormat": kind,
            "includes": f"campaigns/*/trials/*/{pattern}",
        }
        for name, pattern, kind, text in _FILE_SETS
        if any(folder.glob(f"campaigns/*/trials/*/{pattern}"))
    ]


def _splits(parts: tuple[str, ...]) -> Json:
    return {
        "@type": "cr:RecordSet",
        "@id": "splits",
        "name": "splits",
        "description": "parts of the split, by trial and fixed by the protocol",
        "dataType": "cr:Split",
        "key": {"@id": "splits/name"},
        "field": [
            {"@type": "cr:Field", "@id": "splits/name", "name": "splits/name",
             "description": "name of the part", "dataType": "sc:Text"},
            {"@type": "cr:Field", "@id": "splits/url", "name": "splits/url",
             "description": "Croissant's name of the part", "dataType": "sc:URL"},
        ],
        "data": [{"splits/name": name, "splits/url": SPLITS[name]} for name in parts],
    }  # fmt: skip


def _record_set(table: str, rows: pa.Table) -> Json:
    fields = []
    for column in rows.schema:
        known = f"{table}/{column.name}"
        field: Json = {
            "@type": "cr:Field",
            "@id": known,
            "name": known,
            "description": column.metadata[b"description"].decode(),
            "dataType": _data_type(column.type),
            "source": {
                "fileObject": {"@id": f"{table}.parquet"},
                "extract": {"column": column.name},
            },
        }
        if known == f"{TRIALS}/split":
            field["references"] = {"field": {"@id": "splits/name"}}
        fields.append(field)
    key: Any = [{"@id": f"{table}/campaign"}, {"@id": f"{table}/trial"}]
    return {
        "@type": "cr:RecordSet",
        "@id": table,
        "name": table,
        "description": f"one record for each of the {table}",
        "key": key,
        "field": fields,
    }


def _data_type(kind: pa.DataType) -> str:
    if pa.types.is_boolean(kind):
        return "sc:Boolean"
    if pa.types.is_integer(kind):
        return "sc:Integer"
    return "sc:Float" if pa.types.is_floating(kind) else "sc:Text"
