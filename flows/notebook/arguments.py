"""Arguments of the public interface: one of a wrong type is an InputError that names it."""

from __future__ import annotations

import inspect
import math
import re
from collections.abc import Callable, Iterable, Mapping
from functools import wraps
from os import PathLike
from typing import Any, TypeVar

import numpy as np

from sliplab.flows.running import extras
from sliplab.protocols.errors import InputError
from sliplab.storage.errors import named_disk_error

CallableT = TypeVar("CallableT", bound=Callable[..., Any])
ClassT = TypeVar("ClassT", bound=type)
_NO_ARGUMENTS = {inspect.Parameter.VAR_KEYWORD, inspect.Parameter.VAR_POSITIONAL}


def checked(function: CallableT) -> CallableT:
    """Return a function that checks its arguments by their annotations.

    Text in place of several names is one name, several names are a list. Numbers must be finite.
    A package that is missing inside is named with its extra (`extras.named`). What a disk refuses
    is a StoreError that names the file.
    """
    signature = inspect.signature(function)

    @wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        try:
            given = signature.bind(*args, **kwargs)
        except TypeError as error:
            names = ", ".join(name for name in signature.parameters if name != "self")
            text = f"{error}; its arguments are {names or 'none'}"
            raise InputError(f"{function.__name__}()", "", None, text) from None
        for name, value in given.arguments.items():
            parameter = signature.parameters[name]
            if parameter.kind not in _NO_ARGUMENTS and name != "self":
                given.arguments[name] = _checked(name, value, str(parameter.annotation))
        with extras.named(function.__qualname__):
            try:
                return function(*given.args, **given.kwargs)
            except OSError as error:
                if stated := named_disk_error(error):
                    raise stated from error
                raise

    return call  # type: ignore[return-value]


def checked_methods(kind: ClassT) -> ClassT:
    """Make the public methods of a class check their arguments, as `checked` does."""
    for name, member in list(vars(kind).items()):
        if inspect.isfunction(member) and not name.startswith("_"):
            setattr(kind, name, checked(member))
    return kind


def _checked(name: str, value: Any, annotation: str) -> Any:
    kinds = annotation.split(" | ")
    if _NAMES in map(_plain, kinds) and isinstance(value, Iterable):
        value = [value] if isinstance(value, str) else list(value)
    if not any(_fits(value, _plain(kind)) for kind in kinds):
        words = " or ".join(dict.fromkeys(_WORDS.get(_plain(k), _plain(k)) for k in kinds))
        raise InputError(name, "", value, f"must be {words}")
    return value


_NAMES, _FUNCTION = "names", "function"


def _plain(kind: str) -> str:
    """Return the name of a kind of values: that of a class without its module."""
    if re.fullmatch(r"(Sequence|Iterable|list)\[str\]", kind):
        return _NAMES
    return _FUNCTION if kind.startswith("Callable[") else kind.rpartition(".")[2]


def _is_number(value: Any) -> bool:
    real = isinstance(value, int | float | np.integer | np.floating)
    return real and not isinstance(value, bool) and math.isfinite(value)


_FITS: Mapping[str, Callable[[Any], bool]] = {
    "Any": lambda value: True,
    "None": lambda value: value is None,
    "str": lambda value: isinstance(value, str),
    "Path": lambda value: isinstance(value, PathLike),
    "bool": lambda value: isinstance(value, bool | np.bool_),
    "int": lambda value: _is_number(value) and isinstance(value, int | np.integer),
    "float": _is_number,
    "I64": lambda value: np.asarray(value).dtype.kind in "iu",
    "tuple[int, int]": lambda value: np.shape(value) == (2,) and all(map(_is_number, value)),
    _NAMES: lambda value: isinstance(value, list) and all(isinstance(it, str) for it in value),
    _FUNCTION: callable,
}
_WORDS = {
    "str": "text",
    "Path": "a path",
    "bool": "True or False",
    "int": "a whole number",
    "float": "a finite number",
    "I64": "whole numbers",
    "tuple[int, int]": "two numbers",
    _NAMES: "a list of names",
    _FUNCTION: "a function",
    "DataFrame": "a pandas.DataFrame",
}


def _fits(value: Any, kind: str) -> bool:
    """Return whether a value is of a kind; classes, some not loaded, are found by their names."""
    fits = _FITS.get(kind)
    if fits is not None:
        return fits(value)
    return any(each.__name__ == kind for each in type(value).__mro__)
