"""Every number of every input file has bounds, and no switch or infinity passes for one."""

from __future__ import annotations

import copy
import types
from collections.abc import Iterator
from typing import Annotated, Any, Union, get_args, get_origin

import pytest
import yaml
from annotated_types import Interval, Le, Lt
from pydantic import BaseModel, BeforeValidator
from pydantic.fields import FieldInfo

from sliplab.plugins.web.server.schedules import _MODELS, Ask
from sliplab.protocols.errors import InputError
from sliplab.protocols.model import Protocol
from sliplab.protocols.yaml_file import validate
from sliplab.rigs.rig_file import RigFile
from sliplab.rigs.rig_inheritance import read_rig
from tests.conftest import ROOT

FILES: tuple[type[BaseModel], ...] = (Protocol, RigFile, *_MODELS.values(), Ask)


def _bounded(metadata: list[Any]) -> bool:
    for item in metadata:
        inner = item.metadata if isinstance(item, FieldInfo) else [item]
        for part in inner:
            if isinstance(part, Le | Lt | BeforeValidator):
                return True
            if isinstance(part, Interval) and (part.le, part.lt) != (None, None):
                return True
    return False


def _unbounded(kind: Any, where: str, metadata: list[Any]) -> Iterator[str]:
    """Names of fields that hold a number of any size; quantities are bounded by their reader."""
    if get_origin(kind) is Annotated:
        inner, *more = get_args(kind)
        yield from _unbounded(inner, where, [*metadata, *more])
    elif kind in (int, float):
        if not _bounded(metadata):
            yield where
    elif isinstance(kind, type) and issubclass(kind, BaseModel):
        for name, field in kind.model_fields.items():
            yield from _unbounded(field.annotation, f"{where}.{name}", list(field.metadata))
    else:
        either = get_origin(kind) in (Union, types.UnionType)
        for part in get_args(kind):
            yield from _unbounded(part, where, metadata if either else [])


@pytest.mark.parametrize("model", FILES, ids=lambda model: model.__name__)
def test_every_number_is_bounded(model: type[BaseModel]) -> None:
    assert set(_unbounded(model, "", [])) == set()


def _numbers(data: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    if isinstance(data, dict | list):
        for key, part in data.items() if isinstance(data, dict) else enumerate(data):
            yield from _numbers(part, (*path, key))
    elif isinstance(data, int | float) and not isinstance(data, bool):
        yield path


def _changed(data: Any, path: tuple[Any, ...], value: Any) -> Any:
    made = copy.deepcopy(data)
    part = made
    for key in path[:-1]:
        part = part[key]
    part[path[-1]] = value
    return made


RIGS = {
    name: yaml.safe_load(read_rig(ROOT / "rigs" / f"{name}.yaml").text)
    for name in ("mock", "irb120", "loopback", "mock_noisy")
}
PROTOCOLS = {
    name: yaml.safe_load((ROOT / "protocols" / f"{name}.yaml").read_text())
    for name in ("kinematic", "gravity", "disturbance")
}


@pytest.mark.quick(8)
@pytest.mark.parametrize("value", [True, float("inf"), float("-inf"), float("nan"), 1e300, "inf"])
@pytest.mark.parametrize(
    ("model", "name"),
    [*((RigFile, name) for name in RIGS), *((Protocol, name) for name in PROTOCOLS)],
)
def test_no_number_of_a_shipped_file_may_be(model: Any, name: str, value: object) -> None:
    data = (RIGS if model is RigFile else PROTOCOLS)[name]
    for path in _numbers(data):
        with pytest.raises(InputError) as caught:
            validate(model, _changed(data, path, value), "file.yaml")
        key = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in path)[1:]
        assert caught.value.key.startswith(key.split("[")[0].rpartition(".")[0]), (key, value)
