"""The description of a publication as a Croissant data set, JSON-LD.

Croissant 1.0 (mlcommons.org/croissant/1.0) describes files and the record sets in them. Tables are
record sets; events, poses and videos are in files of other kinds, which it lists by pattern.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pyarrow as pa

from sliplab.plugins.publish.archive import ONSETS, STREAMS
from sliplab.plugins.publish.publication import SPLITS, Publication
from sliplab.plugins.publish.tables import TRIALS
from sliplab.storage.files import sha256
from sliplab.storage.streams import Json

VERSION = "1.0.0"
"""Version of a publication; a corrected one is published again."""
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
            "equivalentProperty",
            "extract",
            "field",
            "fileProperty",
            "fileObject",
            "fileSet",
            "format",
            "includes",
            "isLiveDataset",
            "jsonPath",
            "key",
            "md5",
            "parentField",
            "path",
            "recordSet",
            "references",
            "regex",
            "repeated",
            "replace",
            "samplingRate",
        )
    },
    "sc": "https://schema.org/",
    "separator": "cr:separator",
    "source": "cr:source",
    "subField": "cr:subField",
    "transform": "cr:transform",
}
_FILE_SETS = (
    ("recordings", "trials/*/*.h5", "application/x-hdf5", "events, poses, pulses, frame times"),
    ("videos", "trials/*/*.mkv", "video/x-matroska", "frames: FFV1 in Matroska, lossless"),
    ("records", "trials/*/record.json", "application/json", "condition, clocks, gates, phases"),
    ("trial-files", "*.mcap", "application/x-mcap", "ROS 2 messages, a file for each trial"),
)


def croissant(publication: Publication, tables: dict[str, pa.Table], folder: Path) -> Json:
    """Return the content of ``croissant.json``, of what is in `folder`."""
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
            "includes": f"campaigns/*/{pattern}",
        }
        for name, pattern, kind, text in _FILE_SETS
        if any(folder.glob(f"campaigns/*/{pattern}"))
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
            {
                "@type": "cr:Field",
                "@id": "splits/name",
                "name": "splits/name",
                "description": "name of the part",
                "dataType": "sc:Text",
            },
            {
                "@type": "cr:Field",
                "@id": "splits/url",
                "name": "splits/url",
                "description": "Croissant's name of the part",
                "dataType": "sc:URL",
            },
        ],
        "data": [{"splits/name": name, "splits/url": SPLITS[name]} for name in parts],
    }


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
    own = {ONSETS: "onset", STREAMS: "stream"}
    keys = ["campaign", "trial", *([own[table]] if table in own else [])]
    key: Any = [{"@id": f"{table}/{name}"} for name in keys]
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
