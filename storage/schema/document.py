"""Base of the documents in a store: frozen models that preserve unknown keys.

A document is written by one version of the program and read by others. A reader validates the keys
that it knows and preserves the rest. A key that an older version did not write has a
default. Only the given keys are written, so reading and writing a document reproduces it byte for
byte.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Self

from pydantic import (
    BaseModel,
    ConfigDict,
    GetPydanticSchema,
    Strict,
    ValidationError,
    WithJsonSchema,
)
from pydantic import Field as _Field
from pydantic_core.core_schema import no_info_plain_validator_function

from sliplab.protocols.errors import InputError
from sliplab.protocols.key_errors import faults_of
from sliplab.storage.files import read_json

if TYPE_CHECKING:  # loads numpy
    from sliplab.storage.streams import Json

Int = Annotated[int, Strict(), _Field(ge=-(2**63), lt=2**63)]
"""A whole number of 64 bits; 1.0 and true are none."""
Bool = Annotated[bool, Strict()]


def _number(value: Any) -> Any:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError("must be a number")
    try:
        finite = math.isfinite(value)
    except OverflowError:
        finite = False
    if not finite:
        raise ValueError("must be a finite number")
    return value


Number = Annotated[
    float,
    GetPydanticSchema(lambda *_: no_info_plain_validator_function(_number)),
    WithJsonSchema({"type": "number"}),
]
"""A finite number, which stays a whole one where it was written so."""


class DocumentError(ValueError):
    """A document cannot be right; the message names file, key, value and what would be right."""


class NewerFormat(ValueError):
    """A document was written by a newer version of the program.

    Attributes:
        format: the document's.
    """

    def __init__(self, path: Path, found: int, known: int) -> None:
        self.format = found
        super().__init__(
            f"{path}: format = {found}: was written by a newer version of SlipLab; this one reads "
            f"formats up to {known}: update it"
        )


class Part(BaseModel):
    """A mapping inside a document."""

    model_config = ConfigDict(
        frozen=True,
        extra="allow",
        allow_inf_nan=False,
        serialize_by_alias=True,
        validate_by_name=True,
        validate_by_alias=True,
    )

    def to_json(self) -> Json:
        """The keys that were given, as plain data."""
        return self.model_dump(mode="json", exclude_unset=True)


class Document(Part):
    """A whole file.

    Attributes:
        FORMAT: the newest that this version reads, and the one that it writes.
    """

    FORMAT: ClassVar[int] = 1

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read the document at `path`.

        Raises:
            OSError: the file cannot be read.
            DocumentError: the file is damaged.
            NewerFormat: it was written by a newer version.
        """
        try:
            data = read_json(path)
        except ValueError as error:
            raise DocumentError(str(error)) from None
        return cls.parse(data, path)

    @classmethod
    def parse(cls, data: Json, path: Path) -> Self:
        """Check plain data, which `path` held.

        Raises:
            DocumentError, NewerFormat: as `load`.
        """
        written = data.get("format", 1)
        if isinstance(written, int) and written > cls.FORMAT:
            raise NewerFormat(path, written, cls.FORMAT)
        try:
            return cls.model_validate(data)
        except ValidationError as error:
            fault = faults_of(cls, error)[0]
            wrong = InputError(path, fault.key, fault.value, str(fault))
            raise DocumentError(wrong.message) from None
