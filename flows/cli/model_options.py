"""Options of a command from the fields of a model."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Iterator
from functools import wraps
from typing import Annotated, Any, get_origin

import typer
from pydantic import BaseModel, ValidationError

from sliplab.protocols.errors import InputError
from sliplab.protocols.key_errors import faults_of

_UNIT = re.compile("_(c|percent|s|ms|mm|mm_s)$")
_BOUNDS = {"ge": "min", "le": "max"}


def model_options(command: Callable[..., None]) -> Callable[..., None]:
    """Return a command with an option for each field of the models among its parameters.

    An option has the field's description and bounds, and its name without a unit. A parameter's
    default, an instance of its model, gives those of the options.
    """
    parameters: list[inspect.Parameter] = []
    models: dict[str, type[BaseModel]] = {}
    for each in inspect.signature(command, eval_str=True).parameters.values():
        kind = each.annotation
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            models[each.name] = kind
            parameters += _options(kind() if each.default is each.empty else each.default)
        else:
            parameters.append(each.replace(kind=each.KEYWORD_ONLY))

    @wraps(command)
    def run(**given: Any) -> None:
        for name, model in models.items():
            given[name] = _made(model, {key: given.pop(key) for key in model.model_fields})
        command(**given)

    run.__annotations__ = {each.name: each.annotation for each in parameters}
    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    return run


def _options(defaults: BaseModel) -> Iterator[inspect.Parameter]:
    for name, field in type(defaults).model_fields.items():
        kind: Any = field.annotation
        value = getattr(defaults, name)
        if get_origin(kind) is list:
            kind, value = kind | None, value or None
        bounds: dict[str, Any] = {
            _BOUNDS[bound]: getattr(part, bound)
            for part in field.metadata
            for bound in _BOUNDS
            if hasattr(part, bound)
        }
        option = typer.Option(_named(name), help=field.description, **bounds)
        where, annotation = inspect.Parameter.KEYWORD_ONLY, Annotated[kind, option]
        yield inspect.Parameter(name, where, default=value, annotation=annotation)


def _named(field: str) -> str:
    return f"--{_UNIT.sub('', field).replace('_', '-')}"


def _made(model: type[BaseModel], given: dict[str, Any]) -> BaseModel:
    """Return the model of some options. Raises InputError."""
    try:
        return model(**{name: value for name, value in given.items() if value is not None})
    except ValidationError as error:
        fault = faults_of(model, error)[0]
        raise InputError(_named(fault.key), "", fault.value, str(fault)) from None
