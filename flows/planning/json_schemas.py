"""JSON Schemas of protocol, rig and adapter files, and of the documents in a store.

Editors complete, explain and check YAML by the first three; programs check what they read by the
others. They are made from the models that read the files, so they know the same keys. They know
less than `sliplab plan` and `sliplab check`: a rule over several keys, such as a limit that a level
breaks, is in the models alone. They are of draft 7, the newest that the YAML language server
knows.
"""

from __future__ import annotations

import ast
import inspect
import sys
from contextlib import suppress
from functools import cache
from typing import Any

from pydantic import BaseModel
from pydantic.json_schema import GenerateJsonSchema

from sliplab.analysis.study import Study
from sliplab.protocols.adapter import Adapter
from sliplab.protocols.model import Protocol
from sliplab.protocols.plugin import plugins
from sliplab.protocols.plugins import PluginError, import_foreign
from sliplab.protocols.units import load_packages
from sliplab.rigs.rig_file import RigFile
from sliplab.rigs.rig_inheritance import KEY
from sliplab.storage.schema.detector import DetectorCalibration
from sliplab.storage.schema.document import Document
from sliplab.storage.schema.evaluation import Evaluation
from sliplab.storage.schema.label import TrialLabel
from sliplab.storage.schema.summary import Summary
from sliplab.storage.schema.trial import TrialRecord

Schema = dict[str, Any]
FILES: dict[str, tuple[type[BaseModel], str]] = {
    "protocol": (Protocol, "A protocol of SlipLab"),
    "rig": (RigFile, "A rig file of SlipLab"),
    "adapter": (Adapter, "An adapter of SlipLab"),
}
"""Files that people write, with the titles of their schemas."""
DOCUMENTS: dict[str, tuple[type[Document], str]] = {
    "trial": (TrialRecord, "The record of a trial of SlipLab"),
    "label": (TrialLabel, "The label of a trial of SlipLab"),
    "evaluation": (Evaluation, "An evaluation of SlipLab"),
    "summary": (Summary, "The summary of a report of SlipLab"),
    "detector": (DetectorCalibration, "The calibration of a detector of SlipLab"),
}
"""Documents of a store, with the titles of their schemas; plug-ins have further ones."""
_DIALECT = "http://json-schema.org/draft-07/schema#"
_PART = "Part"


class _Described(GenerateJsonSchema):
    """Schemas without titles that repeat the keys; each key with the text below its field."""

    def model_schema(self, schema: Any) -> Schema:
        made = super().model_schema(schema)
        texts = _field_texts(schema["cls"])
        for name, field in made.get("properties", {}).items():
            if name in texts:
                _describe(field, texts[name])
        return made

    def field_title_should_be_set(self, schema: Any) -> bool:
        return False


def kinds() -> tuple[str, ...]:
    """Return the kinds of files and documents that have a schema."""
    return (*FILES, *DOCUMENTS, *plugins().declared("documents"), *_studies())


def _studies() -> dict[str, Study[Any]]:
    """Return the studies that can be imported by the kinds of their results."""
    found = {}
    for place in plugins().declared("studies").values():
        with suppress(PluginError):
            study = import_foreign(place)
            found[study.kind or study.name] = study
    return found


def document_model(kind: str) -> tuple[type[Document], str]:
    """Return the model of a document and the title of its schema."""
    if kind in DOCUMENTS:
        return DOCUMENTS[kind]
    if (study := _studies().get(kind)) is not None:
        return study.result, study.title
    place, title = plugins().declared("documents")[kind]
    return import_foreign(place), title


def file_schema(kind: str) -> Schema:
    """Return the JSON Schema (draft 7) of one of `kinds()`, as plain data."""
    load_packages()  # their units, too
    model, title = FILES[kind] if kind in FILES else document_model(kind)
    return {
        "$schema": _DIALECT,
        **(_rig_schema() if kind == "rig" else _made(model)),
        "title": title,
    }


def _rig_schema() -> Schema:
    """A file with `extends` may leave out what it takes over, at any depth."""
    whole = _made(RigFile)
    models: Schema = {**whole.pop("definitions"), "RigFile": whole}
    parts = {f"{name}{_PART}": _partial(model) for name, model in models.items()}
    parts[f"RigFile{_PART}"]["properties"][KEY] = {
        "type": "string",
        "description": "The rig file that this one changes, from its own folder.",
        "examples": ["mock.yaml"],
    }
    return {
        "type": "object",
        "if": {"required": [KEY]},
        "then": {"$ref": f"#/definitions/RigFile{_PART}"},
        "else": {"$ref": "#/definitions/RigFile"},
        "definitions": models | parts,
    }


def _made(model: type[BaseModel]) -> Schema:
    made = model.model_json_schema(
        schema_generator=_Described, ref_template="#/definitions/{model}"
    )
    made["definitions"] = made.pop("$defs")
    plain: Schema = _plain(made)
    return plain


def _plain(part: Any) -> Any:
    """Return the schema in draft 7, without whole sections as defaults."""
    if isinstance(part, list):
        return [_plain(item) for item in part]
    if not isinstance(part, dict):
        return part
    left = {key: _plain(value) for key, value in part.items() if key != "discriminator"}
    if isinstance(left.get("default"), dict):
        left.pop("default")
    if "prefixItems" in left:
        left |= {"items": left.pop("prefixItems"), "additionalItems": False}
    if "$ref" in left and len(left) > 1:  # else the keys next to it are ignored
        left["allOf"] = [{"$ref": left.pop("$ref")}]
    return left


def _partial(part: Any) -> Any:
    """Return the schema of `part` with nothing required, and only such models below it."""
    if isinstance(part, list):
        return [_partial(item) for item in part]
    if not isinstance(part, dict):
        return part
    made = {key: _partial(value) for key, value in part.items() if key != "required"}
    if "properties" in part:
        made["properties"] = {key: _partial(value) for key, value in part["properties"].items()}
    if isinstance(part.get("$ref"), str):
        made["$ref"] = part["$ref"] + _PART
    if "oneOf" in made:  # a part need not say which one it is
        made["anyOf"] = made.pop("oneOf")
    return made


def _describe(field: Schema, text: str) -> None:
    known = field.get("description", "")
    field["description"] = f"{text} {known}".strip()


def _field_texts(model: type[BaseModel]) -> dict[str, str]:
    """The texts below the fields of a model and of those it is made from, by key."""
    found: dict[str, str] = {}
    for kind in reversed(model.__mro__):
        if issubclass(kind, BaseModel) and not kind.__module__.startswith("pydantic"):
            found |= _texts_in(kind.__module__).get(kind.__name__, {})
    return {
        field.alias or name: found[name]
        for name, field in model.model_fields.items()
        if name in found
    }


@cache
def _texts_in(module: str) -> dict[str, dict[str, str]]:
    """The texts below the fields of each class of a module."""
    tree = ast.parse(inspect.getsource(sys.modules[module]))
    return {node.name: _texts(node) for node in tree.body if isinstance(node, ast.ClassDef)}


def _texts(node: ast.ClassDef) -> dict[str, str]:
    return {
        field.target.id: " ".join(below.value.value.split())
        for field, below in zip(node.body, node.body[1:], strict=False)
        if isinstance(field, ast.AnnAssign)
        and isinstance(field.target, ast.Name)
        and isinstance(below, ast.Expr)
        and isinstance(below.value, ast.Constant)
        and isinstance(below.value.value, str)
    }
